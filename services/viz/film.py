"""Films of recorded episodes: MP4 in real time, by a camera that follows hand and object."""

import functools
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError, need_package, os_errors_as
from congrasp.common.io.opening import temporary_file
from congrasp.common.io.spelling import check_spelling
from congrasp.common.runtime import platforms
from congrasp.services.appearance.palette import INK
from congrasp.services.viz.camera import Camera
from congrasp.services.viz.camera_path import following_cameras
from congrasp.services.viz.render import (
    Around,
    draw_frames,
    nothing_around,
    phase_label,
)
from congrasp.services.viz.sheets import save_video
from congrasp.services.viz.views import View, best_view

_SMALLEST_SIDE = 64
_LARGEST_SIDE = 4096
"""Limits of a film's width and height, pixels."""
_CAPTION_HEIGHT = 1 / 30
"""Height of the caption's letters, in heights of the picture."""
_LEAST_CAPTION_PIXELS = 10
_LEAST_CAPTIONED_HEIGHT = 200
"""Height in pixels from which a film has room for a caption."""


class Film(NamedTuple):
    """Style of a film."""

    size: tuple[int, int] = (960, 720)
    """Width and height in pixels, both even."""
    fps: float = 25.0
    """Frames per second."""
    overlays: bool = False
    """Draws the active constraints, and links in contact in green."""
    view: View | None = None
    """Direction from the scene to the camera; the best one of the grasp by default."""

    @property
    def aspect(self) -> float:
        """Width over height."""
        width, height = self.size
        return width / height


def film_of(size: str, fps: float, overlays: bool) -> Film:
    """Style of a film, from its size as WIDTHxHEIGHT, both even and from 64 to 4096 pixels.

    Raises:
      CongraspError: the size is malformed, or a package for videos is missing.
    """
    need_package("--video", "imageio_ffmpeg")
    sides = _sides(size)
    if sides is None:
        raise CongraspError(
            f"--size is '{size}'.", "Write two even numbers from 64 to 4096: --size 1920x1080"
        )
    return Film(sides, fps, overlays)


def _sides(text: str) -> tuple[int, int] | None:
    """Width and height of a text WIDTHxHEIGHT; None if they are malformed or not permitted."""
    words = text.lower().split("x")
    if len(words) != 2:
        return None
    if not all(word.isdecimal() and len(word) < 5 for word in words):
        return None
    width, height = map(int, words)
    for side in (width, height):
        if side % 2 or not _SMALLEST_SIDE <= side <= _LARGEST_SIDE:
            return None
    return width, height


def film_steps(episode: Episode, fps: float) -> list[int]:
    """Control steps of the frames of a film in real time, from the first step to the last."""
    steps_per_frame = 1 / (fps * episode.control_dt)
    count = int(np.ceil(episode.steps / steps_per_frame))
    return [int(i * steps_per_frame) for i in range(count)]


def film_frames(
    episode: Episode,
    film: Film,
    camera: Camera | None = None,
    around: Around = nothing_around,
) -> Iterator[np.ndarray]:
    """Yields the frames (height, width, 3) uint8 of a film, with time and phase in a caption.

    Args:
      episode: the episode.
      film: size, frame rate, overlays and view.
      camera: one camera for all frames; by default one that follows hand and object.
      around: further shapes at a control step.
    """
    steps = film_steps(episode, film.fps)
    cameras = [camera] * len(steps) if camera else _cameras(episode, film, steps)
    frames = draw_frames(episode, steps, film.size, cameras, overlays=film.overlays, around=around)
    dt = episode.control_dt
    for step, frame in zip(steps, frames, strict=True):
        yield _captioned(frame, f"{dt * step:.2f} s, real time   {phase_label(episode, step)}")


def _cameras(episode: Episode, film: Film, steps: Sequence[int]) -> list[Camera]:
    """A camera for each frame."""
    view = film.view
    if view is None:
        end_of_grasp = min(episode.grasp_span[1], steps[-1])
        view = best_view(episode, [end_of_grasp, steps[-1]])
    return following_cameras(episode, steps, film.aspect, view, overlays=film.overlays)


def _captioned(frame: np.ndarray, text: str) -> np.ndarray:
    """A frame with a text in its lower left corner, unless the frame is too small for it."""
    height = frame.shape[0]
    if height < _LEAST_CAPTIONED_HEIGHT:
        return frame
    pixels = max(round(_CAPTION_HEIGHT * height), _LEAST_CAPTION_PIXELS)
    image = Image.fromarray(frame)
    draw = ImageDraw.Draw(image)
    draw.text((pixels, height - pixels), text.rstrip(), INK, _font(pixels), anchor="ls")
    return np.asarray(image)


@functools.lru_cache(maxsize=4)
def _font(pixels: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The font of captions, of a size in pixels."""
    return ImageFont.load_default(pixels)


def save_episode_video(
    path: pathlib.Path,
    episode: Episode,
    film: Film = Film(),  # noqa: B008 - frozen
    camera: Camera | None = None,
    progress: Callable[[float], None] = lambda share: None,
    *,
    around: Around = nothing_around,
) -> None:
    """Writes a whole episode as MP4, in real time.

    Args:
      path: the file; written under another name and renamed when it is complete.
      episode: the episode.
      film: size, frame rate, overlays and view.
      camera: see `film_frames`.
      progress: called with the share of drawn frames, from 0 to 1.
      around: see `film_frames`.

    Raises:
      CongraspError: the package for videos is absent, or the file cannot be written.
    """
    count = len(film_steps(episode, film.fps))

    def frames() -> Iterator[np.ndarray]:
        """Yields the frames in order and reports the progress."""
        for done, frame in enumerate(film_frames(episode, film, camera, around), 1):
            yield frame
            progress(done / count)

    with (
        os_errors_as(f"{path} could not be written"),
        temporary_file(path, path.suffix) as (unfinished, file),
    ):
        check_spelling(path)
        file.close()
        save_video(unfinished, frames(), film.size, film.fps)
        platforms.replace(unfinished, path)
