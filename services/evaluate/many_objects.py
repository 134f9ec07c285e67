"""Rows of the heading constraint on many objects, evaluated pool by pool.

The result of a pool is a few numbers per episode, which can be stored on disk, so that a stopped
evaluation resumes at its current pool.
"""

import contextlib
import dataclasses
import functools
import itertools
import math
import pathlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import keep, read_kept
from congrasp.common.wire.codec import Message
from congrasp.services.evaluate.episodes import Episodes, Sample, join_samples
from congrasp.services.evaluate.experiment import (
    MAX_MEASURED_OBJECTS,
    MIN_STRESSED_EPISODES,
    Experiment,
    Variation,
    advance_from,
)
from congrasp.services.evaluate.object_groups import object_groups
from congrasp.services.evaluate.pools import PoolLoaders, PreparedPool, prepare_pools
from congrasp.services.evaluate.scores import Row, RowDescription, summarise


class _ObjectFacts(NamedTuple):
    """Facts by which objects are grouped."""

    name: str
    largest_side: float
    """m."""
    mass: float
    """kg."""
    family: str


class _Result(NamedTuple):
    """Result of a pool."""

    sample: Sample
    """Measures of the pool's episodes; empty if none of its objects could be grasped."""
    objects: list[_ObjectFacts]
    left_out: list[str]
    """Names of objects that could not be used."""

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.sample.values.get("success", ()))

    def message(self) -> Message:
        """Returns the result for a file."""
        return Message(self.sample.arrays(), {"objects": self.objects, "left_out": self.left_out})


def evaluate_pools(
    experiment: Experiment, pools: PoolLoaders, stored: pathlib.Path | None = None
) -> list[Row]:
    """Evaluates rows of the heading constraint on unseen geometry: all objects, then by size, mass
    and family.

    Args:
      experiment: policy and settings; `episodes` is the least total number. All objects of a pool
        have the same number of episodes, except those that lie too flat, which have none.
      pools: pools of objects.
      stored: folder for results of pools, from which an evaluation with the same arguments resumes;
        None stores none.

    Raises:
      CongraspError: the hand can approach none of the objects.
    """
    pool_count = len(pools.loaders)
    episodes_of_object = math.ceil(experiment.episodes / (pools.pool_size * pool_count))
    total = episodes_of_object * pools.pool_size * pool_count
    advance = experiment.track("Episodes on many objects", total)
    experiment = dataclasses.replace(
        experiment,
        constraints=None,
        episodes=episodes_of_object * pools.pool_size,
        measured=pools.pool_size * pool_count <= MAX_MEASURED_OBJECTS,
    )
    files = _result_files(experiment, pools, stored)
    results = _stored_results(files)
    missing = [i for i in range(pool_count) if i not in results]
    with contextlib.ExitStack() as stack, prepare_pools(experiment, pools, missing) as prepared:
        simulator: Episodes | None = None
        for pool in prepared:
            if pool.real_count and not simulator:
                # One simulator for all pools, which have the same size.
                simulator = stack.enter_context(pool.experiment.simulator())
            finished = sum(result.episodes for result in results.values())
            result = _simulate(simulator, pool, advance, finished)
            pool_index = pool.experiment.pool
            results[pool_index] = result
            file = files[pool_index]
            if file is not None:
                keep(file, result.message(), pool_count)
    return _rows([results[i] for i in sorted(results)], experiment)


def _result_files(
    experiment: Experiment, pools: PoolLoaders, folder: pathlib.Path | None
) -> list[pathlib.Path | None]:
    """Files of the pools' results in a folder; None for each pool without a folder."""
    pool_count = len(pools.loaders)
    if folder is None:
        return [None] * pool_count
    name = experiment.digest(pools.source, pools.pool_size)
    return [folder / f"{name}-{i:05d}.safetensors" for i in range(pool_count)]


def _stored_results(files: Sequence[pathlib.Path | None]) -> dict[int, _Result]:
    """Results in the files of an earlier evaluation, by the index of their pool."""
    results = {}
    for pool_index, file in enumerate(files):
        message = None if file is None else read_kept(file)
        if message is not None:
            results[pool_index] = _result_of(message)
    return results


def _simulate(
    simulator: Episodes | None, pool: PreparedPool, advance: Callable[[int], None], finished: int
) -> _Result:
    """Simulates the episodes of a pool, if it has objects.

    Args:
      simulator: simulator of all pools; None if no pool so far had objects.
      pool: pool of objects.
      advance: called with the number of finished episodes of all pools.
      finished: number of episodes that other pools have finished. If there are some, the forces of
        this pool are dropped, since those of one pool suffice.
    """
    if not simulator or not pool.real_count:
        return _Result(Sample({}, np.zeros(0), np.zeros(0)), [], pool.left_out)
    experiment = pool.experiment
    row = Variation()
    plan = experiment.plan(row)
    progress = functools.partial(advance_from, advance, finished)
    stressed = max(0, MIN_STRESSED_EPISODES - finished)
    sample = experiment.sample(simulator, row, plan, progress, stressed=stressed)
    facts = []
    for obj in experiment.scaled[: pool.real_count]:
        largest_side = float(np.ptp(obj.visual_vertices, axis=0).max())
        facts.append(_ObjectFacts(obj.name, largest_side, float(obj.mass), obj.family))
    is_padding = sample.values["object_index"] >= pool.real_count
    sample = sample.where(~is_padding)
    if finished:
        sample = sample.without_forces()
    return _Result(sample, facts, pool.left_out)


def _rows(results: Sequence[_Result], experiment: Experiment) -> list[Row]:
    """Returns the rows of all objects, then of groups."""
    left_out = list(itertools.chain.from_iterable(result.left_out for result in results))
    results = [result for result in results if result.episodes]
    if not results:
        raise CongraspError(
            "None of the objects can be approached.",
            "Scale the objects for the hand, or pass other objects.",
        )
    facts = list(itertools.chain.from_iterable(result.objects for result in results))
    sample = _join(results)
    all_objects = RowDescription(
        Variation().constraint,
        experiment.hand.name,
        [*(obj.name for obj in facts), *left_out],
        held_2s=True,
        method=experiment.task.method,
        paper="objects",
    )
    rows = [summarise(all_objects, sample)]
    sizes = np.array([obj.largest_side for obj in facts])
    masses = np.array([obj.mass for obj in facts])
    families = np.array([obj.family for obj in facts])
    object_index = sample.values["object_index"].astype(int)
    for label, is_member in object_groups(sizes, masses, families):
        in_group = is_member[object_index]
        if in_group.any():
            group = dataclasses.replace(all_objects, pool=int(is_member.sum()), group=label)
            rows.append(summarise(group, sample.where(in_group)))
    return rows


def _join(results: Sequence[_Result]) -> Sample:
    """Joins the samples of pools; their object indices become those among all objects."""
    first_object = 0
    for result in results:
        values = result.sample.values
        values["object_index"] = values["object_index"] + first_object
        first_object += len(result.objects)
    return join_samples([result.sample for result in results])


def _result_of(message: Message) -> _Result:
    """Returns the result of its `message`."""
    facts = [_ObjectFacts(*fields) for fields in message.meta["objects"]]
    return _Result(Sample.of(message.arrays), facts, message.meta["left_out"])
