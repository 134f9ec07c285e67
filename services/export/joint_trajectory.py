"""Joints of a robot, and a motion as the trajectory of its controller."""

from typing import NamedTuple

import numpy as np

from congrasp.common.episode.episode import Episode

TRAJECTORY_START_NS = 10**9
"""Time of the first point of a trajectory."""


def robot_joints(motion: Episode) -> list[str]:
    """Returns the names of the arm's joints, if there is an arm, and of the hand's, all
    different.
    """
    names: list[str] = motion.arm.joint_names.tolist() if motion.arm else []
    arm_joints = set(names)
    for name in motion.joint_names.tolist():
        if name in arm_joints:
            name = f"hand_{name}"
        names.append(name)
    return names


class JointTrajectory(NamedTuple):
    """T points of N joints, in the order of `robot_joints`."""

    positions: np.ndarray
    """(T, N) rad, or m of slides."""
    velocities: np.ndarray
    """(T, N) rad/s or m/s; zero in the first and the last point."""
    stamps: list[int]
    """T times since the start, ns."""


def joint_trajectory(motion: Episode, fingers: np.ndarray) -> JointTrajectory:
    """Returns the points of a trajectory for a controller: it begins and ends at rest, one second
    after its start.

    Controllers reject a goal whose last point moves, and jump to a point at time zero.

    Args:
      motion: the motion.
      fingers: (T, F) angles of the fingers, rad.
    """
    positions = fingers
    if motion.arm is not None:
        positions = np.concatenate([motion.arm.joint_position, fingers], 1)
    velocities = np.zeros(positions.shape)
    velocities[1:-1] = (positions[2:] - positions[:-2]) / (2 * motion.control_dt)
    stamps = [TRAJECTORY_START_NS + round(1e9 * time) for time in motion.time.tolist()]
    return JointTrajectory(positions, velocities, stamps)
