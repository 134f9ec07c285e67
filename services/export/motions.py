"""The motions to export: read from motion files and recordings, and resampled."""

import dataclasses
import pathlib

import numpy as np

from congrasp.common.episode.episode import Episode
from congrasp.common.episode.motion_file import load_motion
from congrasp.common.errors import CongraspError

_RATE_TOLERANCE = 1e-6  # frames


def pick_motion(path: pathlib.Path, index: int = -1, *, success: bool = False) -> Episode:
    """The motion of an NPZ file, or an episode recorded at `path` (see `pick_episode`), with
    normalised quaternions.

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
                f"{path} holds a single motion, without the number {index}.", "Remove --index."
            )
        return load_motion(path)
    if path.is_file() and path.suffix != ".mcap":
        raise CongraspError(
            f"{path} contains no motion.",
            "Pass a grasp.npz, a recording (.mcap) or a run's folder.",
        )
    from congrasp.services.record.reader import pick_episode  # with MCAP's packages

    return pick_episode(path, index, success=success).normalised()


def at_rate(motion: Episode, fps: float) -> Episode:
    """Returns the motion at another frame rate, from the frames nearest in time.

    Args:
      motion: the motion.
      fps: frames per second, at most its own rate.

    Raises:
      CongraspError: the rate is above the motion's own, or not above zero.
    """
    rate = 1 / motion.control_dt
    if not 0 < fps <= rate + _RATE_TOLERANCE:
        raise CongraspError(
            f"--fps is {fps:g}.",
            f"Pass at most {rate:g}, the frames per second of the motion.",
        )
    last = motion.steps - 1
    count = int(last * fps / rate + _RATE_TOLERANCE) + 1
    time = np.arange(count) / fps
    nearest = np.minimum(np.round(time * rate).astype(int), last)
    return dataclasses.replace(
        motion.at_frames(nearest), time=time.astype(motion.time.dtype), control_dt=1 / fps
    )
