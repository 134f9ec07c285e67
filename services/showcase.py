"""One picture of what a policy can do: a grasp under each of the four constraints."""

import os
import pathlib
from collections.abc import Callable

import numpy as np

from common.config import ObjectsConfig
from common.objects.pool import HELD_OUT_SEED, load_pool
from common.policy.bundle import PolicyBundle
from services.evaluate import Evaluator
from services.render import key_steps, render_episode_frames
from services.sheets import contact_sheet, save_png

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
        table = np.asarray(episode.arrays["table"], bool)
        steps = key_steps(table, _MOMENTS)
        images += render_episode_frames(episode, steps, _SIZE)
        successes += episode.meta["success"]
        result = "success" if episode.meta["success"] else "no success"
        seconds = [f"{episode.meta['control_dt'] * step:.2f} s" for step in steps]
        labels += [f"{constraint}: {seconds[0]}, {episode.meta['object']}", *seconds[1:-1], f"{seconds[-1]}, {result}"]
    title = f"{policy.spec.hand} hand, policy version {policy.version}: one grasp under each constraint"
    save_png(path, contact_sheet(images, labels, columns=_MOMENTS, title=title))
    return successes
