"""Pools of objects: as many as there is time for, in sets that fit an engine.

Pools have one size, so that no program is compiled again, and only two are in memory: while the
episodes of one are simulated, the next is made or imported with its constraints.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import itertools
import logging
import math
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.closure import Outline, outline
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import object_scale
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.runtime.parallel import parallel_map
from congrasp.common.runtime.settings import library_settings
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.object_headings import headings_of
from congrasp.services.assets.objects.named import ObjectAt, load_each, objects_at
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.evaluate.choices import Exam
from congrasp.services.evaluate.exams import FAMILIES, first_seed
from congrasp.services.evaluate.experiment import (
    Experiment,
    silent,
)

_MAX_OBJECTS_ON_DEVICE = 4096
"""Most objects of a pool for engines on a device."""
MAX_OBJECTS_ELSEWHERE = 128
"""Most objects of a pool for other engines, which compile a scene for each."""
MAX_OBJECTS_OF_FOLDER = 512
"""Most objects of a pool of a folder, whose surfaces may be large."""
_UNCHANGED = ImportOptions()
_log = logging.getLogger(__name__)
_Item = TypeVar("_Item")


class Loaded(NamedTuple):
    """Objects of a pool, and names of those that could not be imported."""

    objects: list[GraspObject]
    left_out: list[str]


class Pools(NamedTuple):
    """Objects that are loaded in pools."""

    source: str
    """Identity of the objects, for that of results."""
    size: int
    """Objects of a pool; the last pools may have one less."""
    make: Sequence[Callable[[], Loaded]]


def procedural_pools(count: int, physics: PhysicsName, exam: Exam) -> Pools:
    """Returns at least `count` procedural objects of an exam, in pools of one size."""
    number, size = _divide(count, _max_objects(physics))
    seed = first_seed(exam, number * size)
    families = procedural.family_turns(number * size, seed, FAMILIES)

    def make(start: int) -> Loaded:
        seeds = range(seed + start, seed + start + size)
        return Loaded(parallel_map(procedural.generate, seeds, families[start:][:size]), [])

    starts = range(0, number * size, size)
    return Pools(f"procedural {seed}", size, [functools.partial(make, start) for start in starts])


def folder_pools(path: pathlib.Path, physics: PhysicsName) -> Pools:
    """The objects of a path, in pools that an engine can take."""
    objects = objects_at(path)
    identity = ",".join(f"{obj.name} {obj.digest()}" for obj in objects)
    return listed_pools(objects, most_objects(physics), source=identity)


def most_objects(physics: PhysicsName) -> int:
    """Most objects of a pool whose surfaces may be large."""
    return min(_max_objects(physics), MAX_OBJECTS_OF_FOLDER)


def _max_objects(physics: PhysicsName) -> int:
    """Most objects of a pool of procedural objects."""
    if ENGINES[physics].on_device:
        return _MAX_OBJECTS_ON_DEVICE
    return MAX_OBJECTS_ELSEWHERE


def listed_pools(
    objects: Sequence[ObjectAt], most: int, options: ImportOptions = _UNCHANGED, source: str = ""
) -> Pools:
    """Objects of different names in pools of at most `most`; meshes are imported when their turn
    comes, and those that cannot be are left out."""
    number, size = _divide(len(objects), most)

    def make(part: list[ObjectAt]) -> Loaded:
        left_out: list[str] = []

        def leave_out(obj: ObjectAt, error: CongraspError) -> None:
            _log.warning("%s is skipped: %s", obj.name, error)
            left_out.append(obj.name)

        imported = load_each(part, options, on_error=leave_out)
        names = [obj.name for obj in part if obj.name not in left_out]
        renamed = [
            dataclasses.replace(obj, name=name) for obj, name in zip(imported, names, strict=True)
        ]
        return Loaded(renamed, left_out)

    makers = []
    for indices in np.array_split(np.arange(len(objects)), number):
        part = [objects[i] for i in indices]
        makers.append(functools.partial(make, part))
    return Pools(source, size, makers)


def _divide(count: int, most: int) -> tuple[int, int]:
    """Number and size of pools for `count` objects, at most `most` in each."""
    number = math.ceil(count / most)
    return number, math.ceil(count / number)


class Pool(NamedTuple):
    """A pool that is ready for simulation."""

    experiment: Experiment
    """Its objects are the pool's; those from `real` on are repetitions that pad it. It has none if
    none remains.
    """
    real: int
    left_out: list[str]


@contextlib.contextmanager
def load_pools(
    experiment: Experiment, pools: Pools, numbers: Sequence[int]
) -> Iterator[Iterator[Pool]]:
    """Yields an experiment on each of some pools, made in a thread while the previous one is in
    use.
    """
    with _one_ahead(_load_pools(experiment, pools, numbers)) as ready:
        yield ready


def _load_pools(experiment: Experiment, pools: Pools, numbers: Sequence[int]) -> Iterator[Pool]:
    """Yields experiments on pools, with their constraints."""
    for number in numbers:
        loaded, left_out = pools.make[number]()
        of_pool = dataclasses.replace(experiment, pool=number, track=silent)
        of_pool, approachable = _with_approachable(of_pool, loaded, pools.size)
        if approachable:
            _ = of_pool.field  # computed in this thread
        remaining = {id(obj) for obj in approachable}
        lost = [obj.name for obj in loaded if id(obj) not in remaining]
        yield Pool(of_pool, len(approachable), [*left_out, *lost])


@contextlib.contextmanager
def _one_ahead(items: Iterator[_Item]) -> Iterator[Iterator[_Item]]:
    """Yields the same items, each computed in a thread while the previous one is in use."""
    following = library_settings()(next)
    with concurrent.futures.ThreadPoolExecutor(1) as background:

        def taken() -> Iterator[_Item]:
            coming = background.submit(following, items, None)
            while (item := coming.result()) is not None:
                coming = background.submit(following, items, None)
                yield item

        yield taken()


def _with_approachable(
    experiment: Experiment, objects: list[GraspObject], size: int
) -> tuple[Experiment, list[GraspObject]]:
    """Returns an experiment on `size` of the objects that the hand can approach in some resting
    pose, and all these.
    """
    while objects:
        padded = list(itertools.islice(itertools.cycle(objects), size))
        of_pool = dataclasses.replace(experiment, objects=padded)
        try:
            _ = of_pool.bank
            return of_pool, objects
        except CongraspError as error:
            have_headings = _have_headings(of_pool)
            if all(have_headings):
                raise
            _log.warning("%s", error)
            approachable = {
                id(obj)
                for obj, has_heading in zip(padded, have_headings, strict=True)
                if has_heading
            }
            objects = [obj for obj in objects if id(obj) in approachable]
    return dataclasses.replace(experiment, objects=()), []


def _have_headings(experiment: Experiment) -> list[bool]:
    """Returns for each object whether the hand can approach it."""
    task = experiment.task
    size = len(experiment.objects)
    return parallel_map(
        _has_heading,
        [task] * size,
        experiment.scaled,
        [(experiment.seed + experiment.pool, n) for n in range(size)],
        [object_scale(experiment.hand, task)] * size,
        itertools.repeat(outline(experiment.hand), size),
    )


def _has_heading(
    task: TaskConfig, obj: GraspObject, seed: tuple[int, int], scale: float, hand: Outline
) -> bool:
    """True if an object has a heading for the hand with this outline, and does not lie too flat for
    all of them.
    """
    try:
        return bool(headings_of(task, obj, seed, None, scale, hand)["weight"])
    except CongraspError:
        return False
