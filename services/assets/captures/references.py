"""References of a hand from demonstrations: checked, transferred, and with separated fingers.

A human's finger angles and wrist do not apply to a robot hand. Its hand centre is placed at the
human one, with the grasp axes v and w (`common.hands.kinematics.grasp_frame`) along the human ones;
the fingers then close around the object. Lengths scale with the object, which is scaled for the
hand. Captured hands have other bones and flesh than the `human` hand that follows them, so that
their angles make its fingers overlap, in poses that no hand can hold.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from congrasp.common.hands.closure import widest_gap
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.kinematics import capsules, grasp_frame, link_transforms
from congrasp.common.hands.motors import transmission
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.shapes import hull_of, tessellate
from congrasp.common.objects.spec import GraspObject, Piece
from congrasp.common.rotations import continuous
from congrasp.common.task.plausibility import overlaps
from congrasp.common.task.sampling.closed_poses import closed_poses
from congrasp.common.task.sampling.headings import Headings
from congrasp.common.task.types import Array
from congrasp.services.assets.captures.extract import Demonstration
from congrasp.services.assets.captures.human import joint_positions
from congrasp.services.assets.captures.sequence import Dropped

MAX_DEPTH_M = 0.01
"""Tolerated depth of skin in the object, similar to the error of captured hands."""
MAX_OVERLAP_M = 0.001
"""Tolerated overlap of two links, as skin and flesh give way."""
_MAX_ITERATIONS = 100
_AXIS_SHARES = np.linspace(0.0, 1.0, 5)[:, None]
"""Shares of a capsule's axis at which its depth is computed."""
_POSES_AT_ONCE = 20
"""Number of poses closed in one compiled call."""


def check_reference(
    hand: Hand, demonstration: Demonstration, obj: GraspObject, scale: float
) -> None:
    """Raises Dropped for a reference that the hand cannot take.

    Args:
      hand: hand of the reference; for a hand other than the human one, which closes around the
        object by itself, only the width is checked.
      demonstration: demonstration of the human hand.
      obj: the unscaled object.
      scale: factor on the object's lengths for the hand.
    """
    touched_width = scale * width(demonstration)
    opening = widest_gap(hand)
    if touched_width > opening:
        reason = (
            f"thumb and fingers touch it {100 * touched_width:.1f} cm apart, but the hand opens "
            f"only {100 * opening:.1f} cm"
        )
        raise Dropped(demonstration.name, "too wide", reason)
    skin_depth = depth(demonstration, obj) if hand is HUMAN else 0.0
    if skin_depth > MAX_DEPTH_M:
        tolerated_mm = f"{1000 * MAX_DEPTH_M:.0f} mm"
        reason = (
            f"the hand is {1000 * skin_depth:.0f} mm deep in the object ({tolerated_mm} at most)"
        )
        raise Dropped(demonstration.name, "too deep", reason)


def width(demonstration: Demonstration) -> float:
    """Returns the extent of the touched points along the cross-finger axis, m."""
    turn = Rotation.from_quat(demonstration.quaternion[-1], scalar_first=True)
    along = demonstration.contact @ turn.apply(grasp_frame(HUMAN).cross)
    return float(np.ptp(along)) if len(along) else 0.0


def depth(demonstration: Demonstration, obj: GraspObject) -> float:
    """Returns the depth of the human hand's skin in a piece of the object, m.

    It is negative without contact, exact if a finger's axis is in the piece, and an upper bound
    beyond its edges.
    """
    ends = np.asarray(_capsules(HUMAN, demonstration.q.astype(np.float32)), float)
    axes = (1 - _AXIS_SHARES) * ends[:, :1] + _AXIS_SHARES * ends[:, 1:]
    turn = Rotation.from_quat(demonstration.quaternion[-1], scalar_first=True)
    points = turn.apply(axes.reshape(-1, 3)) + demonstration.position[-1]
    outside = np.min([_above_faces(piece, points) for piece in obj.pieces], axis=0)
    return float((np.repeat(HUMAN.capsule_radii, len(_AXIS_SHARES)) - outside).max())


@functools.partial(jax.jit, static_argnums=0)
def _capsules(hand: Hand, q: Array) -> Array:
    """Ends (C, 2, 3) of a hand's capsules at finger angles (F,), compiled as one program."""
    return capsules(hand, link_transforms(hand, q))


def _above_faces(piece: Piece, points: np.ndarray) -> np.ndarray:
    """Signed distances (N,) of points (N, 3) to the planes of a piece, negative inside, m."""
    vertices, _ = tessellate(piece)
    planes = hull_of(vertices).equations
    return np.asarray((points @ planes[:, :3].T + planes[:, 3]).max(-1))


def demonstrated_headings(demonstrations: Sequence[Demonstration], scale: float) -> Headings:
    """Returns the headings of the captured grasps: M hand centres, m, and axes, object frame.

    Args:
      demonstrations: M demonstrations on one object.
      scale: factor on the object's lengths.
    """
    frame = grasp_frame(HUMAN)
    quaternions = [demonstration.quaternion[-1] for demonstration in demonstrations]
    positions = [demonstration.position[-1] for demonstration in demonstrations]
    turns = Rotation.from_quat(quaternions, scalar_first=True)
    centers = scale * (turns.apply(_centers(demonstrations)) + positions)
    heading_axes = turns.apply(frame.heading)
    cross_axes = turns.apply(frame.cross)
    return Headings(*(rows.astype(np.float32) for rows in (centers, heading_axes, cross_axes)))


def transfer(
    hand: Hand, demonstrations: Sequence[Demonstration], obj: GraspObject, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns reference poses and wrist trajectories of another hand that follow demonstrations.

    Args:
      hand: any hand.
      demonstrations: M demonstrations on one object.
      obj: object scaled for the hand.
      scale: factor of this scaling.

    Returns:
      Finger angles (M, F) that close the hand at the last waypoint, and waypoints (M, K, 3) m and
      (M, K, 4) of its wrist in the object frame.
    """
    headings = demonstrated_headings(demonstrations, scale)
    q, last_positions = _close_at(hand, headings, obj)
    onto_human = _onto_human(hand)
    centers = _centers(demonstrations)
    positions = []
    quaternions = []
    for i, demonstration in enumerate(demonstrations):
        human = Rotation.from_quat(demonstration.quaternion, scalar_first=True)
        turn = human * onto_human
        center_path = scale * (human.apply(centers[i]) + demonstration.position)
        # The hand centre of the closed hand in the wrist frame follows from the last pose.
        center = turn[-1].inv().apply(center_path[-1] - last_positions[i])
        positions.append(center_path - turn.apply(center))
        quaternions.append(continuous(turn.as_quat(scalar_first=True)))
    return q, np.array(positions), np.array(quaternions)


def _close_at(hand: Hand, headings: Headings, obj: GraspObject) -> tuple[np.ndarray, np.ndarray]:
    """Finger angles (M, F) and wrist positions (M, 3) m of a hand that closes at M headings."""
    points = obj.points.astype(np.float32)
    normals = obj.normals.astype(np.float32)
    count = len(headings[0])
    batches = -(-count // _POSES_AT_ONCE)
    q = []
    positions = []
    for rows in np.resize(np.arange(count), (batches, _POSES_AT_ONCE)):
        fields = [field[rows] for field in headings]
        closed = closed_poses(hand, points, normals, *fields)
        q.append(np.asarray(closed[0]))
        positions.append(np.asarray(closed[1]))
    return np.concatenate(q)[:count], np.concatenate(positions)[:count]


def follow_human_wrist(
    hand: Hand, position: np.ndarray, rotation: Rotation
) -> tuple[np.ndarray, Rotation]:
    """Returns the path of a hand's wrist on which its open grasp moves like that of a human hand:
    for captures without fingers.

    Args:
      hand: any hand.
      position: (T, 3) positions of the human wrist, m.
      rotation: T orientations of its frame, that of the `human` hand.
    """
    turn = rotation * _onto_human(hand)
    centers = position + rotation.apply(grasp_frame(HUMAN).center)
    return centers - turn.apply(grasp_frame(hand).center), turn


def _centers(demonstrations: Sequence[Demonstration]) -> np.ndarray:
    """Centres (M, 3) of the human hand in its wrist frame, m.

    They are between the thumb's tip and the mean of the others.
    """
    tips = joint_positions(np.stack([d.q for d in demonstrations]))[:, :, 3]
    return (tips[:, 0] + tips[:, 1:].mean(1)) / 2


def _onto_human(hand: Hand) -> Rotation:
    """Rotation from the hand's wrist frame to the human one that aligns the grasp axes."""
    return Rotation.from_matrix(_axes(HUMAN) @ _axes(hand).T)


def _axes(hand: Hand) -> np.ndarray:
    """Axes v, w and v x w as columns (3, 3), in the wrist frame."""
    frame = grasp_frame(hand)
    return np.stack([frame.heading, frame.cross, np.cross(frame.heading, frame.cross)], -1)


def separate_fingers(hand: Hand, q: np.ndarray) -> np.ndarray:
    """Returns the nearest finger angles whose links overlap by at most `MAX_OVERLAP_M`.

    They minimise |q - q_0|^2 subject to the limit on all pairs of
    `common.task.plausibility.overlaps`, by sequential quadratic programming. The variables are
    motors, so that couplings and tendons are preserved; all joints stay within their limits.

    Args:
      hand: any hand.
      q: (M, F) rad, within the limits; poses within the limit are returned unchanged.
    """
    overlap = np.asarray(greatest_overlap(hand, q)) > MAX_OVERLAP_M
    poses = []
    for pose, overlaps_too_far in zip(q, overlap, strict=True):
        poses.append(_separate_pose(hand, pose) if overlaps_too_far else pose)
    return np.stack(poses)


@functools.partial(jax.jit, static_argnums=0)
def greatest_overlap(hand: Hand, q: Array) -> Array:
    """Returns the greatest overlap (M,) of two links at finger angles (M, F), m; 0 if none."""
    return jnp.maximum(overlaps(hand, link_transforms(hand, q)).max(-1), 0.0)


def _separate_pose(hand: Hand, q: np.ndarray) -> np.ndarray:
    """Separates one pose (F,)."""
    drive = transmission(hand)
    weight = np.bincount(drive.motor, drive.ratio**2)
    result = minimize(
        lambda way: (0.5 * weight @ way**2, weight * way),
        np.zeros(len(weight)),
        jac=True,
        method="SLSQP",
        bounds=_motor_bounds(hand, q),
        constraints={
            "type": "ineq",
            "fun": lambda way: np.asarray(_clearance(hand, q, way), float),
            # For two intersecting axes the direction of separation is undefined.
            "jac": lambda way: np.nan_to_num(np.asarray(_clearance_jacobian(hand, q, way), float)),
        },
        options={"maxiter": _MAX_ITERATIONS},
    )
    moved = q + drive.ratio * result.x[drive.motor]
    apart = np.clip(moved, hand.lower, hand.upper).astype(q.dtype)
    before, after = greatest_overlap(hand, np.stack([q, apart]))
    return apart if after < before else q


def _motor_bounds(hand: Hand, q: np.ndarray) -> list[tuple[float, float]]:
    """Range of each motor's motion from a pose (F,), until the first of its joints is at a limit.

    Zero is always within it.
    """
    drive = transmission(hand)
    ends = np.sort([(limit - q) / drive.ratio for limit in (hand.lower, hand.upper)], axis=0)
    bounds = []
    for motor in range(len(hand.motors)):
        is_moved = drive.motor == motor
        low = min(ends[0][is_moved].max(), 0.0)
        high = max(ends[1][is_moved].min(), 0.0)
        bounds.append((low, high))
    return bounds


def _clearance_of(hand: Hand, q: Array, way: Array) -> Array:
    """Remaining clearance (Q,) in mm of pairs of links after a motion of the motors.

    Args:
      hand: any hand.
      q: (F,) finger angles before it, rad.
      way: (M,) the motion.
    """
    drive = transmission(hand)
    moved = q + drive.ratio * way[drive.motor]
    return 1e3 * (MAX_OVERLAP_M - overlaps(hand, link_transforms(hand, moved)))


_clearance = jax.jit(_clearance_of, static_argnums=0)
_clearance_jacobian = jax.jit(jax.jacfwd(_clearance_of, 2), static_argnums=0)
