"""Objects of an evaluation or a dataset, divided into pools that an engine can simulate.

All pools of an evaluation have the same size, so that no program is compiled again. Only two are in
memory: while the episodes of one are simulated, a thread generates or imports the objects of the
next one and samples their constraints.
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
from typing import Any, NamedTuple, TypeVar

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.runtime.parallel import parallel_map
from congrasp.common.runtime.settings import library_settings
from congrasp.common.task.sampling.build import heading_arguments
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
MAX_OBJECTS_OFF_DEVICE = 128
"""Most objects of a pool for other engines, which compile a scene for each object."""
MAX_OBJECTS_WITH_MESHES = 512
"""Most objects of a pool of files on any engine, since their surfaces may be large."""
_UNCHANGED = ImportOptions()
_log = logging.getLogger(__name__)
_Item = TypeVar("_Item")


class LoadedObjects(NamedTuple):
    """Objects of a pool, and names of those that could not be imported."""

    objects: list[GraspObject]
    left_out: list[str]


class PoolLoaders(NamedTuple):
    """Functions that load the objects of each pool when its turn comes."""

    source: str
    """Text that identifies the objects of all pools; part of the key of stored results."""
    pool_size: int
    """Number of objects of a pool; the last pools may have one less."""
    loaders: Sequence[Callable[[], LoadedObjects]]
    """A function for each pool."""


class PreparedPool(NamedTuple):
    """A pool that is ready for simulation."""

    experiment: Experiment
    """Experiment on the pool's objects. The first `real_count` of its objects are the pool's, and
    the rest repeats them up to the size of all pools.
    """
    real_count: int
    """Number of the pool's objects; 0 if the hand can approach none of them."""
    left_out: list[str]
    """Names of objects that could not be imported, or that the hand cannot approach."""


def procedural_pools(count: int, physics: PhysicsName, exam: Exam) -> PoolLoaders:
    """Returns at least `count` procedural objects of an exam, in pools of one size."""
    pool_count, pool_size = _divide(count, _max_procedural_objects(physics))
    total = pool_count * pool_size
    seed = first_seed(exam, total)
    families = procedural.family_turns(total, seed, FAMILIES)

    def load(start: int) -> LoadedObjects:
        """Generates the pool whose first object has the index `start`."""
        seeds = range(seed + start, seed + start + pool_size)
        families_of_pool = families[start:][:pool_size]
        return LoadedObjects(parallel_map(procedural.generate, seeds, families_of_pool), [])

    loaders = [functools.partial(load, start) for start in range(0, total, pool_size)]
    return PoolLoaders(f"procedural {seed}", pool_size, loaders)


def folder_pools(path: pathlib.Path, physics: PhysicsName) -> PoolLoaders:
    """Returns the objects of a path, in pools that an engine can simulate."""
    objects = objects_at(path)
    identity = ",".join(f"{obj.name} {obj.digest()}" for obj in objects)
    return listed_pools(objects, max_objects_with_meshes(physics), source=identity)


def max_objects_with_meshes(physics: PhysicsName) -> int:
    """Most objects of a pool whose surfaces may be large."""
    return min(_max_procedural_objects(physics), MAX_OBJECTS_WITH_MESHES)


def _max_procedural_objects(physics: PhysicsName) -> int:
    """Most objects of a pool of procedural objects, whose surfaces are small."""
    if ENGINES[physics].on_device:
        return _MAX_OBJECTS_ON_DEVICE
    return MAX_OBJECTS_OFF_DEVICE


def listed_pools(
    objects: Sequence[ObjectAt],
    max_pool_size: int,
    options: ImportOptions = _UNCHANGED,
    source: str = "",
) -> PoolLoaders:
    """Divides objects into pools of at most `max_pool_size`.

    A pool's files are read or imported when its turn comes. Objects that cannot be imported are
    left out.

    Args:
      objects: objects with different names.
      max_pool_size: most objects of a pool.
      options: options of the import of meshes.
      source: see `PoolLoaders.source`.
    """
    pool_count, pool_size = _divide(len(objects), max_pool_size)
    loaders = []
    for indices in np.array_split(np.arange(len(objects)), pool_count):
        objects_of_pool = [objects[i] for i in indices]
        loaders.append(functools.partial(_load_listed, objects_of_pool, options))
    return PoolLoaders(source, pool_size, loaders)


def _load_listed(objects: Sequence[ObjectAt], options: ImportOptions) -> LoadedObjects:
    """Loads the objects of a pool of `listed_pools`."""
    left_out: list[str] = []

    def leave_out(obj: ObjectAt, error: CongraspError) -> None:
        """Records an object that cannot be imported."""
        _log.warning("%s is skipped: %s", obj.name, error)
        left_out.append(obj.name)

    imported = load_each(objects, options, on_error=leave_out)
    # An import names its object by its file, and files of two folders may have the same name.
    names = [obj.name for obj in objects if obj.name not in left_out]
    renamed = [
        dataclasses.replace(obj, name=name) for obj, name in zip(imported, names, strict=True)
    ]
    return LoadedObjects(renamed, left_out)


def _divide(count: int, max_pool_size: int) -> tuple[int, int]:
    """Returns the number of pools for `count` objects, which is at least 1, and their size."""
    pool_count = math.ceil(count / max_pool_size)
    return pool_count, math.ceil(count / pool_count)


@contextlib.contextmanager
def prepare_pools(
    experiment: Experiment, pools: PoolLoaders, pool_indices: Sequence[int]
) -> Iterator[Iterator[PreparedPool]]:
    """Context with an iterator over prepared pools.

    A thread prepares the next pool while the caller uses the current one.

    Args:
      experiment: settings of the experiments.
      pools: all pools.
      pool_indices: indices of the pools to prepare.
    """
    with _prefetch(_prepare(experiment, pools, pool_indices)) as prepared:
        yield prepared


def _prepare(
    experiment: Experiment, pools: PoolLoaders, pool_indices: Sequence[int]
) -> Iterator[PreparedPool]:
    """Yields the experiment on each pool, with its constraints."""
    for pool_index in pool_indices:
        loaded, not_imported = pools.loaders[pool_index]()
        settings = dataclasses.replace(experiment, pool=pool_index, track=silent)
        on_pool, real_objects = _on_approachable(settings, loaded, pools.pool_size)
        if real_objects:
            _ = on_pool.field  # computes the grids now, in this thread
        real_ids = {id(obj) for obj in real_objects}
        not_approachable = [obj.name for obj in loaded if id(obj) not in real_ids]
        yield PreparedPool(on_pool, len(real_objects), [*not_imported, *not_approachable])


@contextlib.contextmanager
def _prefetch(items: Iterator[_Item]) -> Iterator[Iterator[_Item]]:
    """Context with an iterator over the same items.

    A thread computes the next item while the caller uses the current one.
    """

    def next_item() -> _Item | None:
        """Computes the next item; None after the last one."""
        with library_settings():
            return next(items, None)

    with concurrent.futures.ThreadPoolExecutor(1) as background:

        def in_turn() -> Iterator[_Item]:
            """Yields the items, and lets the thread begin with the next one before each."""
            future = background.submit(next_item)
            while (item := future.result()) is not None:
                future = background.submit(next_item)
                yield item

        yield in_turn()


def _on_approachable(
    experiment: Experiment, objects: Sequence[GraspObject], pool_size: int
) -> tuple[Experiment, Sequence[GraspObject]]:
    """Leaves out the objects that the hand cannot approach, and repeats the others up to the size
    of a pool.

    Every repetition of an object has other random headings. An object is also left out if one of
    its repetitions cannot be approached. One that lies too flat remains, and no episode draws it.

    Args:
      experiment: experiment without objects.
      objects: the pool's objects.
      pool_size: number of objects of the result.

    Returns:
      The experiment on `pool_size` objects, with its bank computed, and the objects that remain;
      both without objects if none can be grasped.
    """
    remaining = list(objects)
    while remaining:
        padded = list(itertools.islice(itertools.cycle(remaining), pool_size))
        on_padded = dataclasses.replace(experiment, objects=padded)
        try:
            _ = on_padded.bank  # computes the bank
            return on_padded, remaining
        except CongraspError as error:
            weights = _heading_weights(on_padded)
            unreachable = {i % len(remaining) for i, w in enumerate(weights) if w is None}
            if not unreachable and any(weights):
                raise  # the fault is not one of the objects
            _log.warning("%s", error)
            if not unreachable:  # all objects lie too flat
                break
        remaining = [obj for i, obj in enumerate(remaining) if i not in unreachable]
    return dataclasses.replace(experiment, objects=()), []


def _heading_weights(experiment: Experiment) -> list[float | None]:
    """Returns the weight of each object: 0 if it lies too flat; None if the hand cannot approach
    it in any resting pose.
    """
    columns = heading_arguments(
        experiment.hand,
        experiment.task,
        experiment.scaled,
        experiment.seed + experiment.pool,
    )
    return parallel_map(_heading_weight, *columns)


def _heading_weight(*arguments: Any) -> float | None:
    """Weight of the object with these arguments of `headings_of`; None if that raises an error."""
    try:
        return float(headings_of(*arguments)["weight"])
    except CongraspError:
        return None
