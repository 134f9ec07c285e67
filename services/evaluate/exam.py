"""Procedural objects of the two exams: one for published figures, one for development."""

import zlib
from typing import Literal

from congrasp.common.config import ObjectsConfig
from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import FIGURES_SEED, HELD_OUT_SEED, load_pool
from congrasp.common.objects.spec import GraspObject

Exam = Literal["figures", "development"]
FAMILIES = tuple(sorted(procedural.FAMILIES, key=lambda family: zlib.crc32(family.encode())))
"""All families, which take turns among an exam's objects, in an order that mixes basic and household ones."""
POOL = len(procedural.FAMILIES)
"""Objects of an exam's rows where no number is given: one of each family."""
_SEEDS: dict[Exam, int] = {"figures": FIGURES_SEED, "development": HELD_OUT_SEED}


def first_seed(exam: Exam, count: int) -> int:
    """Seed of the first of `count` objects of an exam.

    Raises:
      CongraspError: so many objects of the development exam would reach those for figures.
    """
    if exam == "development" and count > FIGURES_SEED - HELD_OUT_SEED:
        raise CongraspError(f"The development exam has no {count} objects.", "Name a smaller --pool.")
    return _SEEDS[exam]


def exam_pool(exam: Exam, count: int = 0) -> list[GraspObject]:
    """Objects of an exam; 0 takes `POOL`."""
    count = count or POOL
    return load_pool(ObjectsConfig(families=FAMILIES, count=count, seed=first_seed(exam, count)))
