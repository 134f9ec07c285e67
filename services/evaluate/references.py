"""Reference poses and trajectories independent of the policy under test (paper, section Hand
Morphology).

A policy trained without poses and trajectories grasps every object under headings, on the whole
surface and on the graspable region. Final states of its successful episodes are the references, and
approach paths to them the trajectories. Tables draw from all of them: no policy was trained with
the objects of an exam.
"""

import hashlib
import json
import pathlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors import initial
from congrasp.actors.initial import PlannedEpisodes
from congrasp.common.hands import get_hand
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
_ATTEMPTS = 3 * POSES
"""Most episodes of an object and region; the grasps found by then are used."""
_SPARE = 1.25
"""Episodes for each missing reference."""
_SEED = 0
_MOST_FILES = 256
"""Most sets of references in the cache; that of 64 objects takes about 3 MB."""


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
    """
    hand = get_hand(bundle.spec.hand)
    if hand.reference == hand.name and (file := reference_file(hand.name)):
        return bundles.load(file), f"the reference policy of the {hand.name} hand"
    return bundle, "the policy itself, under headings and affordances"


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
    kept = cache_folder("references") / f"{_key(policy, task, objects, physics)}.safetensors"
    if found := _read(kept, bank):
        return found
    grasps = _grasp(policy, task, objects, bank, physics, progress)
    made = _filled(policy, task, bank, grasps)
    arrays = {name: np.asarray(getattr(made.bank, name)) for name in _ARRAYS}
    keep(kept, Message({**arrays, "grasps": made.grasps}, {"kind": "references"}), _MOST_FILES)
    return made


_REGIONS = tuple(
    next(c.name for c in CONSTRAINTS if c.region == v and not c.from_reference) for v in range(2)
)
"""Constraints of the grasps on the whole surface, and on the graspable region."""
_FROM_REFERENCES = {constraint.name for constraint in CONSTRAINTS if constraint.from_reference}
_ARRAYS = tuple(
    name for name in ConstraintBank._fields if name.partition("_")[0] in _FROM_REFERENCES
)
"""Columns of references: fields of `Poses`, then results of `make_references`."""


def _grasp(
    policy: PolicyBundle,
    task: TaskConfig,
    objects: Sequence[GraspObject],
    bank: ConstraintBank,
    physics: PhysicsName,
    progress: Callable[[int, int], None],
) -> list[list[list[Poses]]]:
    """Returns at most `POSES` grasps of each object (N) and region (V)."""
    own = protocol(policy.task, policy.task.hold_steps)
    hand = get_hand(policy.spec.hand)
    found: list[list[list[Poses]]] = [[[] for _ in range(2)] for _ in objects]
    names = np.array([int(store.digest(obj)[:8], 16) for obj in objects], np.uint32)
    regions = [initial.allowing(own, bank, (asked,)) for asked in _REGIONS]
    most = POSES * sum(int(allowed.any(1).sum()) for allowed in regions)
    size = min(ENGINES[physics].batch, 1 << (most - 1).bit_length())
    with Episodes(
        policy, own, objects, hold=own.hold_steps, batch=size, physics=physics
    ) as episodes:
        for region, constraint in enumerate(_REGIONS):
            rests = [np.flatnonzero(row) for row in regions[region]]
            tried = np.zeros(len(objects), int)
            while True:
                missing = np.array([POSES - len(of[region]) for of in found]) * regions[region].any(
                    1
                )
                wanted = np.minimum(np.ceil(_SPARE * missing).astype(int), _ATTEMPTS - tried)
                if not wanted.any():
                    break
                index = np.repeat(np.arange(len(objects)), wanted)
                number = tried[index] + np.concatenate([np.arange(count) for count in wanted])
                rest = np.array(
                    [rests[n][i % len(rests[n])] for n, i in zip(index, number, strict=True)],
                    np.int32,
                )
                planned = PlannedEpisodes(
                    index.astype(np.int32), rest, names[index], number.astype(np.int32)
                )
                plan = RowPlan(constraint, False, planned, wanted > 0)
                for conditions, count in batches(hand, own, bank, plan, _SEED, size):
                    episodes.run(conditions)
                    grasps = jax.tree.map(np.asarray, episodes.take_grasps())
                    for i in np.flatnonzero(grasps.found[:count]):
                        taken = found[grasps.object_index[i]][region]
                        if len(taken) < POSES:
                            taken.append(
                                Poses(grasps.q[i], grasps.position[i], grasps.quaternion[i])
                            )
                    progress(sum(len(taken) for of in found for taken in of), most)
                tried += wanted
    return found


def _filled(
    policy: PolicyBundle, task: TaskConfig, bank: ConstraintBank, grasps: list[list[list[Poses]]]
) -> References:
    """Returns the bank with these grasps and trajectories to them, none of them both held out and
    for training.

    A grasp counts if it clears the table in some resting pose. If there are too few, a fifth of
    them (at least one) is repeated among those held out, and the others among those for training.
    """
    hand = get_hand(policy.spec.hand)
    arrays = {name: np.array(getattr(bank, name)) for name in _ARRAYS}
    counts = np.zeros((len(grasps), 2), int)
    flat = [
        (n, v, pose) for n, of in enumerate(grasps) for v, poses in enumerate(of) for pose in poses
    ]
    if flat:
        poses = Poses(
            *(
                jnp.asarray(np.stack(field))
                for field in zip(*(pose for *_, pose in flat), strict=True)
            )
        )
        rest = jnp.asarray(bank.rest)[np.array([n for n, *_ in flat])]
        path, turns, valid = make_references(
            hand, poses, rest, jax.random.key(_SEED), task.trajectory_points
        )
        new = dict(zip(_ARRAYS, map(np.asarray, (*poses, path, turns, valid)), strict=True))
        owners = np.array([(n, v) for n, v, _ in flat])
    for n, v in np.ndindex(counts.shape):
        usable = (
            np.flatnonzero((owners == (n, v)).all(1) & new["pose_valid"].any(1))
            if flat
            else np.zeros(0, int)
        )
        counts[n, v] = len(usable)
        if len(usable):
            order = usable[_arranged(len(usable))]
            rows = {name: values[order] for name, values in new.items()}
        else:
            closed = np.flatnonzero(arrays["pose_valid"][n, v].any(0))
            if not len(closed):
                continue
            order = closed[_arranged(len(closed))]
            rows = {name: arrays[name][n, v][order] for name in _ARRAYS if name != "pose_valid"}
            rows["pose_valid"] = arrays["pose_valid"][n, v].T[order]
        for name, values in rows.items():
            arrays[name][n, v] = values.T if name == "pose_valid" else values
    return References(
        bank._replace(**{name: jnp.asarray(values) for name, values in arrays.items()}), counts
    )


def _arranged(count: int) -> np.ndarray:
    """Indices (POSES,) into `count` references; those held out come last."""
    held_out = max(1, round(count * HELD_OUT / POSES))
    training = np.arange(max(count - held_out, 1))
    return np.concatenate(
        [
            np.resize(training, POSES - HELD_OUT),
            np.resize(np.arange(count - held_out, count), HELD_OUT),
        ]
    )


def _key(
    policy: PolicyBundle, task: TaskConfig, objects: Sequence[GraspObject], physics: str
) -> str:
    """File name from everything that references depend on."""
    made_by = bundles.content_hash(encode(policy.to_message()))
    digests = [store.digest(obj) for obj in objects]
    geometry = [task.trajectory_points, task.surface_points, task.back_off, task.headings]
    text = json.dumps([made_by, digests, geometry, physics, _SEED, POSES, _ATTEMPTS])
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _read(path: pathlib.Path, bank: ConstraintBank) -> References | None:
    """Reads cached references of the bank's objects; returns None if they are missing or
    damaged.
    """
    if not (message := read_kept(path)):
        return None
    arrays = message.arrays
    if any(
        name not in arrays or arrays[name].shape != getattr(bank, name).shape for name in _ARRAYS
    ):
        return None
    return References(
        bank._replace(**{name: jnp.asarray(arrays[name]) for name in _ARRAYS}), arrays["grasps"]
    )
