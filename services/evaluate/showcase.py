"""Showcase picture of a policy: a grasp under each constraint that it supports."""

import pathlib
from collections.abc import Callable

import numpy as np

from congrasp.common.config import ObjectsConfig
from congrasp.common.objects.pool import HELD_OUT_SEED, load_pool
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.runtime.parallel import cores
from congrasp.services.evaluate.evaluator import Evaluator
from congrasp.services.viz.render import episode_strip
from congrasp.services.viz.sheets import contact_sheet, save_png

_OBJECTS, _ATTEMPTS, _FRAMES = 12, 8, 4
_SIZE = (360, 270)


def showcase(
    policy: PolicyBundle, path: pathlib.Path, progress: Callable[[str], None] = lambda text: None
) -> dict[str, bool]:
    """Draws a grasp of a held-out object under each constraint, the first success of a few attempts.

    Args:
      policy: policy of any hand.
      path: the PNG file to write.
      progress: called with the current step.

    Returns:
      Success of the grasp by constraint.
    """
    objects = load_pool(ObjectsConfig(count=_OBJECTS, seed=HELD_OUT_SEED))
    evaluator = Evaluator(policy, objects, threads=cores())
    images: list[np.ndarray] = []
    labels: list[str] = []
    successes: dict[str, bool] = {}
    for constraint in policy.task.constraints:
        progress(f"grasping under the constraint '{constraint}'")
        episode = evaluator.episode(constraint, attempts=_ATTEMPTS)
        successes[constraint] = bool(episode.meta["success"])
        result = "success" if episode.meta["success"] else "no success"
        first = f"{constraint}: 0.00 s, {episode.meta['object']}"
        frames, captions = episode_strip(episode, _FRAMES, _SIZE, first, f", {result}")
        images += frames
        labels += captions
    title = f"{policy.spec.hand_name} hand, policy version {policy.version}: one grasp under each constraint"
    save_png(path, contact_sheet(images, labels, columns=_FRAMES, title=title))
    return successes
