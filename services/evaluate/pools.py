"""Pools of objects of equal size, made one after another with their constraints: as many objects as there is time for.

While the episodes of one pool are simulated the next is made or imported; no program is compiled for it, and only these
two are in memory.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import itertools
import logging
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands.closure import Outline, outline
from congrasp.common.hands.spec import Hand
from congrasp.common.objects import procedural
from congrasp.common.objects.distance import DistanceField, distance_field
from congrasp.common.objects.pool import object_scale, scale_objects
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.runtime.parallel import parallel_map
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.build import build_bank, headings_of
from congrasp.services.assets.objects.named import ObjectAt, load_each, objects_at
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.evaluate.exam import FAMILIES, Exam, first_seed

_MOST = {True: 4096, False: 128}
"""Objects of a pool, for engines on a device and for others; each has a compiled scene in the latter."""
_MESHES = 512
"""Objects of a pool of a folder, whose surfaces may be large."""
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
    """Description of the objects, for the identity of results."""
    size: int
    """Objects of a pool; the last pools may have one less."""
    make: list[Callable[[], Loaded]]


def procedural_pools(count: int, physics: PhysicsName, exam: Exam) -> Pools:
    """Returns at least `count` procedural objects of an evaluation set, in pools of one size."""
    number, size = _divided(count, _MOST[ENGINES[physics].on_device])
    seed = first_seed(exam, number * size)
    families = procedural.family_turns(number * size, seed, FAMILIES)

    def make(start: int) -> Loaded:
        seeds = range(seed + start, seed + start + size)
        return Loaded(parallel_map(procedural.generate, seeds, families[start:][:size]), [])

    starts = range(0, number * size, size)
    return Pools(f"procedural {seed}", size, [functools.partial(make, start) for start in starts])


def folder_pools(path: pathlib.Path, physics: PhysicsName) -> Pools:
    """The objects of a path, in pools that an engine can take."""
    return listed_pools(objects_at(path), most_objects(physics))


def most_objects(physics: PhysicsName) -> int:
    """Most objects of a pool whose surfaces may be large."""
    return min(_MOST[ENGINES[physics].on_device], _MESHES)


def listed_pools(found: Sequence[ObjectAt], most: int, options: ImportOptions = _UNCHANGED) -> Pools:
    """Objects of different names in pools of at most `most`; meshes are imported when their turn comes, and those that
    cannot be are left out."""
    number, size = _divided(len(found), most)

    def make(part: list[ObjectAt]) -> Loaded:
        left_out: list[str] = []

        def leave_out(one: ObjectAt, error: CongraspError) -> None:
            _log.warning("%s is skipped: %s", one.name, error)
            left_out.append(one.name)

        objects = load_each(part, options, on_error=leave_out)
        names = [one.name for one in part if one.name not in left_out]
        return Loaded([dataclasses.replace(obj, name=n) for obj, n in zip(objects, names, strict=True)], left_out)

    parts = [[found[i] for i in part] for part in np.array_split(np.arange(len(found)), number)]
    return Pools(",".join(one.name for one in found), size, [functools.partial(make, part) for part in parts])


class Pool(NamedTuple):
    """A pool that is ready for simulation."""

    number: int
    objects: list[GraspObject]
    """Objects scaled for the hand; those from `real` on are repetitions that pad the pool."""
    bank: ConstraintBank | None
    """None if no object remains."""
    field: DistanceField | None
    real: int
    left_out: list[str]


def _divided(count: int, most: int) -> tuple[int, int]:
    """Number and size of pools for `count` objects, at most `most` in each."""
    number = -(-count // most)
    return number, -(-count // number)


@contextlib.contextmanager
def one_ahead(items: Iterator[_Item]) -> Iterator[Iterator[_Item]]:
    """Yields the same items, each computed in a thread while the previous one is in use."""
    with concurrent.futures.ThreadPoolExecutor(1) as background:

        def taken() -> Iterator[_Item]:
            coming = background.submit(next, items, None)
            while (item := coming.result()) is not None:
                coming = background.submit(next, items, None)
                yield item

        yield taken()


def prepared(
    hand: Hand, task: TaskConfig, pools: Pools, seed: int, wanted: Sequence[int], measured: bool
) -> Iterator[Pool]:
    """Yields pools with their constraints."""
    for number in wanted:
        loaded, left_out = pools.make[number]()
        objects = scale_objects(hand, task, loaded)
        kept, bank = _with_bank(hand, task, objects, pools.size, seed + number)
        left_out = [*left_out, *(obj.name for obj in objects if all(obj is not other for other in kept))]
        filled = _filled(kept, pools.size)
        field = distance_field(filled) if measured and kept else None
        yield Pool(number, filled, bank, field, len(kept), left_out)


def _filled(objects: Sequence[GraspObject], size: int) -> list[GraspObject]:
    """Pads objects to `size` by repeating the first ones."""
    return list(itertools.islice(itertools.cycle(objects), size))


def _with_bank(
    hand: Hand, task: TaskConfig, objects: list[GraspObject], size: int, seed: int
) -> tuple[list[GraspObject], ConstraintBank | None]:
    """Returns the objects that the hand can approach in some resting pose, and a bank of `size` of them (`_filled`)."""
    while objects:
        filled = _filled(objects, size)
        try:
            return objects, build_bank(hand, task, filled, seed)
        except CongraspError as error:
            scale, seeds = object_scale(hand, task), [(seed, n) for n in range(size)]
            own = itertools.repeat(outline(hand), size)
            fine = parallel_map(_approachable, [task] * size, filled, seeds, [scale] * size, own)
            if all(fine):
                raise
            _log.warning("%s", error)
            lost = {id(obj) for obj, good in zip(filled, fine, strict=True) if not good}
            objects = [obj for obj in objects if id(obj) not in lost]
    return [], None


def _approachable(task: TaskConfig, obj: GraspObject, seed: tuple[int, int], scale: float, own: Outline) -> bool:
    """True if an object has a heading for the hand with this outline, and does not lie too flat for all of them."""
    try:
        return bool(headings_of(task, obj, seed, None, scale, own)["weight"])
    except CongraspError:
        return False
