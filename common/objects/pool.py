"""The objects of one actor or of one evaluation, from a run's configuration."""

import pathlib
from collections.abc import Sequence

from congrasp.common.config import ObjectsConfig, TaskConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects import procedural
from congrasp.common.objects.spec import GraspObject
from congrasp.common.objects.store import Catalogue

HELD_OUT_SEED = 1_000_000
"""Seeds from here upward are never trained on; those below `FIGURES_SEED` are for development."""
FIGURES_SEED = 2_000_000
"""Seeds from here upward are for figures alone: nothing is tuned on their objects."""


def load_pool(config: ObjectsConfig, shift: int = 0) -> list[GraspObject]:
    """Objects of a folder, or procedural ones.

    Args:
      config: which objects.
      shift: number of the actor: every actor has procedural objects of its own.

    Raises:
      CongraspError: the folder holds no object, or the count is not positive.
    """
    if config.folder:
        catalogue = Catalogue(pathlib.Path(config.folder))
        objects = [catalogue.get(name) for name in catalogue.list()]
        if not objects:
            raise CongraspError(
                f"The folder {config.folder} holds no object.", "Fill it with 'congrasp objects import'."
            )
        return objects
    if config.count < 1:
        raise CongraspError(f"A pool of {config.count} objects is empty.", "Set --objects.count to at least 1.")
    return procedural.generate_many(config.count, first_seed(config, shift), config.families)


def object_scale(hand: Hand, task: TaskConfig) -> float:
    """Factor on the lengths of this task's objects: the task's, or else the hand's own."""
    return task.object_scale or hand.object_scale


def scale_objects(hand: Hand, task: TaskConfig, objects: Sequence[GraspObject]) -> list[GraspObject]:
    """Objects in the size in which this hand grasps them."""
    return [obj.scaled(object_scale(hand, task), constant_mass=task.constant_mass) for obj in objects]


def first_seed(config: ObjectsConfig, shift: int) -> int:
    """The first seed of actor number `shift`: neighbours follow one another, and nobody reaches the held-out seeds."""
    if config.seed >= HELD_OUT_SEED:
        return config.seed
    return (config.seed + shift * config.count) % max(1, HELD_OUT_SEED - config.count + 1)
