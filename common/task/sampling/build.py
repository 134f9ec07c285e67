"""Builds constraint banks: resting poses, heading sets, reference poses and wrist trajectories of a
pool of objects.
"""

import dataclasses
import functools
import hashlib
import itertools
import json
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import congrasp.common
from congrasp.common import rotations
from congrasp.common.errors import CongraspError
from congrasp.common.hands import kinematics
from congrasp.common.hands.closure import CENTER, Outline, outline
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import cache_folder, keep, read_kept, source_digest
from congrasp.common.objects import store
from congrasp.common.objects.pool import object_scale
from congrasp.common.objects.spec import SURFACE_POINTS, GraspObject
from congrasp.common.runtime.parallel import parallel_map
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import draws_references, known
from congrasp.common.task.sampling.bank import SHARED, ConstraintBank
from congrasp.common.task.sampling.closed_poses import Poses, closed_poses
from congrasp.common.task.sampling.headings import (
    INWARD,
    Headings,
    above,
    max_width,
    sample_headings,
    within_reach,
)
from congrasp.common.task.sampling.trajectories import HUMAN, make_trajectories
from congrasp.common.task.types import Array
from congrasp.common.wire.codec import Message

HEADINGS = 256
POSES = 20
_CLOSED_TOGETHER = 16
"""Objects grasped in one batch of closing hands, enough to occupy an accelerator."""
_CLEARANCE = 0.02
"""Height over the table that every waypoint of a trajectory keeps, m."""
SOFT = 0.002
"""Depth of fingers in the table that is tolerated because contacts are soft, m."""
_STEEPEST_UP = 0.1
"""Largest upward component of a reference pose's approach direction."""
_CANDIDATES = 4
"""Human trajectories drawn for each pose, of which the one clearest of the table is taken."""


def build_bank(
    hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], seed: int
) -> ConstraintBank:
    """Builds a bank for a pool of objects: headings by the paper's rules, procedural reference
    poses and trajectories.

    References are made only for tasks with a constraint that is drawn from them. Banks of large
    pools are cached on disk.

    Args:
      hand: the hand.
      task: geometry of the approach.
      objects: N objects, scaled for the hand (`common.objects.pool.scale_objects`).
      seed: random seed.

    Raises:
      CongraspError: an object is too wide or cannot be approached in any resting pose, or all
        objects lie too flat.
    """
    bank = kept_bank(
        hand, task, objects, seed, functools.partial(_build, hand, task, objects, seed)
    )
    return with_columns(hand, task, bank)


def bank_form(hand: Hand, task: TaskConfig, objects: Sequence[GraspObject]) -> ConstraintBank:
    """Shapes and types of the bank of a pool, for programs that are compiled while it is built.

    They are those of the object with the most resting poses. The bank of a pool in which none of
    these objects can be approached in all of its poses has a shorter axis R.

    Raises:
      CongraspError: the object is too wide, or cannot be approached in any resting pose.
    """
    example = max(objects, key=lambda obj: len(obj.rest_poses))
    # A hand's outline takes seconds
    row = headings_of(task, example, (0, 0), scale=object_scale(hand, task))
    bank = with_columns(hand, task, _bank_of(hand, task, [example], [row], 0, _no_references))
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((len(objects), *leaf.shape[1:]), leaf.dtype), bank
    )


def _build(
    hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], seed: int
) -> ConstraintBank:
    """Builds the bank of `build_bank` without the cache."""
    count, scale = len(objects), object_scale(hand, task)
    seeds = [(seed, n) for n in range(count)]
    rows = parallel_map(
        headings_of,
        itertools.repeat(task, count),
        objects,
        seeds,
        itertools.repeat(None, count),
        itertools.repeat(scale, count),
        itertools.repeat(outline(hand), count),
    )
    if not any(row["weight"] for row in rows):
        raise CongraspError(
            f"None of {count} objects can be grasped: in every resting pose they lie too flat on "
            f"the table.",
            "Add other objects.",
        )
    # Closing a hand around objects takes seconds
    make = _references if draws_references(task) else _no_references
    return _bank_of(hand, task, objects, rows, seed, make)


def _bank_of(
    hand: Hand,
    task: TaskConfig,
    objects: Sequence[GraspObject],
    rows: Sequence[dict[str, np.ndarray]],
    seed: int,
    make: Callable[..., dict[str, Any]],
) -> ConstraintBank:
    """Bank of objects with the rows of `headings_of` and the references of `make`."""
    count, rests = len(objects), max(len(row["rest"]) for row in rows)
    for row in rows:
        fill = np.resize(np.arange(len(row["rest"])), rests)
        row["rest"], row["has_affordance"] = row["rest"][fill], row["has_affordance"][fill]
        row["heading_index"], row["heading_back"] = (
            row["heading_index"][:, fill],
            row["heading_back"][:, fill],
        )
    columns = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    chosen = [columns.pop(f"chosen_{name}") for name in Headings._fields]
    surfaces = [
        np.stack([getattr(obj, name) for obj in objects]).astype(np.float32)
        for name in ("points", "normals")
    ]
    references = make(
        hand,
        *surfaces,
        *chosen,
        columns["rest"],
        jax.random.key(seed),
        waypoints=task.trajectory_points,
        human_paths=task.human_paths,
    )
    own = {"renewable": np.ones(count, bool), "grasps": np.zeros((count, 2), int)}
    own["mass"] = np.array([obj.mass for obj in objects], np.float32)
    return jax.device_put(ConstraintBank(**columns, **references, **own))


@functools.partial(jax.jit, static_argnames=("hand", "waypoints", "human_paths"))
def _references(  # noqa: PLR0913
    hand: Hand,
    points: Array,
    normals: Array,
    position: Array,
    direction: Array,
    cross: Array,
    rest: Array,
    key: Array,
    *,
    waypoints: int,
    human_paths: float,
) -> dict[str, Array]:
    """Poses and trajectories of the bank: the hand closed around N objects (N, P, 3) at headings
    (N, V, M, 3).
    """
    poses = _closed(hand, points, normals, position, direction, cross)
    return reference_columns(hand, poses, rest, key, waypoints, human_paths)


def _no_references(
    hand: Hand, *arrays: Array, waypoints: int, human_paths: float
) -> dict[str, np.ndarray]:
    """As many poses and trajectories as `_references` makes, none of them usable; same
    arguments.
    """
    *_, direction, _, rest, _ = arrays
    shape = direction.shape[:-1]
    level = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
    return {
        "pose_q": np.zeros((*shape, len(hand.joints)), np.float32),
        "pose_position": np.zeros((*shape, 3), np.float32),
        "pose_quaternion": np.broadcast_to(level, (*shape, 4)),
        "trajectory_position": np.zeros((*shape, waypoints, 3), np.float32),
        "trajectory_quaternion": np.broadcast_to(level, (*shape, waypoints, 4)),
        "pose_valid": np.zeros((*shape[:2], rest.shape[1], shape[2]), bool),
    }


@functools.partial(jax.jit, static_argnames=("hand", "waypoints", "human_paths"))
def reference_columns(
    hand: Hand,
    poses: Poses,
    rest: Array,
    key: Array,
    waypoints: int,
    human_paths: float = 0.0,
) -> dict[str, Array]:
    """Columns of the bank of poses (N, V, M, ...) and of trajectories to them, for resting poses
    (N, R, 7).
    """
    shape = poses.q.shape[:-1]
    flat = Poses(*(field.reshape(-1, field.shape[-1]) for field in poses))
    rest = jnp.repeat(rest, shape[1] * shape[2], axis=0)
    path, turns, valid = make_references(hand, flat, rest, key, waypoints, human_paths)
    return {
        "pose_q": poses.q,
        "pose_position": poses.position,
        "pose_quaternion": poses.quaternion,
        "trajectory_position": path.reshape(*shape, *path.shape[1:]),
        "trajectory_quaternion": turns.reshape(*shape, *turns.shape[1:]),
        "pose_valid": jnp.swapaxes(valid.reshape(*shape, -1), -1, -2),
    }


@functools.partial(jax.jit, static_argnames=("hand", "waypoints", "human_paths"))
def make_references(
    hand: Hand,
    poses: Poses,
    rest: Array,
    key: Array,
    waypoints: int,
    human_paths: float = 0.0,
) -> tuple[Array, Array, Array]:
    """Generates a trajectory to each of M reference poses, and checks in which resting poses they
    are usable.

    Args:
      hand: the hand.
      poses: M poses.
      rest: (M, R, 7) resting poses of the poses' objects.
      key: random key of the trajectories.
      waypoints: number K of waypoints.
      human_paths: share of the trajectories in the style `trajectories.HUMAN`.

    Returns:
      Trajectories (M, K, 3) and (M, K, 4), and a mask (M, R) of usable resting poses.
    """
    path, turns = make_trajectories(
        hand, poses.position, poses.quaternion, key, waypoints=waypoints
    )
    if human_paths:
        share_key, human_key = jax.random.split(jax.random.fold_in(key, 1))
        chosen = jax.random.uniform(share_key, (len(path), 1, 1)) < human_paths
        human_path, human_turns = _clearest_human_paths(hand, poses, rest, human_key, waypoints)
        path = jnp.where(chosen, human_path, path)
        turns = jnp.where(chosen, human_turns, turns)
    room = height_over_table(hand, poses.q, path, turns, rest) > -SOFT
    return path, turns, clear_of_table(hand, poses.quaternion, path, rest) & room


def _clearest_human_paths(
    hand: Hand, poses: Poses, rest: Array, key: Array, waypoints: int
) -> tuple[Array, Array]:
    """Draws four trajectories in the style `HUMAN` to each of M poses and returns the one that
    stays above the table in most resting poses.

    Many directions at 75 degrees to a level heading begin below the table; people come from above.

    Returns:
      Trajectories (M, K, 3) and (M, K, 4).
    """

    def candidate(key: Array) -> tuple[Array, Array]:
        return make_trajectories(
            hand, poses.position, poses.quaternion, key, waypoints=waypoints, style=HUMAN
        )

    paths, turns = jax.lax.map(candidate, jax.random.split(key, _CANDIDATES))
    clear = jax.vmap(lambda path: jnp.sum(above_table(path, rest), -1))(paths)
    best = jnp.argmax(clear, 0)
    rows = jnp.arange(len(best))
    return paths[best, rows], turns[best, rows]


def height_over_table(hand: Hand, q: Array, path: Array, turns: Array, rest: Array) -> Array:
    """Least height (M, R) in m of a hand's capsules over the table along the path to each of M
    reference poses.

    Args:
      hand: the hand.
      q: (M, F) finger angles of the poses.
      path: (M, K, 3) wrist waypoints, in the object frame.
      turns: (M, K, 4) wrist orientations of the waypoints.
      rest: (M, R, 7) resting poses of the objects.
    """
    return jax.lax.map(
        lambda row: _height_on_the_way(hand, *row), (q, path, turns, rest), batch_size=2048
    )


def _height_on_the_way(hand: Hand, q: Array, path: Array, turns: Array, rest: Array) -> Array:
    """`height_over_table` (R,) of one reference, m."""
    ends = kinematics.capsules(hand, kinematics.link_transforms(hand, q)).reshape(-1, 3)
    ends = rotations.transform(path, turns, jnp.broadcast_to(ends, (len(path), *ends.shape)))
    up = rotations.to_matrix(rest[:, 3:])[:, None, None, 2]
    height = jnp.sum(up * ends, -1) + rest[:, None, None, 2] - np.repeat(hand.capsule_radii, 2)
    return jnp.min(height, (1, 2))


def clear_of_table(hand: Hand, quaternion: Array, path: Array, rest: Array) -> Array:
    """(M, R) bool: the approach of a reference pose is from above or level, and the trajectory
    stays above the table.

    Args:
      hand: the hand, for its heading axis.
      quaternion: (M, 4) wrist orientations of the poses, in the object frame.
      path: (M, K, 3) wrist waypoints.
      rest: (M, R, 7) resting poses of the objects.
    """
    heading = rotations.rotate(
        quaternion,
        jnp.broadcast_to(jnp.array(grasp_frame(hand).heading), (*quaternion.shape[:-1], 3)),
    )
    rising = jnp.einsum("mri,mi->mr", rotations.to_matrix(rest[..., 3:])[..., 2, :], heading)
    return above_table(path, rest) & (rising < _STEEPEST_UP)


def above_table(path: Array, rest: Array) -> Array:
    """(M, R) bool: all waypoints (M, K, 3) of a wrist are above the table, in resting poses (M, R,
    7) of objects.
    """
    up = rotations.to_matrix(rest[..., 3:])[..., 2, :]
    return jnp.min(jnp.einsum("mri,mki->mrk", up, path), -1) + rest[..., 2] > _CLEARANCE


def _closed(hand: Hand, points: Array, normals: Array, *headings: Array) -> Poses:
    """Reference poses (N, V, M, ...) at headings (N, V, M, 3), by closing the hand around the
    objects.
    """

    def of_object(row: tuple[Array, ...]) -> Poses:
        points, normals, *headings = row
        flat = closed_poses(hand, points, normals, *(field.reshape(-1, 3) for field in headings))
        return Poses(*(field.reshape(2, POSES, -1) for field in flat))

    return jax.lax.map(
        of_object, (points, normals, *headings), batch_size=min(_CLOSED_TOGETHER, len(points))
    )


def headings_of(
    task: TaskConfig,
    obj: GraspObject,
    seed: tuple[int, int],
    given: Headings | None = None,
    scale: float = 1.0,
    hand: Outline = CENTER,
) -> dict[str, np.ndarray]:
    """Computes headings and resting poses of one object; resting poses without a reachable heading
    are dropped.

    An object that lies too flat in all of them, such as a wide board, is given weight 0: no episode
    draws it.

    Args:
      task: geometry of the approach.
      obj: the object.
      seed: seed of the headings.
      given: `HEADINGS` headings that replace sampled ones.
      scale: scale of the object; the lengths of the rules scale with it, so that a larger hand gets
        the headings of the smaller object.
      hand: outline that must clear the table.

    Raises:
      CongraspError: the object is too wide (`TooWideError`), or cannot be approached in any of its
        resting poses.
    """
    rng = np.random.default_rng(seed)
    opposed = task.headings != "center" and given is None
    whole, graspable = (given, given) if given else _sampled(obj, rng, scale, hand, opposed=opposed)
    sets = [whole, graspable or whole]
    # Captured headings may be off by a centimetre, but a hand did hold their objects.
    avoid = obj.non_graspable_points if graspable is not None and given is None else None
    cleared, reachable, too_flat = _reachable(task, obj, sets, hand, avoid, opposed=opposed)
    usable = np.flatnonzero(reachable[0].any(-1))
    if len(usable) == 0:
        raise CongraspError(
            f"The object '{obj.name}' cannot be approached in any of its resting poses.",
            "Scale it or remove it.",
        )
    reachable = reachable[:, usable]
    # (V, R, H, 3), the positions that the table leaves.
    positions = np.array([[region[rest].position for rest in usable] for region in cleared])
    index = np.array([[_repeated(row) for row in region] for region in reachable])
    back = np.linalg.norm(
        positions - np.array([headings.position for headings in sets])[:, None], axis=-1
    )
    references = _reference_headings(rng, sets, positions, reachable)
    keep = rng.permutation(SURFACE_POINTS)[: task.surface_points]
    avoided = obj.non_graspable_points[keep]
    floats = {
        "points": obj.points[keep],
        "normals": obj.normals[keep],
        "rest": obj.rest_poses[usable],
        **{
            f"heading_{name}": np.stack([getattr(s, name) for s in sets])
            for name in Headings._fields
        },
        "heading_back": np.take_along_axis(back, index, -1),
        **{f"chosen_{name}": value for name, value in references._asdict().items()},
    }
    return {
        **{name: value.astype(np.float32) for name, value in floats.items()},
        "avoid": avoided,
        "heading_index": index.astype(np.int32),
        "weight": np.float32(not too_flat),
        "has_affordance": (graspable is not None) & avoided.any() & reachable[1].any(-1),
    }


def _sampled(
    obj: GraspObject, rng: np.random.Generator, scale: float, hand: Outline, *, opposed: bool
) -> tuple[Headings, Headings | None]:
    """Headings for the whole surface and for the graspable region, None if that is out of reach;
    see `headings_of`.
    """
    inward, width = scale * INWARD, max_width(hand, scale)
    whole, graspable = (
        sample_headings(
            obj,
            rng,
            count=HEADINGS,
            use_affordance=use,
            inward=inward,
            max_width=width,
            opposed=opposed,
        )
        for use in (False, True)
    )
    assert whole is not None, "only the graspable region may be unreachable"
    return whole, graspable


def _reachable(
    task: TaskConfig,
    obj: GraspObject,
    sets: Sequence[Headings],
    hand: Outline,
    avoid: np.ndarray | None,
    *,
    opposed: bool,
) -> tuple[list[list[Headings]], np.ndarray, bool]:
    """Headings of V = 2 regions moved clear of the table, (V, R, H) bool where they are feasible,
    and "too flat".

    Args:
      task: kind of headings.
      obj: the object.
      sets: headings for the whole surface, and for the graspable region.
      hand: outline that must clear the table.
      avoid: (P,) bool, avoid region of sampled headings; None for captured ones, or without a
        graspable region.
      opposed: see `within_reach`.
    """
    own = CENTER if task.headings == "center" else hand
    found = [
        within_reach(headings, obj, obj.rest_poses, own, region, opposed=opposed)
        for headings, region in zip(sets, (None, avoid), strict=True)
    ]
    if too_flat := not found[0][1].any():
        found[0] = within_reach(sets[0], obj, obj.rest_poses, own, opposed=False)
    reachable = np.stack([fine for _, fine in found])
    if task.headings == "above" and reachable[0].any():
        steep = np.array([[above(headings, rest) for rest in obj.rest_poses] for headings in sets])
        reachable = np.where(
            (reachable & steep).any(-1, keepdims=True), reachable & steep, reachable
        )
    return [cleared for cleared, _ in found], reachable, too_flat


def _repeated(which: np.ndarray) -> np.ndarray:
    """Indices (H,) of the true entries of a mask (H,), repeated; zeros if there are none."""
    indices = np.flatnonzero(which)
    return np.resize(indices, HEADINGS) if len(indices) else np.zeros(HEADINGS, int)


def _reference_headings(
    rng: np.random.Generator, sets: Sequence[Headings], positions: np.ndarray, reachable: np.ndarray
) -> Headings:
    """Headings (V, M, 3) of the references, drawn among those that are feasible.

    Args:
      rng: generator of the draws.
      sets: H headings for each of V regions.
      positions: (V, R, H, 3) their positions in each resting pose, m.
      reachable: (V, R, H) bool, feasible headings.
    """
    drawn = [
        Headings(position[rest, heading], region.direction[heading], region.cross[heading])
        for region, position, (rest, heading) in zip(
            sets, positions, [_spread(rng, allowed) for allowed in reachable], strict=True
        )
    ]
    return Headings(*(np.stack(parts) for parts in zip(*drawn, strict=True)))


def _spread(rng: np.random.Generator, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draws resting poses (M,) and headings (M,) of references, evenly over resting poses with a
    heading (R, H).

    If there is none, all headings are equally likely.
    """
    rests = np.flatnonzero(allowed.any(1)) if allowed.any() else np.arange(len(allowed))
    rests = np.resize(rng.permutation(rests), POSES)
    weights = allowed[rests] if allowed.any() else np.ones((POSES, allowed.shape[1]))
    return rests, np.array([rng.choice(len(row), p=row / row.sum()) for row in weights])


def with_columns(hand: Hand, task: TaskConfig, bank: ConstraintBank) -> ConstraintBank:
    """Returns the bank with the columns of the task's constraints."""
    found = {constraint.name: constraint.columns(hand, bank) for constraint in known(task)}
    return bank._replace(
        own={name: columns for name, columns in found.items() if columns is not None}
    )


LEAST_OBJECTS = 64
"""Pools of at least this size are cached."""
MOST_FILES = 8
"""Most banks in the cache; that of 800 objects takes about 50 MB."""
_IRRELEVANT = (
    *(
        "reward",
        "control",
        "mass_range",
        "friction_range",
        "gain_range",
        "hold_steps",
        "drop_height",
        "disturbed",
    ),
    "impratio",
    *("p_", "observation", "history", "sensing", "surface_normals"),
)
"""Prefixes of the settings that no bank depends on."""


def kept_bank(
    hand: Hand,
    task: TaskConfig,
    objects: Sequence[GraspObject],
    seed: int,
    build: Callable[[], ConstraintBank],
) -> ConstraintBank:
    """Returns the bank built by `build` from these arguments, from the cache on disk if possible.

    Only banks of large pools are cached: they depend on objects, hand and task, and take long to
    build.
    """
    if len(objects) < LEAST_OBJECTS:
        return build()
    path = cache_folder("banks") / f"{_key(hand, task, objects, seed)}.safetensors"
    if (message := read_kept(path)) and message.arrays.keys() == set(SHARED):
        return jax.device_put(ConstraintBank(**message.arrays))
    bank = build()
    keep(path, Message({name: np.asarray(getattr(bank, name)) for name in SHARED}), MOST_FILES)
    return bank


def _key(hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], seed: int) -> str:
    """File name from everything that a bank depends on, including the code and the device's
    arithmetic.
    """
    code = source_digest(congrasp.common)
    settings = {
        name: value
        for name, value in dataclasses.asdict(task).items()
        if not name.startswith(_IRRELEVANT)
    }
    device = jax.local_devices()[0].device_kind
    digests = [store.digest(obj) for obj in objects]
    text = json.dumps([code, jax.__version__, device, hand.reference, settings, seed, digests])
    return hashlib.sha256(text.encode()).hexdigest()[:32]
