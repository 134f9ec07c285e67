"""Objects of evaluations: the procedural ones of the two exams, and pools of as many as there is
time for.

Pools have one size, so that no program is compiled again, and only two are in memory: while the
episodes of one are simulated, the next is made or imported with its constraints. The result of a
pool is a few numbers per episode, which can be stored on disk, so that a stopped evaluation resumes
at its current pool.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import itertools
import logging
import math
import pathlib
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from congrasp.common.config import ObjectsConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands.closure import Outline, outline
from congrasp.common.io.files import keep, read_kept
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import FIGURES_SEED, HELD_OUT_SEED, load_pool, object_scale
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.runtime.parallel import parallel_map
from congrasp.common.runtime.settings import library_settings
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.object_headings import headings_of
from congrasp.common.wire.codec import Message
from congrasp.services.assets.objects.named import ObjectAt, load_each, objects_at
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.evaluate.choices import Exam
from congrasp.services.evaluate.episodes import Episodes, Sample, joined
from congrasp.services.evaluate.experiment import (
    MEASURED,
    STRESSED,
    Experiment,
    Variation,
    advance_from,
    silent,
)
from congrasp.services.evaluate.object_groups import object_groups
from congrasp.services.evaluate.scores import Row, RowDescription, summarise

FAMILIES = tuple(sorted(procedural.FAMILIES, key=lambda family: zlib.crc32(family.encode())))
"""All families, cycled among the objects in an order that mixes basic and household ones."""
MANY = 50_000
"""Most procedural objects of the table `objects` by default."""
_SEEDS: dict[Exam, int] = {"figures": FIGURES_SEED, "development": HELD_OUT_SEED}
_MAX_OBJECTS_ON_DEVICE = 4096
"""Most objects of a pool for engines on a device."""
_MAX_OBJECTS_ELSEWHERE = 128
"""Most objects of a pool for other engines, which compile a scene for each."""
_MAX_OBJECTS_OF_FOLDER = 512
"""Most objects of a pool of a folder, whose surfaces may be large."""
_UNCHANGED = ImportOptions()
_log = logging.getLogger(__name__)
_Item = TypeVar("_Item")


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
    number, size = _divided(count, _max_objects(physics))
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
    return min(_max_objects(physics), _MAX_OBJECTS_OF_FOLDER)


def _max_objects(physics: PhysicsName) -> int:
    """Most objects of a pool of procedural objects."""
    if ENGINES[physics].on_device:
        return _MAX_OBJECTS_ON_DEVICE
    return _MAX_OBJECTS_ELSEWHERE


def listed_pools(
    objects: Sequence[ObjectAt], most: int, options: ImportOptions = _UNCHANGED, source: str = ""
) -> Pools:
    """Objects of different names in pools of at most `most`; meshes are imported when their turn
    comes, and those that cannot be are left out."""
    number, size = _divided(len(objects), most)

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


def _divided(count: int, most: int) -> tuple[int, int]:
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
def prepared(
    experiment: Experiment, pools: Pools, numbers: Sequence[int]
) -> Iterator[Iterator[Pool]]:
    """Yields an experiment on each of some pools, made in a thread while the previous one is in
    use.
    """
    with _one_ahead(_prepared(experiment, pools, numbers)) as ready:
        yield ready


def _prepared(experiment: Experiment, pools: Pools, numbers: Sequence[int]) -> Iterator[Pool]:
    """Yields experiments on pools, with their constraints."""
    for number in numbers:
        loaded, left_out = pools.make[number]()
        of_pool, approachable = _approachable(
            dataclasses.replace(experiment, pool=number, track=silent), loaded, pools.size
        )
        lost = [obj.name for obj in loaded if all(obj is not other for other in approachable)]
        if approachable:
            _ = of_pool.field  # computed in this thread
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


def _approachable(
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
            approachable = _have_headings(of_pool)
            if all(approachable):
                raise
            _log.warning("%s", error)
            lost = {id(obj) for obj, kept in zip(padded, approachable, strict=True) if not kept}
            objects = [obj for obj in objects if id(obj) not in lost]
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


class _Result(NamedTuple):
    """Result of a pool: its episodes, and name, largest side (m), mass (kg) and family of each
    object.
    """

    sample: Sample
    objects: list[tuple[str, float, float, str]]
    left_out: list[str]

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.sample.values.get("success", ()))

    def message(self) -> Message:
        """Returns the result for a file."""
        return Message(self.sample.arrays(), {"objects": self.objects, "left_out": self.left_out})


def evaluate_pools(
    experiment: Experiment, pools: Pools, stored: pathlib.Path | None = None
) -> list[Row]:
    """Evaluates rows of the heading constraint on unseen geometry: all objects, then by size, mass
    and family.

    Args:
      experiment: policy and settings; `episodes` is the least total number, and every object has
        the same number.
      pools: pools of objects.
      stored: folder for results of pools, from which an evaluation with the same arguments resumes;
        None stores none.

    Raises:
      CongraspError: the hand can approach none of the objects.
    """
    number = len(pools.make)
    episodes_of_object = math.ceil(experiment.episodes / (pools.size * number))
    total = episodes_of_object * pools.size * number
    advance = experiment.track("Episodes on many objects", total)
    experiment = dataclasses.replace(
        experiment,
        constraints=None,
        episodes=episodes_of_object * pools.size,
        measured=pools.size * number <= MEASURED,
    )
    files: list[pathlib.Path | None] = [None] * number
    if stored is not None:
        name = experiment.digest(pools.source, pools.size)
        files = [stored / f"{name}-{n:05d}.safetensors" for n in range(number)]
    results = {}
    for n, file in enumerate(files):
        message = None if file is None else read_kept(file)
        if message is not None:
            results[n] = _stored(message)
    missing = [n for n in range(number) if n not in results]
    with contextlib.ExitStack() as stack, prepared(experiment, pools, missing) as ready:
        running: Episodes | None = None
        for pool in ready:
            if pool.real and not running:
                running = stack.enter_context(pool.experiment.simulator())
            finished = sum(result.episodes for result in results.values())
            progress = functools.partial(advance_from, advance, finished)
            result = _simulated(running, pool, progress, max(0, STRESSED - finished))
            if finished:  # forces are read from the first pool
                result = result._replace(sample=result.sample.without_forces())
            n = pool.experiment.pool
            results[n] = result
            file = files[n]
            if file is not None:
                keep(file, result.message(), number)
    return _rows([results[n] for n in sorted(results)], experiment)


def _simulated(
    running: Episodes | None, pool: Pool, progress: Callable[[int], None], stressed: int
) -> _Result:
    """Simulates the episodes of a pool, if it has objects."""
    if not running or not pool.real:
        return _Result(Sample({}, np.zeros(0), np.zeros(0)), [], pool.left_out)
    experiment = pool.experiment
    row = Variation()
    plan = experiment.plan(row)
    sample = experiment.sample(running, row, plan, progress, stressed=stressed)
    facts = []
    for obj in experiment.scaled[: pool.real]:
        largest_side = float(np.ptp(obj.visual_vertices, axis=0).max())
        facts.append((obj.name, largest_side, float(obj.mass), obj.family))
    not_padding = sample.values["object_index"] < pool.real
    return _Result(sample.where(not_padding), facts, pool.left_out)


def _rows(results: Sequence[_Result], experiment: Experiment) -> list[Row]:
    """Returns the rows of all objects, then of groups."""
    left_out = [name for result in results for name in result.left_out]
    results = [result for result in results if result.episodes]
    if not results:
        raise CongraspError(
            "None of the objects can be approached.", "Scale them for the hand, or pass others."
        )
    first = 0
    facts = []
    for result in results:
        result.sample.values["object_index"] = result.sample.values["object_index"] + first
        first += len(result.objects)
        facts += result.objects
    whole = joined([result.sample for result in results])
    index = whole.values["object_index"].astype(int)
    names, sizes, masses, families = zip(*facts, strict=True)
    all_objects = RowDescription(
        Variation().constraint,
        experiment.hand.name,
        [*names, *left_out],
        held_2s=True,
        method=experiment.task.method,
        paper="objects",
    )
    rows = [summarise(all_objects, whole)]
    for label, members in object_groups(np.array(sizes), np.array(masses), np.array(families)):
        chosen = members[index]
        if chosen.any():
            group = dataclasses.replace(all_objects, pool=int(members.sum()), group=label)
            rows.append(summarise(group, whole.where(chosen)))
    return rows


def _stored(message: Message) -> _Result:
    """Returns the result of its `message`."""
    facts = [tuple(facts) for facts in message.meta["objects"]]
    return _Result(Sample.of(message.arrays), facts, message.meta["left_out"])
