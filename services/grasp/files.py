"""The files of a grasp: `congrasp grasp` writes them into an object's folder, the result last."""

import hashlib
import json
import pathlib
import time
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.wire.codec import Message
from congrasp.services.arm.files import PICTURE as ARM_PICTURE
from congrasp.services.arm.files import save_picture, save_robot_video, save_trajectories
from congrasp.services.export.motion_file import save_motion
from congrasp.services.grasp.motion import Grasp
from congrasp.services.record.channels import JsonChannels
from congrasp.services.record.scene import episode_entries
from congrasp.services.record.writer import LogWriter
from congrasp.services.viz.render import (
    Film,
    episode_sheet,
    grasp_picture,
    grasp_steps,
    render_episode_frames,
    save_episode_video,
)
from congrasp.services.viz.sheets import save_png
from congrasp.services.viz.views import View, camera_of, views

MOTION, RECORDING, PICTURE, VIDEO, RESULT = "grasp.npz", "grasp.mcap", "grasp.png", "grasp.mp4", "result.json"
PORTRAIT = "portrait.png"
"""The last frame, 1280 x 720, from two sides."""
_FORMAT = 4  # of result.json: results of another format are repeated
THUMBNAIL = "thumbnail.png"
"""A small picture of the last frame."""
OBJECT = "object.png"
"""Pictures of the object before and after its import."""


_SMALL = (320, 240)  # pixels
_HELD = 0.5  # s of the hold in videos
_FRAMED = 10  # control steps between the frames that the video's camera must contain


def save_grasp(
    folder: pathlib.Path,
    found: Grasp,
    *,
    film: Film | None,
    pictures: bool,
    about: dict[str, Any],
    view: View | None = None,
) -> None:
    """Writes a grasp; the result comes last, so that its presence means that all files are complete.

    Args:
      folder: the object's folder.
      found: the grasp.
      film: style of the MP4; None writes none.
      pictures: also writes the contact sheet, the portrait, the thumbnail and, with an arm, the arm's picture.
      about: further entries of the result.
      view: viewpoint of pictures and video; the one that shows most of the grasp by default.

    Raises:
      CongraspError: a file cannot be written.
    """
    (folder / RESULT).unlink(missing_ok=True)
    save_motion(folder / MOTION, found.motion)
    save_recording(folder / RECORDING, found.episode)
    episode, arm = found.episode, found.motion.arm
    if arm:
        save_trajectories(folder, found.motion, arm)
        if pictures:
            save_picture(folder / ARM_PICTURE, arm, episode, found.first("hold"))
    steps = _steps_to_draw(*grasp_steps(episode), len(episode.arrays["table"]) - 1)
    last = steps[-1]
    if pictures:
        camera = camera_of(episode, steps, view=view, overlays=True)
        save_png(folder / PICTURE, episode_sheet(episode, steps=steps, camera=camera))
        save_png(folder / PORTRAIT, grasp_picture(episode, last, view=view))
        save_png(folder / THUMBNAIL, next(render_episode_frames(episode, [last], _SMALL, camera)))
    if film:
        until = min(found.first("hold") + round(_HELD / float(episode.meta["control_dt"])), last)
        filmed = [*range(found.first("grasp") // 2, until, _FRAMED), until]  # the hand comes into the picture
        aspect = film.size[0] / film.size[1]
        if arm:
            save_robot_video(folder / VIDEO, arm, episode, film, [*steps[:-1], until], until)
        else:
            seen_from = camera_of(episode, filmed, aspect, view or views(episode, steps)[0], overlays=film.overlays)
            save_episode_video(folder / VIDEO, episode, film, seen_from, until=until)
    write_atomically(folder / RESULT, json.dumps({**found.facts(), **about}, indent=2).encode())


def _steps_to_draw(first: int, end: int, last: int) -> list[int]:
    """Up to eight steps to draw: before the grasp begins at `first`, during it, after its `end`, and the last one."""
    reach = [0, first / 2] if first else []
    grasp = np.linspace(first, min(end, last), 6 - len(reach))
    return sorted({round(step) for step in [*reach, *grasp, (end + last) / 2, last]})


def save_recording(path: pathlib.Path, episode: Message) -> None:
    """Writes an episode as an MCAP file of that name.

    Raises:
      CongraspError: the file cannot be written.
    """
    try:
        writer = LogWriter(path.parent, f".{path.stem}", run=str(episode.meta["object"]))
        writer.write(*episode_entries("grasp", episode, time.time_ns(), 0, JsonChannels()))
        writer.close()
        writer.files[-1].rename(path)
    except OSError as error:
        raise CongraspError(f"{path} could not be written: {error.strerror}.") from None


def finished(folder: pathlib.Path, key: str) -> dict[str, Any] | None:
    """The stored result of an earlier grasp with the same key; None if there is none."""
    try:
        result = json.loads((folder / RESULT).read_text())
    except (OSError, ValueError):
        return None
    return result if isinstance(result, dict) and result.get("key") == key else None


def key_of(*parts: Any) -> str:
    """Sixteen hex digits that change with any input of a grasp."""
    return hashlib.sha256(json.dumps((_FORMAT, *parts), default=str).encode()).hexdigest()[:16]
