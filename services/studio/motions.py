"""Motions of a studio: the newest ones, and their files for download."""

import pathlib
import shutil
import tempfile
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.task.constraints import get_constraint
from congrasp.common.wire.codec import Message
from congrasp.services.export.motion_file import motion_of_episode, save_motion
from congrasp.services.export.motion_formats import FORMATS, export_motions
from congrasp.services.record.channels import JsonChannels
from congrasp.services.record.goals import active_constraints
from congrasp.services.record.scene import episode_entries
from congrasp.services.record.writer import LogWriter
from congrasp.services.studio.drawing import vector
from congrasp.services.studio.server import Download
from congrasp.services.viz.render import Film, render_episode_frames, save_episode_video
from congrasp.services.viz.scene import Camera
from congrasp.services.viz.sheets import png_of

_ABOVE = np.cos(np.radians(45.0))
MOST = 30
"""Number of motions kept; the oldest is dropped first."""
DATA = ("npz", "mcap", *FORMATS)
"""Formats in which a motion can be saved at once."""
DRAWN = ("mp4", "png")
"""Formats that are rendered first, in a job."""
_PICTURE, _VIDEO = (1280, 720), (854, 480)  # pixels


class Motions:
    """The newest motions, by number."""

    def __init__(self) -> None:
        """Begins without motions."""
        self._kept: dict[str, Message] = {}
        self._number = 0

    def keep(self, episode: Message) -> str:
        """Keeps a motion; returns its number."""
        self._number += 1
        self._kept[str(self._number)] = episode
        while len(self._kept) > MOST:
            del self._kept[next(iter(self._kept))]
        return str(self._number)

    def get(self, key: str) -> Message:
        """A motion by its number; a CongraspError if there is none."""
        if key not in self._kept:
            raise CongraspError(f"There is no motion '{key[:60]}'.", "Press Grasp, or choose one of the list.")
        return self._kept[key]

    def delete(self, key: str) -> None:
        """Deletes a motion, if there is one of this number."""
        self._kept.pop(key, None)

    def view(self) -> list[dict[str, Any]]:
        """List entries of the motions, the newest first."""
        return [_described(key, episode) for key, episode in self._kept.items()][::-1]


def _asked(episode: Message) -> str:
    """Request of a motion in words: its constraints, and the direction of the approach, world frame."""
    arrays, names = episode.arrays, active_constraints(episode.arrays)[1:]
    turn = Rotation.from_quat(arrays["object_quaternion"][0], scalar_first=True)
    down = -float(turn.apply(np.asarray(arrays["goal/heading_direction"], float))[2])
    way = "from above" if down > _ABOVE else "from below" if down < -_ABOVE else "from the side"
    return ", ".join([*(get_constraint(name).title for name in names), way])


def _described(key: str, episode: Message) -> dict[str, Any]:
    """List entry of a motion."""
    meta, metrics = episode.meta, episode.meta.get("metrics", {})
    return {
        "id": key,
        "object": meta["object"],
        "asked": _asked(episode),
        "success": bool(meta["success"]),
        "held": bool(metrics.get("held", 0.0) > 0),
        "note": meta.get("note", ""),
        "version": meta.get("version"),
        "steps": len(episode.arrays["table"]),
        "metrics": {name: float(value) for name, value in metrics.items() if np.isfinite(value)},
    }


def data_file(episode: Message, key: str, kind: str) -> Download:
    """A motion as a file of one of `DATA`; formats that are folders become zip archives.

    Raises:
      CongraspError: there is no such kind, or a package for it is absent.
    """
    if kind not in DATA:
        raise CongraspError(f"A motion cannot be saved as '{kind[:20]}'.", f"Choose from: {', '.join(DATA)}.")
    with tempfile.TemporaryDirectory(prefix="congrasp-export-") as folder:
        path = pathlib.Path(folder) / f"motion{FORMATS.get(kind, f'.{kind}')}"
        try:
            if kind == "npz":
                save_motion(path, motion_of_episode(episode))
            elif kind == "mcap":
                writer = LogWriter(pathlib.Path(folder), "motion", run="studio")
                writer.write(*episode_entries("studio", episode, 0, 0, JsonChannels()))
                writer.close()
                path = writer.files[0]
            else:
                export_motions([motion_of_episode(episode)], kind, path)
        except ModuleNotFoundError as error:
            raise CongraspError(
                f"This needs the package '{error.name}'.", "Run: pip install 'congrasp[export]'"
            ) from None
        if path.is_dir():
            path = pathlib.Path(shutil.make_archive(str(path), "zip", path))
        suffix = f".{kind}" if kind in ("npz", "mcap") else FORMATS[kind] or f"-{kind}.zip"
        return Download(_name(episode, key, suffix), path.read_bytes())


def drawing(
    episode: Message, key: str, kind: str, view: Mapping[str, Any], frame: int, progress: Callable[[float], None]
) -> Download:
    """A motion as MP4, or one of its frames as PNG, from the page's camera.

    Args:
      episode: the motion.
      key: its key, for the file's name.
      kind: one of `DRAWN`.
      view: the page's camera: position and target (3,) in the world, m, and its vertical field_of_view in degrees.
      frame: control step of the PNG.
      progress: called with the completed share, from 0 to 1, of an MP4.

    Raises:
      CongraspError: the kind, the camera or the frame is invalid.
    """
    if kind not in DRAWN:
        raise CongraspError(f"A motion cannot be drawn as '{str(kind)[:20]}'.", f"Choose from: {', '.join(DRAWN)}.")
    camera = _camera(view)
    if kind == "png":
        if not isinstance(frame, int) or not 0 <= frame < len(episode.arrays["table"]):
            raise CongraspError(f"The motion has no frame {ascii(frame)[:20]}.")
        (image,) = render_episode_frames(episode, [frame], _PICTURE, camera)
        return Download(_name(episode, key, f"-{frame}.png"), png_of(image))
    with tempfile.TemporaryDirectory(prefix="congrasp-video-") as folder:
        path = pathlib.Path(folder) / "motion.mp4"
        save_episode_video(path, episode, Film(_VIDEO, overlays=True), camera, progress)
        return Download(_name(episode, key, ".mp4"), path.read_bytes())


def _camera(view: Mapping[str, Any]) -> Camera:
    """The page's camera."""
    if not isinstance(view, Mapping):
        raise CongraspError("The camera must have a position, a target and a field of view.")
    position, target = (vector(f"camera's {name}", view.get(name)) for name in ("position", "target"))
    angle = float(vector("camera's field of view", [view.get("field_of_view"), 0.0, 0.0])[0])
    if np.linalg.norm((target - position)[:2]) < 1e-6 or not 1 <= angle <= 120:
        raise CongraspError("The camera looks straight down, or its field of view is not 1 to 120 degrees.")
    return Camera(position, target, angle)


def _name(episode: Message, key: str, suffix: str) -> str:
    """Name of a motion's file."""
    number = "".join(c if c.isalnum() else "-" for c in key)[-40:]
    return f"{episode.meta['object']}-{number}{suffix}"
