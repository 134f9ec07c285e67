"""Test on unseen geometry: the heading constraint over many different objects.

Objects come in pools of equal size. While the episodes of one are simulated, the next is generated or imported with its
constraints, without compilation; only these two are in memory. The result of a pool is a few numbers per episode, which
can be stored on disk, so that a stopped evaluation resumes at its current pool.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import itertools
import json
import logging
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from congrasp.common.config import TaskConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.outline import Outline, outline
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_file
from congrasp.common.objects import procedural
from congrasp.common.objects.distance import DistanceField, distance_field
from congrasp.common.objects.pool import object_scale, scale_objects
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy.bundle import PolicyBundle, content_hash
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.runtime.parallel import parallel_map
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.build import build_bank, headings_of
from congrasp.common.wire.codec import MAX_MESSAGE, Message, decode, encode
from congrasp.services.assets.objects.named import ObjectAt, load_each, objects_at
from congrasp.services.evaluate.episodes import Episodes
from congrasp.services.evaluate.evaluator import MEASURED, STRESSED, batch_of, simulate
from congrasp.services.evaluate.exam import FAMILIES, Exam, first_seed
from congrasp.services.evaluate.plan import batches, plan_row
from congrasp.services.evaluate.protocol import protocol, two_seconds
from congrasp.services.evaluate.scores import Row, Sample, joined, object_groups, summarise

_ROW = "heading"
_MOST = {True: 4096, False: 128}
"""Objects of a pool, for engines on a device and for others, which compile a scene for each."""
_MESHES = 512
"""Objects of a pool from a folder, whose surfaces may be large."""
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
    """Returns the objects of a path; meshes are imported when needed, and those that cannot be are skipped."""
    found = objects_at(path)
    number, size = _divided(len(found), min(_MOST[ENGINES[physics].on_device], _MESHES))

    def make(part: list[ObjectAt]) -> Loaded:
        left_out: list[str] = []

        def leave_out(one: ObjectAt, error: CongraspError) -> None:
            _log.warning("%s is skipped: %s", one.name, error)
            left_out.append(one.name)

        return Loaded(load_each(part, on_error=leave_out), left_out)

    parts = [[found[i] for i in part] for part in np.array_split(np.arange(len(found)), number)]
    names = ",".join(one.name for one in found)
    return Pools(f"{path} {names}", size, [functools.partial(make, part) for part in parts])


def evaluate_objects(
    bundle: PolicyBundle,
    pools: Pools,
    episodes: int,
    *,
    physics: PhysicsName,
    batch: int,
    threads: int,
    seed: int,
    friction: float,
    keep: pathlib.Path | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Row]:
    """Evaluates rows of the heading constraint: all objects, then by size, mass and family.

    Args:
      bundle: the policy.
      pools: pools of objects.
      episodes: least total number; every object has the same number.
      physics: engine, except `auto`.
      batch: number of parallel worlds; 0 uses the engine's default.
      threads: threads of the `native` engine.
      seed: seed of constraints and episodes.
      friction: sliding friction between hand and object.
      keep: folder for results of pools, from which an evaluation with the same arguments resumes; None stores none.
      progress: called with the number of finished episodes.

    Raises:
      CongraspError: the hand can approach none of the objects.
    """
    hold, hand, number = two_seconds(bundle.task), get_hand(bundle.spec.hand), len(pools.make)
    task = protocol(bundle.task, hold, friction)
    each = -(-episodes // (pools.size * number))
    policy = content_hash(encode(bundle.to_message()))
    about = {"policy": policy, "task": repr(task), "source": pools.source, "physics": physics, "seed": seed}
    about |= {"size": pools.size, "each": each}
    found = {n: kept for n in range(number) if keep and (kept := _read(_file(keep, n), about))}
    todo = sorted(set(range(number)) - set(found))
    settings: dict[str, Any] = {"hold": hold, "physics": physics, "threads": threads}
    settings["batch"] = batch_of(each * pools.size, batch or ENGINES[physics].batch)
    with contextlib.ExitStack() as stack:
        running: Episodes | None = None
        measured = pools.size * number <= MEASURED
        for pool in stack.enter_context(_one_ahead(_prepared(hand, task, pools, seed, todo, measured))):
            done = sum(result.episodes for result in found.values())
            if pool.bank is None:
                result = _nothing(pool.left_out)
            else:
                if running is None:
                    running = stack.enter_context(Episodes(bundle, task, pool.objects, field=pool.field, **settings))
                else:
                    running.replace_objects(pool.objects, pool.field)
                advance = functools.partial(lambda before, n: progress(before + n), done)
                result = _simulated(running, hand, task, pool, each, seed, advance, max(0, STRESSED - done))
            if done:
                result = result._replace(sample=_without_forces(result.sample))
            if keep:
                _write(_file(keep, pool.number), result, about)
            found[pool.number] = result
    return _rows([found[n] for n in sorted(found)], hand, task.method)


class _Pool(NamedTuple):
    """A pool that is ready for simulation."""

    number: int
    objects: list[GraspObject]
    """Objects scaled for the hand; those from `real` on are repetitions that pad the pool."""
    bank: ConstraintBank | None
    """None if no object remains."""
    field: DistanceField | None
    real: int
    left_out: list[str]


class _Result(NamedTuple):
    """Result of a pool: its episodes, and name, largest side (m), mass (kg) and family of each object."""

    sample: Sample
    names: list[str]
    traits: np.ndarray
    """(N, 2) side and mass."""
    families: list[str]
    left_out: list[str]

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.sample.values.get("success", ()))


def _nothing(left_out: list[str]) -> _Result:
    """Returns the result of a pool without objects."""
    return _Result(Sample({}, np.zeros(0), np.zeros(0)), [], np.zeros((0, 2)), [], left_out)


def _divided(count: int, most: int) -> tuple[int, int]:
    """Number and size of pools for `count` objects, at most `most` in each."""
    number = -(-count // most)
    return number, -(-count // number)


@contextlib.contextmanager
def _one_ahead(items: Iterator[_Item]) -> Iterator[Iterator[_Item]]:
    """Yields the same items, each computed in a thread while the previous one is in use."""
    with concurrent.futures.ThreadPoolExecutor(1) as background:

        def taken() -> Iterator[_Item]:
            coming = background.submit(next, items, None)
            while (item := coming.result()) is not None:
                coming = background.submit(next, items, None)
                yield item

        yield taken()


def _prepared(
    hand: Hand, task: TaskConfig, pools: Pools, seed: int, wanted: Sequence[int], measured: bool
) -> Iterator[_Pool]:
    """Yields pools with their constraints."""
    for number in wanted:
        loaded, left_out = pools.make[number]()
        objects = scale_objects(hand, task, loaded)
        kept, bank = _with_bank(hand, task, objects, pools.size, seed + number)
        left_out = [*left_out, *(obj.name for obj in objects if all(obj is not other for other in kept))]
        filled = _filled(kept, pools.size)
        field = distance_field(filled) if measured and kept else None
        yield _Pool(number, filled, bank, field, len(kept), left_out)


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
    """True if an object has a heading for the hand with this outline."""
    try:
        headings_of(task, obj, seed, None, scale, own)
    except CongraspError:
        return False
    return True


def _simulated(
    running: Episodes,
    hand: Hand,
    task: TaskConfig,
    pool: _Pool,
    each: int,
    seed: int,
    progress: Callable[[int], None],
    stressed: int,
) -> _Result:
    """Simulates the episodes of a pool."""
    assert pool.bank is not None
    plan = plan_row(task, pool.bank, pool.objects, _ROW, each * len(pool.objects))
    conditions = batches(hand, task, pool.bank, plan, seed, running.batch)
    sample = simulate(running, conditions, plan.total, progress, stressed=stressed)
    objects = pool.objects[: pool.real]
    traits = np.array([(np.ptp(obj.visual_vertices, axis=0).max(), obj.mass) for obj in objects])
    sample = sample.where(sample.values["object_index"] < pool.real)
    return _Result(sample, [obj.name for obj in objects], traits, [obj.family for obj in objects], pool.left_out)


def _without_forces(sample: Sample) -> Sample:
    """Drops everything but the metrics: forces are read from the first pool."""
    return dataclasses.replace(sample, link_force=sample.link_force[:0], torque=sample.torque[:0])


def _rows(results: Sequence[_Result], hand: Hand, method: str) -> list[Row]:
    """Returns the rows of all objects, then of groups."""
    left_out = [name for result in results for name in result.left_out]
    results = [result for result in results if result.episodes]
    if not results:
        raise CongraspError("None of the objects can be approached.", "Scale them for the hand, or pass others.")
    firsts = np.cumsum([0, *(len(result.names) for result in results)])
    for result, first in zip(results, firsts, strict=False):
        result.sample.values["object_index"] = result.sample.values["object_index"] + first
    whole = joined([result.sample for result in results])
    index = whole.values["object_index"].astype(int)
    names = [name for result in results for name in result.names]
    names += left_out
    sizes, masses = np.concatenate([result.traits for result in results]).T
    families = np.array([family for result in results for family in result.families])
    row = functools.partial(summarise, _ROW, hand.name, held_2s=True, objects=names, method=method, paper="objects")
    rows = [row(sample=whole)]
    for label, members in object_groups(sizes, masses, families):
        chosen = members[index]
        if chosen.any():
            rows.append(row(sample=whole.where(chosen), pool=int(members.sum()), group=label))
    return rows


def _file(folder: pathlib.Path, number: int) -> pathlib.Path:
    """Path of a pool's result."""
    return folder / f"pool-{number:05d}.safetensors"


def _write(path: pathlib.Path, result: _Result, about: dict[str, Any]) -> None:
    """Writes a result and its identity."""
    arrays = {f"values/{name}": column for name, column in result.sample.values.items()}
    arrays |= {"link_force": result.sample.link_force, "torque": result.sample.torque, "traits": result.traits}
    lists = {"names": result.names, "families": result.families, "left_out": result.left_out}
    write_atomically(path, encode(Message(arrays, {**lists, "about": json.dumps(about)})))


def _read(path: pathlib.Path, about: dict[str, Any]) -> _Result | None:
    """Reads a result with the same arguments; returns None if it is missing or damaged."""
    try:
        message = decode(read_file(path, MAX_MESSAGE))
        if message.meta["about"] != json.dumps(about):
            return None
        arrays, meta = message.arrays, message.meta
        values = {name.removeprefix("values/"): x for name, x in arrays.items() if name.startswith("values/")}
        sample = Sample(values, arrays["link_force"], arrays["torque"])
        return _Result(sample, meta["names"], arrays["traits"], meta["families"], meta["left_out"])
    except (OSError, LookupError, CongraspError):
        return None
