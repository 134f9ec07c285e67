"""Failures and successes of a row as a contact sheet, each failure with its cause in words."""

from collections.abc import Iterator, Sequence

import numpy as np

from common.policy.bundle import PolicyBundle
from common.wire.codec import Message
from services.evaluate.evaluator import Evaluator
from services.viz.render import episode_strip
from services.viz.sheets import contact_sheet

_MOMENTS = 5
_SIZE = (300, 225)
_PUSHED = 0.05  # m that an object may move before the table goes


def cause(episode: Message, drop_height: float) -> str:
    """Why an episode ended with the object `drop_height` (m) or more below where it was, or `held`."""
    metrics = episode.meta["metrics"]
    if metrics["bad"]:
        return "the physics diverged"
    if metrics["held"]:
        return "held"
    if metrics["moved_at_removal"] > _PUSHED:
        return "pushed away before the table went"
    if not metrics["links_at_removal"]:
        return "not touched when the table went"
    removal = int(np.argmin(episode.arrays["table"]))
    seconds = (fall(episode, drop_height) - removal) * episode.meta["control_dt"]
    return f"slipped {seconds:.2f} s after the table went"


def fall(episode: Message, drop_height: float) -> int:
    """The step at which the object is `drop_height` (m) below where it was when the table went; the last if none is."""
    removal = int(np.argmin(episode.arrays["table"]))
    height = np.asarray(episode.arrays["object_position"])[:, 2]
    below = np.flatnonzero(height[removal:] < height[removal] - drop_height)
    return removal + int(below[0]) if len(below) else len(height) - 1


def failure_sheets(
    evaluator: Evaluator, policy: PolicyBundle, constraints: Sequence[str], successes: int, failures: int
) -> Iterator[tuple[str, np.ndarray, Sequence[str]]]:
    """Draws episodes of rows to the moment at which the object has fallen, or to the end, failures first.

    Args:
      evaluator: of the policy; where it kept episodes, none are evaluated anew.
      policy: for the titles.
      constraints: names of the rows.
      successes: how many of each to show.
      failures: how many of each to show, if there are so many.

    Yields:
      For each row that has an episode to show: its name, the sheet (H, W, 3) uint8, and what became of each episode.
    """
    for constraint in constraints:
        episodes = evaluator.examples(constraint, successes, failures)
        if not episodes:
            continue
        images: list[np.ndarray] = []
        labels: list[str] = []
        causes = [cause(episode, evaluator.task.drop_height) for episode in episodes]
        for episode, what in zip(episodes, causes, strict=True):
            until, first = fall(episode, evaluator.task.drop_height), episode.meta["object"]
            pictures, words = episode_strip(episode, _MOMENTS, _SIZE, first, f": {what}", until=until, quick=True)
            images += pictures
            labels += words
        who = f"{policy.spec.hand_name} hand, version {policy.version}"
        title = f"{who}, {constraint}: {len(episodes)} episodes, failures first"
        yield constraint, contact_sheet(images, labels, columns=_MOMENTS, title=title), causes
