"""Test on unseen geometry: the heading constraint over many different objects.

Objects come in pools of equal size (`services.evaluate.pools`). The result of a pool is a few numbers per episode. They
can be stored on disk, so that a stopped evaluation resumes at its current pool.
"""

import contextlib
import dataclasses
import functools
import json
import pathlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_file
from congrasp.common.policy.bundle import PolicyBundle, content_hash
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.task.config import TaskConfig
from congrasp.common.wire.codec import MAX_MESSAGE, Message, decode, encode
from congrasp.services.evaluate.episodes import Episodes
from congrasp.services.evaluate.evaluator import MEASURED, STRESSED, batch_of, simulate
from congrasp.services.evaluate.plan import batches, plan_row
from congrasp.services.evaluate.pools import Pool, Pools, one_ahead, prepared
from congrasp.services.evaluate.protocol import protocol, two_seconds
from congrasp.services.evaluate.scores import Row, Sample, joined, object_groups, summarise

_ROW = "heading"


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
        for pool in stack.enter_context(one_ahead(prepared(hand, task, pools, seed, todo, measured))):
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


def _simulated(
    running: Episodes,
    hand: Hand,
    task: TaskConfig,
    pool: Pool,
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
    except (LookupError, CongraspError):
        return None
