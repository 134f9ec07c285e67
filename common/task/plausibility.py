"""Plausibility of a motion: penetration, speed, jerk and effort, from samples of control steps.

Everything is computed from joint angles, poses and contact forces, so that it means the same in
every engine. The hand's links are capsules; for a custom hand, points on the meshes of its file are
tested against the object as well. A sample is the state after a control step.
"""

import functools
from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.meshes import own_meshes
from congrasp.common.hands.mjcf import overlapping
from congrasp.common.hands.motors import motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.distance import DistanceField
from congrasp.common.objects.shapes import mesh_of
from congrasp.common.objects.spec import Piece
from congrasp.common.task.mesh_points import points_on_meshes
from congrasp.common.task.posture import unnatural
from congrasp.common.task.scene import Scene
from congrasp.common.task.types import Array

CLEAN_MM = {"hand_hand_mm": 2.0, "hand_table_mm": 2.0, "hand_object_mm": 3.0, "hand_mesh_mm": 3.0}
"""Exclusive bounds of a clean episode's penetrations, mm; `hand_mesh_mm` is only measured for hands
with meshes.
"""
MEASURES = (
    *CLEAN_MM,
    "wrist_speed",
    "wrist_speed_mean",
    "wrist_speed_p95",
    "wrist_acceleration",
    "wrist_acceleration_mean",
    "wrist_acceleration_p95",
    "posture_rad",
    "finger_jerk",
    "link_force",
    "link_force_peak",
    "torque_share",
    "torque_share_peak",
)
"""Names of the `measures` of an episode."""
_AXIS_SPACING = 0.004
"""Spacing of points on a capsule's axis, m: a sharp edge 7 mm from the axis appears at most 0.3 mm
farther away.
"""


class Sample(NamedTuple):
    """Sample of a control step of B environments."""

    hand_hand: Array
    """(B,) deepest penetration of two links that are not neighbours, m; 0 if there is none, also
    below.
    """
    hand_table: Array
    """(B,) deepest point of the hand below the table's top, m; 0 after the table is removed."""
    hand_object: Array
    """(B,) deepest penetration of a link and the object's surface, m."""
    hand_mesh: Array
    """(B,) deepest penetration of the hand's meshes and the object's surface, m; NaN for hands
    without meshes.
    """
    wrist_velocity: Array
    """(B, 3) velocity of the wrist's origin, m/s."""
    finger_velocity: Array
    """(B, F) rad/s."""
    link_force: Array
    """(B, L) net contact force of the object on each link, N."""
    torque_share: Array
    """(B, M) torques of the fingers' motors as shares of their limits."""
    posture: Array
    """(B,) mean deviation of the fingers from natural postures, rad (`common.task.posture`)."""
    object_position: Array
    """(B, 3) position of the object, wrist frame, m."""
    object_quaternion: Array
    """(B, 4) object frame to wrist frame."""


class _LinkPoints(NamedTuple):
    """P points fixed to links, in the wrist frame at zero."""

    links: np.ndarray
    """(P,) link of each point."""
    points: np.ndarray
    """(P, 3) m."""
    radii: np.ndarray
    """(P,) radius of the link around the point, m: that of the capsule on an axis, 0 on a
    solid.
    """


def sample(scene: Scene, index: Array, field: DistanceField) -> Sample:
    """Samples a control step.

    Args:
      scene: scene after the step.
      index: (B,) int, rows of the objects in `field`.
      field: signed distances from the objects' surfaces.
    """
    hand = scene.hand
    state = scene.state
    features = scene.features
    transforms = kinematics.link_transforms(hand, state.q)
    wrist_pose = features.wrist_position, features.wrist_quaternion
    placed_object = features.object_position, features.object_quaternion, index, field
    half = jnp.float16  # precision of the quantities that are averaged
    return Sample(
        hand_hand=hand_hand(hand, transforms),
        hand_table=jnp.where(state.table, hand_table(hand, transforms, *wrist_pose), 0.0),
        hand_object=hand_object(hand, transforms, *placed_object),
        hand_mesh=hand_mesh(hand, transforms, *placed_object),
        wrist_velocity=state.u_velocity[..., :3],
        finger_velocity=state.q_velocity,
        link_force=jnp.linalg.norm(features.force, axis=-1).astype(half),
        torque_share=torque_share(scene).astype(half),
        posture=unnatural(hand, state.q, features.touching).astype(half),
        object_position=features.object_position,
        object_quaternion=features.object_quaternion,
    )


def hand_hand(hand: Hand, transforms: tuple[Array, Array]) -> Array:
    """Deepest overlap (B,) of `overlaps` in metres; 0 if there is none."""
    return jnp.max(overlaps(hand, transforms), -1, initial=0.0)


def overlaps(hand: Hand, transforms: tuple[Array, Array]) -> Array:
    """Overlap (..., Q) of pairs of capsules of different links in metres; negative if they are
    apart.

    Pairs are those that collide in the hand's model with `hand_self_collision`: not a link and its
    parent, nor those whose capsules nest in the open pose or at zero
    (`common.hands.mjcf.overlapping`).

    Args:
      hand: the hand.
      transforms: result of `common.hands.kinematics.link_transforms`.
    """
    radii = hand.capsule_radii
    ends = kinematics.capsules(hand, transforms)
    first, second = _colliding_pairs(hand)
    apart = segment_distance(
        ends[..., first, 0, :],
        ends[..., first, 1, :],
        ends[..., second, 0, :],
        ends[..., second, 1, :],
    )
    return radii[first] + radii[second] - apart


def hand_table(
    hand: Hand, transforms: tuple[Array, Array], wrist_position: Array, wrist_quaternion: Array
) -> Array:
    """Depth (B,) in metres of the hand's lowest point below the plane z = 0.

    Args:
      hand: the hand.
      transforms: result of `common.hands.kinematics.link_transforms`.
      wrist_position: (B, 3) world frame.
      wrist_quaternion: (B, 4) wrist frame to world frame.
    """
    ends = kinematics.capsules(hand, transforms)
    ends = rotations.transform(
        wrist_position, wrist_quaternion, ends.reshape(*ends.shape[:-3], -1, 3)
    )
    return jnp.maximum(jnp.max(np.repeat(hand.capsule_radii, 2) - ends[..., 2], -1), 0.0)


def hand_object(
    hand: Hand,
    transforms: tuple[Array, Array],
    object_position: Array,
    object_quaternion: Array,
    index: Array,
    field: DistanceField,
) -> Array:
    """Penetration (B,) in m of the object by a capsule: its radius minus its axis's distance from
    the surface.

    A finger through a thin blade therefore counts with the thickness of the finger, not of the
    blade. Links that collide as solids are represented by points on these, and count with the
    thickness of the blade.

    Args:
      hand: the hand.
      transforms: result of `common.hands.kinematics.link_transforms`.
      object_position: (B, 3) wrist frame.
      object_quaternion: (B, 4) object frame to wrist frame.
      index: (B,) int, rows of the objects in `field`.
      field: signed distances from the objects' surfaces.
    """
    fixed = _inner_points(hand)
    points = _moved(transforms, fixed.links, fixed.points)
    local = rotations.inverse_transform(object_position, object_quaternion, points)
    return jnp.maximum(jnp.max(fixed.radii - field.at(index, local), -1), 0.0)


def hand_mesh(
    hand: Hand,
    transforms: tuple[Array, Array],
    object_position: Array,
    object_quaternion: Array,
    index: Array,
    field: DistanceField,
) -> Array:
    """Penetration (B,) in m of the object by points on the hand's meshes (`common.hands.meshes`);
    NaN without any.

    Arguments are those of `hand_object`. A finger through a thin blade counts with the blade's
    thickness.
    """
    links, points = mesh_points(hand)
    if not len(points):
        return jnp.full(len(index), jnp.nan)
    moved = _moved(transforms, links, points)
    local = rotations.inverse_transform(object_position, object_quaternion, moved)
    return jnp.maximum(jnp.max(-field.at(index, local), -1), 0.0)


def torque_share(scene: Scene) -> Array:
    """(B, M) |clip(kp (m_target - m) - kv m_velocity, limit)| / limit: torques of the fingers'
    motors at m.
    """
    hand = scene.hand
    state = scene.state
    kp = np.array([motor.kp for motor in hand.motors], np.float32)
    kv = np.array([motor.kv for motor in hand.motors], np.float32)
    limit = np.array([motor.torque_limit for motor in hand.motors], np.float32)
    lead = motor_positions(hand, state.q_target - state.q)
    velocity = motor_positions(hand, state.q_velocity)
    torque = kp * lead - kv * velocity
    return jnp.minimum(jnp.abs(torque) / limit, 1.0)


def segment_distance(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Distances (...,) between the segments from a to b and from c to d (..., 3).

    Ericson, "Real-Time Collision Detection" (2005), section 5.1.9.
    """
    u = b - a
    v = d - c
    w = a - c
    uu = _dot(u, u)
    vv = _dot(v, v)
    uv = _dot(u, v)
    uw = _dot(u, w)
    vw = _dot(v, w)
    across = uu * vv - uv * uv
    s = jnp.clip((uv * vw - uw * vv) / jnp.maximum(across, 1e-14), 0.0, 1.0)
    s = jnp.where(across > 1e-14, s, 0.0)
    t = jnp.clip((uv * s + vw) / jnp.maximum(vv, 1e-14), 0.0, 1.0)
    s = jnp.clip((uv * t - uw) / jnp.maximum(uu, 1e-14), 0.0, 1.0)
    return jnp.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)


def measures(samples: Sample, control_dt: float) -> dict[str, np.ndarray]:
    """Measures (B,) of episodes, over all of their control steps.

    Accelerations are differences of successive velocities over the control step, the first from
    rest; jerks are second differences.

    Args:
      samples: with leading axis T, NumPy arrays (T, B, ...).
      control_dt: seconds of a control step.

    Returns:
      The maxima `hand_hand_mm`, `hand_table_mm`, `hand_object_mm` and, for hands with meshes,
      `hand_mesh_mm`, in mm. `wrist_speed` (m/s) and `wrist_acceleration` (m/s^2): the peak, with
      `_mean` and `_p95` over the episode's steps. `finger_jerk`: root mean square over joints and
      steps, rad/s^3. `link_force_peak` (N): that of the link with the highest force; `link_force`:
      the mean over touching links (0 if none touches). `torque_share` and `torque_share_peak`: mean
      and peak over motors and steps. `posture_rad`: mean deviation from natural postures over the
      steps in which the hand touches the object (0 if it never does).
    """
    wrist = np.asarray(samples.wrist_velocity, np.float32)
    fingers = np.asarray(samples.finger_velocity, np.float32)
    force = np.asarray(samples.link_force, np.float32)
    torque = np.asarray(samples.torque_share, np.float32)
    acceleration = np.diff(wrist, axis=0, prepend=0 * wrist[:1]) / control_dt
    jerk = np.diff(fingers, n=2, axis=0, prepend=np.zeros_like(fingers[:2])) / control_dt**2
    touching = (force > 0).any(-1)
    posture = np.asarray(samples.posture, np.float32)
    contacts = np.maximum((force > 0).sum((0, 2)), 1)
    return {
        **_deepest_mm(samples),
        **_magnitudes("wrist_speed", wrist),
        **_magnitudes("wrist_acceleration", acceleration),
        "posture_rad": (posture * touching).sum(0) / np.maximum(touching.sum(0), 1),
        "finger_jerk": np.sqrt((jerk**2).mean((0, 2))),
        "link_force": force.sum((0, 2)) / contacts,
        "link_force_peak": force.max((0, 2)),
        "torque_share": torque.mean((0, 2)),
        "torque_share_peak": torque.max((0, 2)),
    }


def _deepest_mm(samples: Sample) -> dict[str, np.ndarray]:
    """Deepest penetrations (B,) in mm, without `hand_mesh_mm` for hands without meshes."""
    depths = {
        "hand_hand_mm": samples.hand_hand,
        "hand_table_mm": samples.hand_table,
        "hand_object_mm": samples.hand_object,
    }
    if not np.isnan(samples.hand_mesh).all():
        depths["hand_mesh_mm"] = samples.hand_mesh
    return {name: 1e3 * np.max(depth, 0) for name, depth in depths.items()}


def _magnitudes(name: str, vectors: np.ndarray) -> dict[str, np.ndarray]:
    """Peak, mean and 95th percentile (B,) of the lengths of vectors (T, B, 3), by name."""
    length = np.linalg.norm(vectors, axis=-1)
    return {
        name: length.max(0),
        f"{name}_mean": length.mean(0),
        f"{name}_p95": np.percentile(length, 95, axis=0),
    }


def is_clean(held: np.ndarray, measured: Mapping[str, np.ndarray]) -> np.ndarray:
    """(B,) bool: the object was held for two seconds without the table, and every penetration is
    below `CLEAN_MM`.

    Args:
      held: (B,) bool, True if the object was held.
      measured: result of `measures`.
    """
    clean = held
    for name, limit in CLEAN_MM.items():
        if name in measured:
            clean = clean & (measured[name] < limit)
    return clean


def _dot(a: Array, b: Array) -> Array:
    """Dot products over the last axis."""
    return jnp.sum(a * b, -1)


def _moved(transforms: tuple[Array, Array], links: np.ndarray, points: np.ndarray) -> Array:
    """Positions (..., P, 3) of points (P, 3) fixed to links (P,) at zero, wrist frame."""
    rotation, translation = transforms
    turned = rotations.apply(rotation[..., links, :, :], jnp.asarray(points)[:, None])[..., 0, :]
    return turned + translation[..., links, :]


@functools.cache
def mesh_points(hand: Hand) -> tuple[np.ndarray, np.ndarray]:
    """Links (P,) of the points on the hand's meshes, and the points (P, 3) in the wrist frame at
    zero.
    """
    names = [link.name for link in hand.links]
    meshes = {names.index(name): mesh for name, mesh in own_meshes(hand).items()}
    return points_on_meshes(meshes)


@functools.cache
def _colliding_pairs(hand: Hand) -> np.ndarray:
    """(2, Q) capsules that must not overlap, see `overlaps`."""
    links = hand.capsule_links
    names = [link.name for link in hand.links]
    nested = {frozenset(pair) for pair in overlapping(hand)}
    nested |= {frozenset((link.name, link.parent)) for link in hand.links}
    first, second = np.triu_indices(len(links), 1)
    collides = []
    for a, b in zip(links[first], links[second], strict=True):
        collides.append(a != b and frozenset((names[a], names[b])) not in nested)
    return np.stack([first, second])[:, collides]


@functools.cache
def _inner_points(hand: Hand) -> _LinkPoints:
    """Points on the axes of a hand's capsules, and on the solids of links that have some."""
    solids = {}
    for link, description in enumerate(hand.links):
        if description.solids:
            pieces = [
                Piece(solid.kind, solid.size, solid.position, solid.quaternion)
                for solid in description.solids
            ]
            solids[link] = mesh_of(pieces)
    solid_links, solid_points = points_on_meshes(solids)
    links = []
    points = []
    radii = []
    for link, radius, ends in zip(
        hand.capsule_links, hand.capsule_radii, hand.capsules, strict=True
    ):
        if link in solids:
            continue
        axis = _points_on_axis(*ends)
        points.append(axis)
        links += [link] * len(axis)
        radii += [radius] * len(axis)
    links += [*solid_links]
    radii += [0.0] * len(solid_links)
    return _LinkPoints(
        links=np.array(links, int),
        points=np.concatenate([*points, solid_points]),
        radii=np.array(radii, np.float32),
    )


def _points_on_axis(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Points (n, 3) on the axis of a capsule, float32."""
    count = 2 + int(np.linalg.norm(end - start) / _AXIS_SPACING)
    return np.linspace(start, end, count).astype(np.float32)
