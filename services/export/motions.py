"""The motions to export: read from motion files and recordings, and resampled."""

import dataclasses
import pathlib

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.services.export.episode_motion import motion_of_episode
from congrasp.services.export.motion import ARRAYS, GraspMotion
from congrasp.services.export.motion_file import load_motion

_TIMED_SHAPES = ("(T,", "(T)")
"""Beginnings of the meanings of arrays with a row for each frame."""


def pick_motion(path: pathlib.Path, index: int = -1, *, success: bool = False) -> GraspMotion:
    """The motion of an NPZ file, or an episode recorded at `path` (see `pick_episode`).

    Raises:
      CongraspError: `path` is missing or holds no motion, or an NPZ file's index is neither -1 nor
        0.
    """
    if not path.exists():
        raise CongraspError(
            f"There is no {path}.", "Pass a motion (.npz), a recording (.mcap) or a run's folder."
        )
    if path.suffix == ".npz":
        if index not in (-1, 0):
            raise CongraspError(
                f"{path} is one motion and has no number {index}.", "Remove --index."
            )
        return load_motion(path)
    if path.is_file() and path.suffix != ".mcap":
        raise CongraspError(
            f"{path} holds no motion.", "Pass a grasp.npz, a recording (.mcap) or a run's folder."
        )
    from congrasp.services.record.reader import pick_episode  # with MCAP's packages

    return motion_of_episode(pick_episode(path, index, success=success))


def at_rate(motion: GraspMotion, fps: float) -> GraspMotion:
    """Returns the motion at another frame rate: for each of its times the nearest frame, at most
    half a step off.

    Raises:
      CongraspError: the rate is above the motion's own, or not above zero.
    """
    motion_fps = 1 / motion.control_dt
    if not 0 < fps <= motion_fps + 1e-6:
        raise CongraspError(
            f"--fps is {fps:g}.",
            f"The motion has {motion_fps:g} frames a second: set at most as many.",
        )
    last_frame = len(motion.time) - 1
    time = np.arange(int(last_frame * fps / motion_fps + 1e-6) + 1) / fps
    nearest = np.minimum(np.round(time * motion_fps).astype(int), last_frame)
    arrays = {}
    for name, meaning in ARRAYS.items():
        if meaning.startswith(_TIMED_SHAPES):
            arrays[name] = getattr(motion, name)[nearest]
    arrays["time"] = time.astype(motion.time.dtype)
    arm = motion.arm.at(nearest) if motion.arm else None
    return dataclasses.replace(motion, **arrays, control_dt=1 / fps, arm=arm)
