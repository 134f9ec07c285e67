"""What episodes are drawn from: objects, resting poses, heading sets, reference poses and wrist trajectories.

Stacked over the N objects of a pool, so that a compiled reset gathers by object index. The axis V has two variants:
0 for the whole surface, 1 for the affordance region O+.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from common.config import TaskConfig
from common.constraints.headings import Headings, above, feasible, sample_headings
from common.constraints.poses import closed_poses
from common.constraints.trajectories import make_trajectories
from common.errors import CongraspError
from common.hands.spec import Hand
from common.objects.spec import SURFACE_POINTS, GraspObject
from common.task.types import Array

HEADINGS = 256
POSES = 20
_WAYPOINT_CLEARANCE = 0.02
_HEADING_CLEARANCE = -0.012
"""Heading positions may lie this far under the table's top: 2 cm inside a thin object that lies flat."""


class TaskSet(NamedTuple):
    """N objects; R resting poses, H headings and M reference poses each; object frame unless said otherwise."""

    points: Array
    """(N, P, 3) surface points."""
    minus: Array
    """(N, P) bool, O-."""
    rest: Array
    """(N, R, 7) resting poses in the world; unused rows repeat earlier ones."""
    heading_position: Array
    """(N, V, H, 3)."""
    heading_direction: Array
    """(N, V, H, 3)."""
    heading_cross: Array
    """(N, V, H, 3)."""
    heading_index: Array
    """(N, V, R, H) feasible headings of each resting pose, repeated to fill the row."""
    pose_q: Array
    """(N, V, M, F)."""
    pose_position: Array
    """(N, V, M, 3)."""
    pose_quaternion: Array
    """(N, V, M, 4)."""
    trajectory_position: Array
    """(N, V, M, K, 3); trajectory m ends at pose m."""
    trajectory_quaternion: Array
    """(N, V, M, K, 4)."""
    pose_index: Array
    """(N, V, R, M) poses whose trajectory stays above the table in each resting pose, repeated to fill the row."""
    has_pose: Array
    """(N, V, R) bool: the row of `pose_index` is not empty."""
    has_affordance: Array
    """(N, R) bool: the object has an O-, and its O+ can be approached in the resting pose."""


def _repeat(indices: np.ndarray, length: int) -> np.ndarray:
    """Indices repeated to a length; zeros where there are none."""
    return np.resize(indices, length) if len(indices) else np.zeros(length, int)


def _world(rest: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Heights (...,) over the table of points (..., 3) of the object frame in a resting pose (7,)."""
    w, x, y, z = rest[3:]
    row = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    return points @ row + rest[2]


def build_taskset(hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], seed: int) -> TaskSet:
    """Heading sets by the paper's rules, and procedural reference poses and trajectories, for a pool of objects.

    Raises:
      CongraspError: an object has no heading that the hand can reach in any resting pose.
    """
    rng = np.random.default_rng(seed)
    rows = [_object_row(hand, task, obj, rng) for obj in objects]
    rests = max(len(row["rest"]) for row in rows)
    for row in rows:
        fill = np.resize(np.arange(len(row["rest"])), rests)
        row["rest"] = row["rest"][fill]
        for name in ("heading_index", "pose_index", "has_pose"):
            row[name] = row[name][:, fill]
        row["has_affordance"] = row["has_affordance"][fill]
    stacked = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return TaskSet(**{name: jnp.asarray(_compact(value)) for name, value in stacked.items()})


def _compact(value: np.ndarray) -> np.ndarray:
    if value.dtype == np.float64:
        return value.astype(np.float32)
    return value.astype(np.int32) if value.dtype == np.int64 else value


def _object_row(hand: Hand, task: TaskConfig, obj: GraspObject, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Everything of one object; resting poses without a reachable heading are left out."""
    variants = [_variant(hand, task, obj, use_affordance, rng) for use_affordance in (False, True)]
    usable = [r for r in range(len(obj.rest_poses)) if variants[0]["feasible"][r].any()]
    if not usable:
        raise CongraspError(
            f"The object '{obj.name}' cannot be approached in any of its resting poses.",
            "Scale it so that some part is narrower than 12 cm, or leave it out.",
        )
    keep = rng.permutation(SURFACE_POINTS)[: task.surface_points]
    minus = obj.non_graspable_points
    return {
        "points": obj.points[keep],
        "minus": minus[keep],
        "rest": obj.rest_poses[usable],
        "has_affordance": np.array([minus[keep].any() and variants[1]["feasible"][r].any() for r in usable]),
        "heading_index": np.array(
            [[_repeat(np.flatnonzero(v["feasible"][r]), HEADINGS) for r in usable] for v in variants]
        ),
        "pose_index": np.array([[_repeat(np.flatnonzero(v["clear"][r]), POSES) for r in usable] for v in variants]),
        "has_pose": np.array([[v["clear"][r].any() for r in usable] for v in variants]),
        **{name: np.stack([v[name] for v in variants]) for name in variants[0] if name not in ("feasible", "clear")},
    }


def _variant(
    hand: Hand, task: TaskConfig, obj: GraspObject, use_affordance: bool, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Headings, poses and trajectories of one object for the whole surface or for O+."""
    headings = sample_headings(obj, rng, count=HEADINGS, use_affordance=use_affordance)
    reachable = np.stack([_reachable(task, headings, rest) for rest in obj.rest_poses])
    # Reference poses are made at headings that some resting pose allows, where there are any.
    candidates = np.flatnonzero(reachable.any(0)) if reachable.any() else np.arange(HEADINGS)
    chosen = rng.choice(candidates, POSES, replace=len(candidates) < POSES)
    poses = closed_poses(
        hand,
        jnp.asarray(obj.points),
        jnp.asarray(obj.normals),
        *(jnp.asarray(np.asarray(field)[chosen], jnp.float32) for field in headings),
    )
    position, quaternion = np.asarray(poses.position), np.asarray(poses.quaternion)
    path, turns = make_trajectories(hand, position, quaternion, rng, task.trajectory_points)
    clear = np.stack(
        [
            reachable[r][chosen] & (_world(rest, path).min(-1) > _WAYPOINT_CLEARANCE)
            for r, rest in enumerate(obj.rest_poses)
        ]
    )
    return {
        "heading_position": headings.position,
        "heading_direction": headings.direction,
        "heading_cross": headings.cross,
        "feasible": reachable,
        "pose_q": np.asarray(poses.q),
        "pose_position": position,
        "pose_quaternion": quaternion,
        "trajectory_position": path,
        "trajectory_quaternion": turns,
        "clear": clear,
    }


def _reachable(task: TaskConfig, headings: Headings, rest: np.ndarray) -> np.ndarray:
    mask = feasible(headings, rest, clearance=_HEADING_CLEARANCE, back_off=task.back_off)
    return mask & above(headings, rest) if task.headings == "above" else mask
