"""Reference poses and trajectories independent of the policy under test (paper, section Hand
Morphology).

A policy trained without poses and trajectories grasps every object under headings, on the whole
surface and on the graspable region. Final states of its successful episodes are the references, and
approach paths to them the trajectories. Tables draw from all of them: no policy was trained with
the objects of an exam.
"""

import hashlib
import itertools
import json
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors import draws
from congrasp.actors.draws import PlannedEpisodes
from congrasp.actors.harvest import Grasps
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import cache_folder, keep, read_kept
from congrasp.common.objects import store
from congrasp.common.objects.spec import GraspObject
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.policy.pretrained import reference_file
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.closed_poses import Poses
from congrasp.common.task.sampling.object_headings import POSES
from congrasp.common.task.sampling.references import make_references
from congrasp.common.wire.codec import Message, encode
from congrasp.services.evaluate.episodes import Episodes
from congrasp.services.evaluate.plan import RowPlan, batches, protocol

HELD_OUT = POSES // 5
"""References of an object and region that its constraint set holds out (`sampling.sets`), the last
ones.
"""
MAX_ATTEMPTS = 3 * POSES
"""Most episodes of an object and region; the grasps found by then are used."""
_ATTEMPTS_PER_REFERENCE = 1.25
"""Episodes for each missing reference."""
_SEED = 0
_MAX_FILES = 256
"""Most sets of references in the cache; a set for 64 objects takes about 3 MB."""


def _constraint_of(region: int) -> str:
    """Name of the constraint under which a region is grasped without a reference."""
    for constraint in CONSTRAINTS:
        if constraint.region == region and not constraint.from_reference:
            return constraint.name
    raise LookupError(f"no constraint grasps the region {region}")


def _reference_columns() -> tuple[str, ...]:
    """Columns of references in a constraint bank."""
    constraints = {constraint.name for constraint in CONSTRAINTS if constraint.from_reference}
    return tuple(
        column for column in ConstraintBank._fields if column.partition("_")[0] in constraints
    )


_REGIONS = (_constraint_of(0), _constraint_of(1))
"""Constraints of the grasps on the whole surface, and on the graspable region."""
_ARRAYS = _reference_columns()
"""Columns of references: fields of `Poses`, then results of `make_references`."""


class References(NamedTuple):
    """A constraint bank with references, and their source."""

    bank: ConstraintBank
    grasps: np.ndarray
    """(N, V) int: references of each object and region that are grasps of the reference policy; if
    there are none, poses that close the hand around the object are used."""


def reference_policy(bundle: PolicyBundle) -> tuple[PolicyBundle, str]:
    """Returns the reference policy of a policy's hand, and its description.

    The package has one for the hands of its pretrained policies; for any other hand it is the
    policy itself, under headings and affordances only.

    Raises:
      CongraspError: the package's file is missing.
    """
    hand = get_hand(bundle.spec.hand)
    file = reference_file(bundle.spec.hand)
    if file is None:
        return bundle, "the policy itself, under headings and affordances"
    return bundles.load(file), f"the reference policy of the {hand.name} hand"


def make(
    policy: PolicyBundle,
    task: TaskConfig,
    objects: Sequence[GraspObject],
    bank: ConstraintBank,
    *,
    physics: PhysicsName,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> References:
    """Returns the bank with references of a reference policy, cached on disk.

    Args:
      policy: the reference policy.
      task: the task, for the geometry of the approach and the waypoints of trajectories.
      objects: N objects, scaled for the hand.
      bank: bank of these objects (`build_bank`), with references for where the policy finds none.
      physics: engine, except `auto`.
      progress: called with the number of references found, and their greatest number.
    """
    file = cache_folder("references") / f"{_key(policy, task, objects, physics)}.safetensors"
    cached = _read(file, bank)
    if cached is not None:
        return cached
    grasps = _grasp_all(policy, objects, bank, physics, progress)
    references = with_references(policy, task, bank, grasps)
    arrays = {name: np.asarray(getattr(references.bank, name)) for name in _ARRAYS}
    message = Message({**arrays, "grasps": references.grasps}, {"kind": "references"})
    keep(file, message, _MAX_FILES)
    return references


class _GraspsOfRegion(NamedTuple):
    """Grasps of one region (whole surface, or graspable region) of each object."""

    constraint: str
    """Constraint under which the policy grasps the region."""
    rests: list[np.ndarray]
    """Indices of the resting poses of each object in which the region can be grasped."""
    attempts: np.ndarray
    """(N,) int: episodes of each object so far."""
    grasps: list[list[Poses]]
    """At most `POSES` grasps of each object."""

    def count_graspable(self) -> int:
        """Returns the number of objects whose region can be grasped in some resting pose."""
        return sum(len(rests) > 0 for rests in self.rests)

    def next_attempts(self) -> np.ndarray:
        """Returns the number (N,) of further episodes of each object."""
        missing = np.array([POSES - len(grasps) for grasps in self.grasps])
        graspable = np.array([len(rests) > 0 for rests in self.rests])
        episodes = np.ceil(_ATTEMPTS_PER_REFERENCE * missing * graspable).astype(int)
        return np.minimum(episodes, MAX_ATTEMPTS - self.attempts)

    def plan(self, episodes: np.ndarray, object_seeds: np.ndarray) -> RowPlan:
        """Plans episodes.

        Args:
          episodes: (N,) number of episodes of each object.
          object_seeds: (N,) uint32, hashes of the objects.
        """
        objects = np.repeat(np.arange(len(episodes)), episodes)
        number_in_object = np.concatenate([np.arange(count) for count in episodes])
        numbers = self.attempts[objects] + number_in_object
        rests = []
        for obj, number in zip(objects, numbers, strict=True):
            choices = self.rests[obj]
            rests.append(choices[number % len(choices)])
        planned = PlannedEpisodes(
            objects=objects.astype(np.int32),
            rests=np.array(rests, np.int32),
            object_seeds=object_seeds[objects],
            episode_numbers=numbers.astype(np.int32),
        )
        return RowPlan(self.constraint, aligned=False, episodes=planned, covered=episodes > 0)

    def add(self, batch: Grasps, count: int) -> None:
        """Adds the grasps of the first `count` episodes of a batch."""
        for i in np.flatnonzero(batch.found[:count]):
            grasps = self.grasps[batch.object_index[i]]
            if len(grasps) < POSES:
                grasps.append(Poses(batch.q[i], batch.position[i], batch.quaternion[i]))


def _grasp_all(
    policy: PolicyBundle,
    objects: Sequence[GraspObject],
    bank: ConstraintBank,
    physics: PhysicsName,
    progress: Callable[[int, int], None],
) -> list[list[list[Poses]]]:
    """Returns at most `POSES` grasps of each object (N) and region (V)."""
    task = protocol(policy.task, policy.task.hold_steps)
    hand = get_hand(policy.spec.hand)
    seeds = [int(store.digest(obj)[:8], 16) for obj in objects]
    object_seeds = np.array(seeds, np.uint32)
    regions = [_start_region(constraint, task, bank) for constraint in _REGIONS]
    graspable = sum(region.count_graspable() for region in regions)
    most = POSES * graspable
    size = min(ENGINES[physics].batch, 1 << (most - 1).bit_length())
    with Episodes(
        policy, task, objects, hold=task.hold_steps, batch=size, physics=physics
    ) as episodes:
        for region, plan in _plans(regions, object_seeds):
            for conditions, count in batches(hand, task, bank, plan, _SEED, size):
                episodes.run(conditions)
                region.add(jax.tree.map(np.asarray, episodes.take_grasps()), count)
                progress(_count_grasps(regions), most)
    grasps_by_object = zip(*(region.grasps for region in regions), strict=True)
    return [list(of_regions) for of_regions in grasps_by_object]


def _start_region(constraint: str, task: TaskConfig, bank: ConstraintBank) -> _GraspsOfRegion:
    """Returns the region of a constraint, without grasps."""
    is_samplable = np.asarray(draws.samplable(task, bank, (constraint,)))
    object_count = len(is_samplable)
    return _GraspsOfRegion(
        constraint,
        rests=[np.flatnonzero(row) for row in is_samplable],
        attempts=np.zeros(object_count, int),
        grasps=[[] for _ in range(object_count)],
    )


def _plans(
    regions: Sequence[_GraspsOfRegion], object_seeds: np.ndarray
) -> Iterator[tuple[_GraspsOfRegion, RowPlan]]:
    """Yields episodes until each region has its grasps or has used its attempts.

    The caller adds the grasps of a plan's episodes to its region before it takes the next plan,
    which depends on them.
    """
    for region in regions:
        attempts = region.next_attempts()
        while attempts.any():
            yield region, region.plan(attempts, object_seeds)
            region.attempts[:] += attempts
            attempts = region.next_attempts()


def _count_grasps(regions: Sequence[_GraspsOfRegion]) -> int:
    """Number of grasps of all objects and regions."""
    grasps = itertools.chain.from_iterable(region.grasps for region in regions)
    return sum(map(len, grasps))


def with_references(
    policy: PolicyBundle, task: TaskConfig, bank: ConstraintBank, grasps: list[list[list[Poses]]]
) -> References:
    """Returns the bank with these grasps as references, and with trajectories to the grasps.

    No reference is both held out and for training.
    A grasp counts if it clears the table in some resting pose. If there are too few, a fifth of
    them (at least one) is repeated among those held out, and the others among those for training.
    Where no grasp counts, the bank's poses that close the hand around the object are repeated
    instead.
    """
    arrays = {name: np.array(getattr(bank, name)) for name in _ARRAYS}
    references = _reference_arrays(get_hand(policy.spec.hand), task, bank, grasps)
    counts = np.zeros((len(grasps), len(_REGIONS)), int)
    first = 0
    for n, v in np.ndindex(counts.shape):
        end = first + len(grasps[n][v])
        rows = {name: values[first:end] for name, values in references.items()}
        first = end
        usable = np.zeros(0, int)
        if rows:
            usable = np.flatnonzero(rows["pose_valid"].any(1))
        counts[n, v] = len(usable)
        if not len(usable):
            rows = {name: values[n, v] for name, values in arrays.items()}
            rows["pose_valid"] = arrays["pose_valid"][n, v].T
            usable = np.flatnonzero(rows["pose_valid"].any(1))
        if not len(usable):
            continue
        order = usable[arrange(len(usable))]
        for name, values in rows.items():
            ordered = values[order]
            arrays[name][n, v] = ordered.T if name == "pose_valid" else ordered
    columns = {name: jnp.asarray(values) for name, values in arrays.items()}
    return References(bank._replace(**columns), counts)


def _reference_arrays(
    hand: Hand, task: TaskConfig, bank: ConstraintBank, grasps: list[list[list[Poses]]]
) -> dict[str, np.ndarray]:
    """Returns columns (G, ...) of G grasps, ordered by object and region, and of trajectories to
    them; empty without a grasp. `pose_valid` is (G, R) for the object's R resting poses.
    """
    owners = []
    poses = []
    for n, of_object in enumerate(grasps):
        for of_region in of_object:
            owners += [n] * len(of_region)
            poses += of_region
    if not poses:
        return {}
    stacked = Poses(*(jnp.asarray(np.stack(field)) for field in zip(*poses, strict=True)))
    rest = jnp.asarray(bank.rest)[np.array(owners)]
    path, turns, valid = make_references(
        hand, stacked, rest, jax.random.key(_SEED), task.trajectory_points
    )
    columns = (*stacked, path, turns, valid)
    return dict(zip(_ARRAYS, map(np.asarray, columns), strict=True))


def arrange(count: int) -> np.ndarray:
    """Indices (POSES,) into `count` references; those held out come last."""
    held_out = max(1, round(count * HELD_OUT / POSES))
    for_training = np.arange(max(count - held_out, 1))
    last = np.arange(count - held_out, count)
    return np.concatenate([np.resize(for_training, POSES - HELD_OUT), np.resize(last, HELD_OUT)])


def _key(
    policy: PolicyBundle, task: TaskConfig, objects: Sequence[GraspObject], physics: str
) -> str:
    """File name from everything that references depend on."""
    made_by = bundles.content_hash(encode(policy.to_message()))
    digests = [store.digest(obj) for obj in objects]
    geometry = [task.trajectory_points, task.surface_points, task.back_off, task.headings]
    text = json.dumps([made_by, digests, geometry, physics, _SEED, POSES, MAX_ATTEMPTS])
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _read(path: pathlib.Path, bank: ConstraintBank) -> References | None:
    """Reads cached references of the bank's objects; returns None if they are missing or
    damaged.
    """
    message = read_kept(path)
    if message is None:
        return None
    arrays = message.arrays
    for name in _ARRAYS:
        if name not in arrays or arrays[name].shape != getattr(bank, name).shape:
            return None
    columns = {name: jnp.asarray(arrays[name]) for name in _ARRAYS}
    return References(bank._replace(**columns), arrays["grasps"])
