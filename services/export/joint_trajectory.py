"""Joint trajectories of arm and hand for controllers."""

import numpy as np

from congrasp.common.episode.episode import Episode

TRAJECTORY_START_NS = 10**9
"""Time of the first point of a trajectory."""


def robot_joints(motion: Episode) -> list[str]:
    """Returns the names of the arm's joints, if there is an arm, and of the hand's, all
    different.
    """
    names = []
    if motion.arm:
        names = motion.arm.joint_names.tolist()
    of_arm = set(names)
    for name in motion.joint_names.tolist():
        names.append(f"hand_{name}" if name in of_arm else name)
    return names


def joint_trajectory(
    motion: Episode, fingers: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Returns the points of a trajectory for a controller: it begins and ends at rest, one second
    after its start.

    Controllers reject a goal whose last point moves, and jump to a point at time zero.

    Args:
      motion: the motion.
      fingers: (T, F) angles of the fingers, rad.

    Returns:
      Positions and velocities (T, N) of the joints of `robot_joints`, and T times since the start,
      ns.
    """
    positions = fingers
    if motion.arm:
        positions = np.concatenate([motion.arm.joint_position, fingers], 1)
    velocities = np.zeros(positions.shape)
    velocities[1:-1] = (positions[2:] - positions[:-2]) / (2 * motion.control_dt)
    times = [TRAJECTORY_START_NS + round(1e9 * time) for time in motion.time.tolist()]
    return positions, velocities, times
