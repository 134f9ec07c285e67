"""One picture of what a policy can do: a grasp under each of the four constraints."""

import os
import pathlib
from collections.abc import Callable

import numpy as np

from common.config import ObjectsConfig
from common.objects.pool import HELD_OUT_SEED, load_pool
from common.policy.bundle import PolicyBundle
from services.evaluate.evaluator import Evaluator
from services.viz.render import episode_strip
from services.viz.sheets import contact_sheet, save_png

CONSTRAINTS = ("heading", "pose", "trajectory", "affordance")
"""Rows of the picture."""
_OBJECTS, _TRIES, _MOMENTS = 12, 8, 4
_SIZE = (360, 270)


def showcase(policy: PolicyBundle, path: pathlib.Path, progress: Callable[[str], None] = lambda text: None) -> int:
    """Draws a grasp of a held-out object under each constraint, the first success of a few tries.

    Args:
      policy: of any hand.
      path: the PNG file to write.
      progress: told what is being done.

    Returns:
      How many of the grasps succeeded.
    """
    objects = load_pool(ObjectsConfig(count=_OBJECTS, seed=HELD_OUT_SEED))
    evaluator = Evaluator(policy, objects, threads=os.cpu_count() or 1)
    images: list[np.ndarray] = []
    labels: list[str] = []
    successes = 0
    for constraint in CONSTRAINTS:
        progress(f"grasping under the constraint '{constraint}'")
        episode = evaluator.episode(constraint, tries=_TRIES)
        successes += episode.meta["success"]
        result = "success" if episode.meta["success"] else "no success"
        begins = f"{constraint}: 0.00 s, {episode.meta['object']}"
        pictures, words = episode_strip(episode, _MOMENTS, _SIZE, begins, f", {result}")
        images += pictures
        labels += words
    title = f"{policy.spec.hand_name} hand, policy version {policy.version}: one grasp under each constraint"
    save_png(path, contact_sheet(images, labels, columns=_MOMENTS, title=title))
    return successes
