"""The wrist's trajectory that leads to a captured grasp.

Definitions of terms that the paper leaves open:

* continuous: the wrist moves at most `JUMP` between two frames, and at most `GAP` frames in a row
  are missing;
* too complex: the path is more than `DETOUR` times its straight line, or the wrist rotates by more
  than `TURN` in total.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from congrasp.common.rotations import continuous
from congrasp.services.assets.captures.sequence import Dropped

NEAREST = 0.08
"""Least distance from which a wrist must come, m."""
FARTHEST = 0.20
"""Greatest distance at which a trajectory begins, m."""
JUMP = 0.10
"""Motion of a wrist between two frames, m."""
GAP = 3
"""Frames in a row that may be missing."""
DETOUR = 2.0
"""Length of a path relative to its straight line."""
TURN = 2.5
"""Rotation of a wrist on its way, rad."""
DIP = 0.01
"""Decrease of the distance, going backwards, after which its maximum counts as passed, m."""
_MAX_RESTING_STEP = 1e-6
"""Step of a wrist at rest, m."""


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
    start = _farthest(position, far, present, frame)
    if far[start] < NEAREST:
        reason = (
            f"the wrist comes from only {100 * far[start]:.1f} cm ({100 * NEAREST:.0f} cm are "
            f"needed)"
        )
        raise Dropped(name, "starts too near", reason)
    frames = np.flatnonzero(present[start : frame + 1]) + start
    path, turns = _truncated(position[frames], rotation[frames], far[frames])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    if steps.max(initial=0.0) <= _MAX_RESTING_STEP:
        raise Dropped(name, "no approach", "the wrist does not move before the grasp")
    _check_complexity(name, path, turns)
    waypoint_positions, waypoint_quaternions = _resampled(path, turns, waypoints)
    return Approach(start, waypoint_positions, waypoint_quaternions)


def _farthest(position: np.ndarray, far: np.ndarray, present: np.ndarray, frame: int) -> int:
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
        is_interrupted = elapsed > GAP + 1 or step > JUMP * elapsed
        is_past_maximum = far[t] < far[farthest] - DIP
        if is_interrupted or is_past_maximum:
            break
        previous = t
        if far[t] > far[farthest]:
            farthest = t
    return farthest


def _truncated(
    path: np.ndarray, rotations: np.ndarray, distance: np.ndarray
) -> tuple[np.ndarray, Rotation]:
    """Path from its last entry within `FARTHEST` on.

    The entry point is interpolated between two frames.

    Args:
      path: (n, 3) m.
      rotations: (n, 3, 3).
      distance: (n,) distance from the surface, m.
    """
    rotation = Rotation.from_matrix(rotations)
    outside = np.flatnonzero(distance > FARTHEST)
    if len(outside) == 0 or outside[-1] == len(distance) - 1:
        return path, rotation
    i = int(outside[-1])
    share = (distance[i] - FARTHEST) / (distance[i] - distance[i + 1])
    entry_rotation = Slerp([0.0, 1.0], rotation[[i, i + 1]])(share)
    entry = (1 - share) * path[i] + share * path[i + 1]
    truncated = np.concatenate([entry[None], path[i + 1 :]])
    return truncated, Rotation.concatenate([entry_rotation, rotation[i + 1 :]])


def _check_complexity(name: str, path: np.ndarray, rotation: Rotation) -> None:
    """Drops a sequence whose path (n, 3) has too much detour or rotation."""
    length = np.linalg.norm(np.diff(path, axis=0), axis=-1).sum()
    straight = np.linalg.norm(path[-1] - path[0])
    if length > DETOUR * straight:
        raise Dropped(
            name,
            "too complex",
            f"the wrist's path is {length / max(straight, 1e-9):.1f} times its straight line",
        )
    turn = float((rotation[1:] * rotation[:-1].inv()).magnitude().sum())
    if turn > TURN:
        raise Dropped(name, "too complex", f"the wrist rotates by {turn:.1f} rad on its way")


def _resampled(
    path: np.ndarray, rotation: Rotation, waypoints: int
) -> tuple[np.ndarray, np.ndarray]:
    """K waypoints at equal distances along the path, with quaternions of continuous sign."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    length = np.concatenate([[0.0], steps.cumsum()])
    # While the wrist rests the path length does not grow: the last of such frames is used.
    moves_next = np.append(np.diff(length) > _MAX_RESTING_STEP, True)
    length = length[moves_next]
    path = path[moves_next]
    rotation = rotation[moves_next]
    resampled_length = np.linspace(length[0], length[-1], waypoints)
    position = np.stack([np.interp(resampled_length, length, axis) for axis in path.T], -1)
    quaternion = Slerp(length, rotation)(resampled_length).as_quat(scalar_first=True)
    return position, continuous(quaternion)
