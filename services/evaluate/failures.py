"""Contact sheets of a row's failures and successes, with the cause of each failure."""

from collections.abc import Iterator, Sequence

import numpy as np

from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.wire.codec import Message
from congrasp.services.evaluate.evaluator import Evaluator
from congrasp.services.record.goals import phases_of
from congrasp.services.viz.render import episode_strip, grasp_steps
from congrasp.services.viz.sheets import contact_sheet

_FRAMES = 5
_SIZE = (300, 225)
_PUSHED = 0.05  # tolerated displacement of an object before the table is removed, m


def cause(episode: Message, drop_height: float) -> str:
    """Cause of an episode's end with the object `drop_height` (m) or more below its initial height, or `held`."""
    metrics = episode.meta["metrics"]
    if metrics.get("diverged"):
        return "the physics diverged"
    if metrics["held"]:
        return "held"
    moment = "the lift began" if "lift" in phases_of(episode.meta) else "the table was removed"
    if metrics["moved_at_removal"] > _PUSHED:
        return f"pushed away before {moment}"
    if not metrics["links_at_removal"]:
        return f"not touched when {moment}"
    seconds = (fall_step(episode, drop_height) - grasp_steps(episode)[1]) * episode.meta["control_dt"]
    return f"slipped {seconds:.2f} s after {moment}"


def fall_step(episode: Message, drop_height: float) -> int:
    """Step at which the object is `drop_height` (m) below its height at the table's removal, or the last one.

    In a lift the height is relative to the wrist.
    """
    removal = grasp_steps(episode)[1]
    height = np.asarray(episode.arrays["object_position"])[:, 2]
    if "lift" in phases_of(episode.meta):
        height = height - episode.arrays["link_position"][:, 0, 2]
    below = np.flatnonzero(height[removal:] < height[removal] - drop_height)
    return removal + int(below[0]) if len(below) else len(height) - 1


def failure_sheets(
    evaluator: Evaluator, policy: PolicyBundle, constraints: Sequence[str], successes: int, failures: int
) -> Iterator[tuple[str, np.ndarray, Sequence[str]]]:
    """Draws episodes of rows up to the step at which the object has fallen, or to the end, failures first.

    Args:
      evaluator: evaluator of the policy; episodes it kept are not evaluated again.
      policy: policy, for the titles.
      constraints: names of the rows.
      successes: number of successes to show for each row.
      failures: most failures to show for each row.

    Yields:
      For each row with an episode: its name, the sheet (H, W, 3) uint8, and the outcome of each episode.
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
