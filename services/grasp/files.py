"""The files of a grasp: `congrasp grasp` writes them into an object's folder, the result last."""

import itertools
import json
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from congrasp.common.episode.motion_file import save_motion
from congrasp.common.io.files import write_atomically
from congrasp.common.runtime.progress import Progress, ignore_progress
from congrasp.services.grasp.arm_files import (
    ARM_PICTURE,
    save_robot_picture,
    save_robot_video,
    save_trajectories,
)
from congrasp.services.grasp.motion import Grasp
from congrasp.services.record.episode_file import save_episode
from congrasp.services.viz.film import Film, save_episode_video
from congrasp.services.viz.render import (
    episode_sheet,
    grasp_picture,
    render_episode_frames,
)
from congrasp.services.viz.sheets import save_png
from congrasp.services.viz.views import View, camera_of

MOTION = "grasp.npz"
RECORDING = "grasp.mcap"
PICTURE = "grasp.png"
VIDEO = "grasp.mp4"
RESULT = "result.json"
PORTRAIT = "portrait.png"
"""The last frame, 1280 x 720, from two sides."""
THUMBNAIL = "thumbnail.png"
"""A small picture of the last frame."""
OBJECT = "object.png"
"""Pictures of the object before and after its import."""
_THUMBNAIL_SIZE = (320, 240)  # pixels
_PICTURES = 8
"""Largest number of pictures of the contact sheet."""


def save_grasp(
    folder: pathlib.Path,
    grasp: Grasp,
    *,
    film: Film | None,
    pictures: bool,
    about: dict[str, Any],
    view: View | None = None,
    progress: Progress = ignore_progress,
) -> None:
    """Writes a grasp.

    The result is written last: if it exists, all files are complete.

    Args:
      folder: the object's folder.
      grasp: the grasp.
      film: style of the MP4; None writes none.
      pictures: also writes the contact sheet, the portrait, the thumbnail and, with an arm, the
        arm's picture.
      about: further entries of the result.
      view: viewpoint of pictures and video; by default the viewpoint that shows most of the grasp.
      progress: called with the number of pictures and frames drawn.

    Raises:
      CongraspError: a file cannot be written.
    """
    (folder / RESULT).unlink(missing_ok=True)
    save_motion(folder / MOTION, grasp.motion)
    save_episode(folder / RECORDING, "grasp", grasp.episode)
    if grasp.episode.arm:
        save_trajectories(folder, grasp.motion, grasp.episode.arm)
    if pictures:
        _save_pictures(folder, grasp, view, progress)
    if film:
        _save_video(folder / VIDEO, grasp, film, view, progress)
    content = {**grasp.facts(), **about}
    write_atomically(folder / RESULT, json.dumps(content, indent=2).encode())


def read_result(folder: pathlib.Path, key: str) -> dict[str, Any] | None:
    """Reads the result of an earlier grasp with the same key; None if there is none."""
    try:
        result = json.loads((folder / RESULT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(result, dict) or result.get("key") != key:
        return None
    return result


def steps_to_draw(first: int, end: int, last: int) -> list[int]:
    """Control steps of a contact sheet, in order: before, during and after the grasp, and the last
    step.

    Args:
      first: first step of the grasp itself.
      end: first step after the grasp.
      last: last step of the episode.
    """
    reach = [0, first / 2] if first else []
    during = np.linspace(first, min(end, last), _PICTURES - 2 - len(reach))
    return sorted({round(step) for step in [*reach, *during, (end + last) / 2, last]})


def _drawn_steps(grasp: Grasp) -> list[int]:
    """Control steps of a grasp's contact sheet."""
    first, end = grasp.episode.grasp_span
    return steps_to_draw(first, end, grasp.episode.steps - 1)


def _save_pictures(
    folder: pathlib.Path, grasp: Grasp, view: View | None, progress: Progress
) -> None:
    """Writes the contact sheet, the portrait, the thumbnail and, with an arm, the arm's picture."""
    episode = grasp.episode
    steps = _drawn_steps(grasp)
    last = steps[-1]
    pictures = 4 if episode.arm else 3

    def save(number: int, name: str, image: np.ndarray) -> None:
        """Writes a picture and reports it."""
        save_png(folder / name, image)
        progress("Drawing pictures", number, pictures)

    progress("Choosing the view", 0, 0)
    camera = camera_of(episode, steps, view=view, overlays=True)
    progress("Drawing pictures", 0, 0)
    save(1, PICTURE, episode_sheet(episode, steps=steps, camera=camera))
    save(2, PORTRAIT, grasp_picture(episode, last, view=view))
    thumbnail = next(render_episode_frames(episode, [last], _THUMBNAIL_SIZE, camera))
    save(3, THUMBNAIL, thumbnail)
    if episode.arm:
        save_robot_picture(folder / ARM_PICTURE, episode.arm, episode, grasp.first("hold"))
        progress("Drawing pictures", 4, pictures)


def _save_video(
    path: pathlib.Path, grasp: Grasp, film: Film, view: View | None, progress: Progress
) -> None:
    """Writes the MP4 of a grasp, from the reach to the end of the hold."""
    arm = grasp.episode.arm
    progress("Choosing the view", 0, 0)
    frames = _frame_counter("Drawing the video", progress)
    if arm:
        save_robot_video(path, arm, grasp.episode, film, _drawn_steps(grasp), frames)
    else:
        save_episode_video(path, grasp.episode, film._replace(view=view), progress=frames)


def _frame_counter(activity: str, progress: Progress) -> Callable[[float], None]:
    """Function to call with the share of drawn frames after each frame; reports their number."""
    numbers = itertools.count(1)

    def report(share: float) -> None:
        """Reports one more frame."""
        number = next(numbers)
        progress(activity, number, round(number / share))

    return report
