"""Failures and successes of a row as a contact sheet, each failure with its cause."""

from collections.abc import Iterator, Sequence

import numpy as np

from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.wire.codec import Message
from congrasp.services.evaluate.evaluator import Evaluator
from congrasp.services.viz.render import episode_strip
from congrasp.services.viz.sheets import contact_sheet

_FRAMES = 5
_SIZE = (300, 225)
_PUSHED = 0.05  # m that an object may move before the table is removed


def cause(episode: Message, drop_height: float) -> str:
    """Why an episode ended with the object `drop_height` (m) or more below where it was, or `held`."""
    metrics = episode.meta["metrics"]
    if metrics["bad"]:
        return "the physics diverged"
    if metrics["held"]:
        return "held"
    if metrics["moved_at_removal"] > _PUSHED:
        return "pushed away before the table was removed"
    if not metrics["links_at_removal"]:
        return "not touched when the table was removed"
    removal = int(np.argmin(episode.arrays["table"]))
    seconds = (fall_step(episode, drop_height) - removal) * episode.meta["control_dt"]
    return f"slipped {seconds:.2f} s after the table was removed"


def fall_step(episode: Message, drop_height: float) -> int:
    """The step at which the object is `drop_height` (m) below where it was at the table's removal, or the last one."""
    removal = int(np.argmin(episode.arrays["table"]))
    height = np.asarray(episode.arrays["object_position"])[:, 2]
    below = np.flatnonzero(height[removal:] < height[removal] - drop_height)
    return removal + int(below[0]) if len(below) else len(height) - 1


def failure_sheets(
    evaluator: Evaluator, policy: PolicyBundle, constraints: Sequence[str], successes: int, failures: int
) -> Iterator[tuple[str, np.ndarray, Sequence[str]]]:
    """Draws episodes of rows up to the step at which the object has fallen, or to the end, failures first.

    Args:
      evaluator: of the policy; where it kept episodes, none are evaluated anew.
      policy: for the titles.
      constraints: names of the rows.
      successes: how many of each to show.
      failures: how many of each to show, if there are so many.

    Yields:
      For each row that has an episode to show: its name, the sheet (H, W, 3) uint8, and the outcome of each episode.
    """
    for constraint in constraints:
        episodes = evaluator.examples(constraint, successes, failures)
        if not episodes:
            continue
        images: list[np.ndarray] = []
        labels: list[str] = []
        causes = [cause(episode, evaluator.task.drop_height) for episode in episodes]
        for episode, outcome in zip(episodes, causes, strict=True):
            until, first = fall_step(episode, evaluator.task.drop_height), episode.meta["object"]
            frames, captions = episode_strip(episode, _FRAMES, _SIZE, first, f": {outcome}", until=until)
            images += frames
            labels += captions
        who = f"{policy.spec.hand_name} hand, version {policy.version}"
        title = f"{who}, {constraint}: {len(episodes)} episodes, failures first"
        yield constraint, contact_sheet(images, labels, columns=_FRAMES, title=title), causes
