"""Procedural objects of the two exams: one for published figures, one for development."""

import zlib

from congrasp.common.config import ObjectsConfig
from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import FIGURES_SEED, HELD_OUT_SEED, load_pool
from congrasp.common.objects.spec import GraspObject
from congrasp.services.evaluate.choices import Exam

FAMILIES = tuple(sorted(procedural.FAMILIES, key=lambda family: zlib.crc32(family.encode())))
"""All families, cycled among the objects in an order that mixes basic and household ones."""
MANY = 50_000
"""Most procedural objects of the table `objects` by default."""
_SEEDS: dict[Exam, int] = {"figures": FIGURES_SEED, "development": HELD_OUT_SEED}


def first_seed(exam: Exam, count: int) -> int:
    """Seed of the first of `count` objects of an exam.

    Raises:
      CongraspError: that many objects of the development exam would overlap those for figures.
    """
    if exam == "development" and count > FIGURES_SEED - HELD_OUT_SEED:
        raise CongraspError(
            f"The development set does not have {count} objects.", "Pass a smaller --pool."
        )
    return _SEEDS[exam]


def exam_pool(exam: Exam, count: int = 0) -> list[GraspObject]:
    """Returns the objects of an exam; 0 takes one of each family."""
    count = count or len(FAMILIES)
    return load_pool(ObjectsConfig(families=FAMILIES, count=count, seed=first_seed(exam, count)))
