"""Object pool of an actor or an evaluation, from a run's configuration."""

import pathlib
from collections.abc import Sequence

from congrasp.common.config import ObjectsConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects import procedural
from congrasp.common.objects.spec import GraspObject
from congrasp.common.objects.store import Catalogue
from congrasp.common.task.config import TaskConfig

HELD_OUT_SEED = 1_000_000
"""Seeds from here upward are never used for training; those below `FIGURES_SEED` are for
development.
"""
FIGURES_SEED = 2_000_000
"""Seeds from here upward are for published figures only: nothing is tuned on their objects."""


def load_pool(config: ObjectsConfig, shift: int = 0) -> list[GraspObject]:
    """Returns the objects of a folder, or procedural ones.

    Args:
      config: configuration of the objects.
      shift: number of the actor; each actor has different procedural objects.

    Raises:
      CongraspError: the folder holds no object, or the count is not positive.
    """
    if config.folder:
        catalogue = Catalogue(pathlib.Path(config.folder))
        objects = [catalogue.get(name) for name in catalogue.list()]
        if not objects:
            raise CongraspError(
                f"The folder {config.folder} contains no object.",
                "Import objects into it with 'congrasp objects import'.",
            )
        return objects
    if config.count < 1:
        raise CongraspError(
            f"The pool is empty: objects.count is {config.count}.",
            "Set --objects.count to at least 1.",
        )
    return procedural.generate_many(config.count, first_seed(config, shift), config.families)


def object_scale(hand: Hand, task: TaskConfig) -> float:
    """Factor on object lengths: the task's, or else the hand's default."""
    return task.object_scale or hand.object_scale


def scale_objects(
    hand: Hand, task: TaskConfig, objects: Sequence[GraspObject]
) -> list[GraspObject]:
    """Returns the objects in the size in which this hand grasps them."""
    return [
        obj.scaled(object_scale(hand, task), constant_mass=task.constant_mass) for obj in objects
    ]


def first_seed(config: ObjectsConfig, shift: int) -> int:
    """First seed of actor number `shift`: ranges of actors are disjoint while all fit below the
    held-out seeds.
    """
    if config.seed >= HELD_OUT_SEED:
        return config.seed
    number, offset = divmod(config.seed, config.count)
    return (
        offset + (number + shift) % max(1, (HELD_OUT_SEED - offset) // config.count) * config.count
    )
