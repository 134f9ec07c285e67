"""Which constraints of a request contradict one another, and what the priority rules make of it, in words.

`common.constraints.priority` decides; this says what it decided and how far apart the wishes were, so that a user can
tell a request that was bent from one that was kept.
"""

from typing import NamedTuple

import numpy as np

from common import rotations
from common.hands import kinematics
from common.hands.spec import Hand

TURNED = np.radians(30.0)
"""Angle between a heading and that of a stronger constraint from which on they contradict."""
APART = 0.02
"""Metres between a pose's wrist and a trajectory's end, likewise."""
TWISTED = 0.3
"""Radians between their orientations."""
TOUCHING = 0.015
"""Metres from a joint or fingertip of a reference pose to the surface that it is about to touch."""
_REACH = 0.15


class Contradiction(NamedTuple):
    """Two constraints that cannot both be met."""

    weaker: str
    stronger: str
    words: str
    """What contradicts, by how much, and what becomes of it."""
    refused: bool = False
    """Neither overrides the other: the request is an error."""


class Wishes(NamedTuple):
    """What is asked for on one object, object frame; None is free."""

    direction: np.ndarray | None = None
    """(3,) heading direction, unit."""
    position: np.ndarray | None = None
    """(3,) heading position, m."""
    minus: np.ndarray | None = None
    """(N,) bool, O-, where an affordance is asked for."""
    pose: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    """Finger angles (F,), wrist position (3,) and quaternion (4,)."""
    trajectory: tuple[np.ndarray, np.ndarray] | None = None
    """Waypoints (K, 3), (K, 4)."""


def contradictions(hand: Hand, points: np.ndarray, wishes: Wishes) -> list[Contradiction]:
    """What of a request contradicts the rest, strongest constraint first.

    Args:
      hand: the hand.
      points: (N, 3) surface points.
      wishes: the request.
    """
    found = [
        *_pose_and_trajectory(wishes),
        *_trajectory_and_affordance(points, wishes),
        *_pose_and_affordance(hand, points, wishes),
        *_heading_and_reference(hand, wishes),
        *_heading_and_affordance(points, wishes),
    ]
    return found


def _pose_and_trajectory(wishes: Wishes) -> list[Contradiction]:
    if wishes.pose is None or wishes.trajectory is None:
        return []
    _, position, quaternion = wishes.pose
    last, turn = (values[-1] for values in wishes.trajectory)
    apart, twist = float(np.linalg.norm(position - last)), _angle(quaternion, turn)
    if apart <= APART and twist <= TWISTED:
        return []
    words = (
        f"The reference pose holds the wrist {100 * apart:.1f} cm and {np.degrees(twist):.0f} degrees from where the "
        "trajectory ends. The trajectory decides on the wrist; of the pose only the fingers count."
    )
    return [Contradiction("pose", "trajectory", words)]


def _trajectory_and_affordance(points: np.ndarray, wishes: Wishes) -> list[Contradiction]:
    if wishes.trajectory is None or wishes.minus is None or wishes.pose is not None:
        return []
    away = np.linalg.norm(points - wishes.trajectory[0][-1], axis=-1)
    plus, minus = away[~wishes.minus].min(initial=np.inf), away[wishes.minus].min(initial=np.inf)
    if plus < minus:
        return []
    words = (
        f"The trajectory ends {100 * minus:.1f} cm from what must not be touched, and {100 * plus:.1f} cm from what "
        "may be grasped. Neither overrides the other: let it end nearer to the graspable part, or leave one out."
    )
    return [Contradiction("affordance", "trajectory", words, refused=True)]


def _pose_and_affordance(hand: Hand, points: np.ndarray, wishes: Wishes) -> list[Contradiction]:
    if wishes.pose is None or wishes.minus is None or not wishes.minus.any():
        return []
    q, position, quaternion = (np.asarray(part, np.float32) for part in wishes.pose)
    own = kinematics.keypoints(hand, kinematics.link_transforms(hand, q))
    here = np.asarray(rotations.transform(position, quaternion, own))
    away = np.linalg.norm(here[:, None] - points, axis=-1)
    touching = (away[:, wishes.minus].min(-1) < TOUCHING) & (
        away[:, wishes.minus].min(-1) < away[:, ~wishes.minus].min(-1, initial=np.inf)
    )
    if not touching.any():
        return []
    names = dict.fromkeys(hand.links[hand.keypoint_links[i]].name for i in np.flatnonzero(touching))
    words = (
        f"In the reference pose {', '.join(names)} would touch what must not be touched. The pose names its own "
        "contacts and overrides the affordance."
    )
    return [Contradiction("affordance", "pose", words)]


def _heading_and_reference(hand: Hand, wishes: Wishes) -> list[Contradiction]:
    if wishes.direction is None:
        return []
    if wishes.trajectory is not None:
        stronger, quaternion = "trajectory", wishes.trajectory[1][-1]
    elif wishes.pose is not None:
        stronger, quaternion = "pose", wishes.pose[2]
    else:
        return []
    axis = kinematics.grasp_frame(hand).heading
    own = np.asarray(rotations.rotate(np.asarray(quaternion, np.float32), axis))
    turn = float(np.arccos(np.clip(own @ wishes.direction, -1.0, 1.0)))
    if turn <= TURNED:
        return []
    words = (
        f"The heading differs by {np.degrees(turn):.0f} degrees from the way in which the {stronger} comes. "
        f"The {stronger} overrides it: the heading follows from it."
    )
    return [Contradiction("heading", stronger, words)]


def _heading_and_affordance(points: np.ndarray, wishes: Wishes) -> list[Contradiction]:
    if wishes.direction is None or wishes.position is None or wishes.minus is None:
        return []
    if wishes.pose is not None or wishes.trajectory is not None:
        return []
    along = np.linspace(-_REACH, 0.0, 31)[:, None] * wishes.direction + wishes.position
    away = np.linalg.norm(along[:, None] - points, axis=-1).min(0)
    plus, minus = away[~wishes.minus].min(initial=np.inf), away[wishes.minus].min(initial=np.inf)
    if minus >= plus:
        return []
    words = (
        f"The approach passes {100 * minus:.1f} cm from what must not be touched, and {100 * plus:.1f} cm from what "
        "may be grasped. The affordance turns the heading towards the graspable part."
    )
    return [Contradiction("heading", "affordance", words)]


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    """Radians between the rotations of two unit quaternions."""
    return float(2 * np.arccos(np.clip(abs(np.dot(a, b)), 0.0, 1.0)))
