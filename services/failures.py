"""Failures and successes of a row as a contact sheet, each failure with its cause in words."""

import pathlib
from collections.abc import Sequence

import numpy as np

from common.policy.bundle import PolicyBundle
from common.wire.codec import Message
from services.evaluate import Evaluator
from services.render import key_steps, render_episode_frames
from services.sheets import contact_sheet, save_png

_MOMENTS = 5
_SIZE = (300, 225)
_PUSHED = 0.05  # m that an object may move before the table goes
_FALLEN = 0.05  # m


def cause(episode: Message) -> str:
    """Why an episode ended without the object in the hand, or `held`."""
    metrics = episode.meta["metrics"]
    if metrics["bad"]:
        return "the physics diverged"
    if metrics["held"]:
        return "held"
    if metrics["moved_at_removal"] > _PUSHED:
        return "pushed away before the table went"
    if not metrics["links_at_removal"]:
        return "not touched when the table went"
    without_table = ~np.asarray(episode.arrays["table"], bool)
    height = np.asarray(episode.arrays["object_position"])[without_table, 2]
    fell = int(np.argmax(height < height[0] - _FALLEN))
    return f"slipped {fell * episode.meta['control_dt']:.2f} s after the table went"


def failure_sheet(
    evaluator: Evaluator, policy: PolicyBundle, constraint: str, path: pathlib.Path, successes: int, failures: int
) -> Sequence[str]:
    """Draws episodes of a row, failures first.

    Args:
      evaluator: of the policy.
      policy: for the title.
      constraint: name of the row.
      path: the PNG file to write.
      successes: how many to show.
      failures: how many to show, if there are so many.

    Returns:
      What became of each episode, in words.
    """
    episodes = evaluator.examples(constraint, successes, failures)
    images: list[np.ndarray] = []
    labels: list[str] = []
    causes = [cause(episode) for episode in episodes]
    for episode, what in zip(episodes, causes, strict=True):
        steps = key_steps(np.asarray(episode.arrays["table"], bool), _MOMENTS)
        images += render_episode_frames(episode, steps, _SIZE)
        seconds = [f"{episode.meta['control_dt'] * step:.2f} s" for step in steps]
        labels += [episode.meta["object"], *seconds[1:-1], f"{seconds[-1]}: {what}"]
    title = f"{policy.spec.hand} hand, version {policy.version}, {constraint}: {len(episodes)} episodes, failures first"
    save_png(path, contact_sheet(images, labels, columns=_MOMENTS, title=title))
    return causes
