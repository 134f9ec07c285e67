"""The wrist's trajectory that leads to a captured grasp.

Definitions of terms that the paper leaves open:

* continuous: the wrist moves at most `MAX_STEP_M` between two frames, and at most
  `MAX_MISSING_FRAMES` in a row are missing;
* too complex: the path is more than `MAX_DETOUR` times its straight line, or the wrist rotates by
  more than `MAX_TURN_RAD` in total.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from congrasp.common.rotations import continuous
from congrasp.services.assets.captures.sequence import Dropped

MIN_START_DISTANCE_M = 0.08
"""Least distance of the wrist from the object at the start of a trajectory."""
MAX_START_DISTANCE_M = 0.20
"""Greatest such distance; what precedes it is left out."""
MAX_STEP_M = 0.10
"""Greatest motion of a wrist between two frames."""
MAX_MISSING_FRAMES = 3
"""Greatest number of missing frames in a row."""
MAX_DETOUR = 2.0
"""Greatest length of a path relative to its straight line."""
MAX_TURN_RAD = 2.5
"""Greatest sum of a wrist's rotations on its way."""
DISTANCE_DIP_M = 0.01
"""Decrease of the distance, backwards in time, after which its maximum counts as passed."""
_MAX_RESTING_STEP_M = 1e-6
"""Greatest step of a wrist at rest."""


class Approach(NamedTuple):
    """K waypoints of a wrist up to a grasp, in the object frame."""

    start: int
    """The frame of the farthest distance."""
    position: np.ndarray
    """(K, 3) m."""
    quaternion: np.ndarray
    """(K, 4)."""


def approach(
    name: str,
    position: np.ndarray,
    rotation: np.ndarray,
    far: np.ndarray,
    present: np.ndarray,
    frame: int,
    waypoints: int,
) -> Approach:
    """Extracts the wrist trajectory that leads to a grasp.

    Args:
      name: name of the motion.
      position: (T, 3) positions of the wrist, object frame, m.
      rotation: (T, 3, 3) rotations of the wrist.
      far: (T,) wrist-object distance, m.
      present: (T,) bool, True for known frames.
      frame: the grasping frame.
      waypoints: number K of waypoints.

    Raises:
      Dropped: the wrist starts too near or does not move, or its path is too complex.
    """
    start = _find_start(position, far, present, frame)
    if far[start] < MIN_START_DISTANCE_M:
        needed_cm = f"{100 * MIN_START_DISTANCE_M:.0f} cm"
        reason = f"the wrist comes from only {100 * far[start]:.1f} cm ({needed_cm} are needed)"
        raise Dropped(name, "starts too near", reason)
    frames = np.flatnonzero(present[start : frame + 1]) + start
    path, turns = _truncate(position[frames], rotation[frames], far[frames])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    if steps.max(initial=0.0) <= _MAX_RESTING_STEP_M:
        raise Dropped(name, "no approach", "the wrist does not move before the grasp")
    _check_complexity(name, path, turns)
    waypoint_positions, waypoint_quaternions = _resample(path, turns, waypoints)
    return Approach(start, waypoint_positions, waypoint_quaternions)


def _find_start(position: np.ndarray, far: np.ndarray, present: np.ndarray, frame: int) -> int:
    """Frame of the local maximum of the distance, along continuous motion before a frame.

    Args:
      position: (T, 3) positions of the wrist, m.
      far: (T,) wrist-object distance, m.
      present: (T,) bool, True for known frames.
      frame: the grasping frame.
    """
    farthest = frame
    previous = frame
    for t in range(frame - 1, -1, -1):
        if not present[t]:
            continue
        step = np.linalg.norm(position[previous] - position[t])
        elapsed = previous - t
        is_interrupted = elapsed > MAX_MISSING_FRAMES + 1 or step > MAX_STEP_M * elapsed
        is_past_maximum = far[t] < far[farthest] - DISTANCE_DIP_M
        if is_interrupted or is_past_maximum:
            break
        previous = t
        if far[t] > far[farthest]:
            farthest = t
    return farthest


def _truncate(
    path: np.ndarray, rotations: np.ndarray, distance: np.ndarray
) -> tuple[np.ndarray, Rotation]:
    """Path from its last entry within `MAX_START_DISTANCE_M` on.

    The entry point is interpolated between two frames.

    Args:
      path: (n, 3) m.
      rotations: (n, 3, 3).
      distance: (n,) distance from the surface, m.
    """
    rotation = Rotation.from_matrix(rotations)
    outside = np.flatnonzero(distance > MAX_START_DISTANCE_M)
    if len(outside) == 0 or outside[-1] == len(distance) - 1:
        return path, rotation
    i = int(outside[-1])
    share = (distance[i] - MAX_START_DISTANCE_M) / (distance[i] - distance[i + 1])
    entry_rotation = Slerp([0.0, 1.0], rotation[[i, i + 1]])(share)
    entry = (1 - share) * path[i] + share * path[i + 1]
    truncated = np.concatenate([entry[None], path[i + 1 :]])
    return truncated, Rotation.concatenate([entry_rotation, rotation[i + 1 :]])


def _check_complexity(name: str, path: np.ndarray, rotation: Rotation) -> None:
    """Drops a sequence whose path (n, 3) has too much detour or rotation."""
    length = np.linalg.norm(np.diff(path, axis=0), axis=-1).sum()
    straight = np.linalg.norm(path[-1] - path[0])
    if length > MAX_DETOUR * straight:
        raise Dropped(
            name,
            "too complex",
            f"the wrist's path is {length / max(straight, 1e-9):.1f} times its straight line",
        )
    turn = float((rotation[1:] * rotation[:-1].inv()).magnitude().sum())
    if turn > MAX_TURN_RAD:
        raise Dropped(name, "too complex", f"the wrist rotates by {turn:.1f} rad on its way")


def _resample(
    path: np.ndarray, rotation: Rotation, waypoints: int
) -> tuple[np.ndarray, np.ndarray]:
    """K waypoints at equal distances along the path, with quaternions of continuous sign."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    length = np.concatenate([[0.0], steps.cumsum()])
    # While the wrist rests the path length does not grow: the last of such frames is used.
    moves_next = np.append(np.diff(length) > _MAX_RESTING_STEP_M, True)
    length = length[moves_next]
    path = path[moves_next]
    rotation = rotation[moves_next]
    resampled_length = np.linspace(length[0], length[-1], waypoints)
    position = np.stack([np.interp(resampled_length, length, axis) for axis in path.T], -1)
    quaternion = Slerp(length, rotation)(resampled_length).as_quat(scalar_first=True)
    return position, continuous(quaternion)
