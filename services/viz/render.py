"""Pictures and videos of recorded episodes."""

import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError, need_package, os_errors_as
from congrasp.common.hands import known_hand
from congrasp.common.io.opening import temporary_file
from congrasp.common.io.spelling import check_spelling
from congrasp.common.runtime.parallel import cores
from congrasp.common.wire.codec import Message
from congrasp.services.record.episode import active_blocks, grasp_span, phases_of
from congrasp.services.viz.raster import render_scene
from congrasp.services.viz.shapes import Camera, Shape
from congrasp.services.viz.sheets import contact_sheet, save_video
from congrasp.services.viz.views import View, camera_of, episode_shapes, views

Around = Callable[[int], Sequence[Shape]]
"""Shapes around the grasp at a control step, such as the arm that carries the hand."""
_GAP = 3  # pixels between two views of a picture


class Film(NamedTuple):
    """Style of a video."""

    size: tuple[int, int] = (1280, 720)
    """Width and height in pixels, both even."""
    fps: float = 25.0
    """Frames per second."""
    overlays: bool = False
    """Draws the active constraints, and links in contact in green."""


def film_of(size: str, fps: float, overlays: bool) -> Film:
    """Style of a video, from its size as WIDTHxHEIGHT, both even and from 64 to 4096 pixels.

    Raises:
      CongraspError: the size is malformed, or a package for videos is missing.
    """
    need_package("--video", "imageio_ffmpeg")
    numbers = size.lower().split("x")
    if len(numbers) == 2 and all(word.isdecimal() and len(word) < 5 for word in numbers):
        width, height = map(int, numbers)
        if all(64 <= side <= 4096 and side % 2 == 0 for side in (width, height)):
            return Film((width, height), fps, overlays)
    raise CongraspError(
        f"--size is '{size}'.", "Write two even numbers from 64 to 4096: --size 1920x1080"
    )


def grasp_picture(
    episode: Message, step: int, size: tuple[int, int] = (1280, 720), view: View | None = None
) -> np.ndarray:
    """(height, width, 3) uint8, a step without overlays: from a view, by default the best one, and
    from its side.
    """
    width, height = size
    left = 2 * width // 3
    shapes = episode_shapes(episode, step, overlays=False)
    best, aside = views(episode, [step])
    widths = left, width - left
    cameras = [
        camera_of(episode, [step], w / height, v)
        for w, v in zip(widths, (view or best, aside), strict=True)
    ]
    halves = [
        render_scene(shapes, camera, (w, height)) for camera, w in zip(cameras, widths, strict=True)
    ]
    halves[1][:, :_GAP] = 255
    return np.concatenate(halves, 1)


def render_episode_frames(
    episode: Message,
    steps: Iterable[int],
    size: tuple[int, int] = (640, 480),
    camera: Camera | None = None,
    *,
    overlays: bool = True,
    around: Around = lambda step: [],
) -> Iterator[np.ndarray]:
    """Pictures (height, width, 3) uint8 of control steps of an episode, all from one camera.

    Args:
      episode: an episode message (`services.record.reader.read_episodes` yields them from MCAP).
      steps: control steps, from 0.
      size: width and height in pixels.
      camera: the camera; by default one for the best view.
      overlays: see `Film`.
      around: further shapes at a control step.
    """
    steps = list(steps)
    seen_from = camera or camera_of(episode, steps, size[0] / size[1], overlays=overlays)

    def drawn(step: int) -> np.ndarray:
        return render_scene(
            [*episode_shapes(episode, step, overlays=overlays), *around(step)], seen_from, size
        )

    with ThreadPoolExecutor(cores()) as pool:
        yield from pool.map(drawn, steps)


def episode_sheet(
    episode: Message,
    *,
    frames: int = 8,
    size: tuple[int, int] = (440, 330),
    steps: Sequence[int] | None = None,
    camera: Camera | None = None,
) -> np.ndarray:
    """An episode in a few frames, by default with its first and last step and the table's removal,
    and its metrics.

    Args:
      episode: the episode.
      frames: number of pictures.
      size: width and height of each, pixels.
      steps: control steps of the pictures; spread evenly by default.
      camera: see `render_episode_frames`.
    """
    steps = steps or key_steps(np.asarray(episode.arrays["table"], bool), frames)
    dt = float(episode.meta["control_dt"])
    labels = [f"{dt * step:.2f} s   {_phase(episode, step)}".rstrip() for step in steps]
    images = list(render_episode_frames(episode, steps, size, camera))
    return contact_sheet(images, labels, columns=min(4, len(steps)), title=episode_title(episode))


def episode_strip(
    episode: Message,
    frames: int,
    size: tuple[int, int],
    first: str,
    last: str,
    *,
    until: int | None = None,
) -> tuple[list[np.ndarray], list[str]]:
    """A contact sheet's row: pictures of an episode's key frames, and their labels.

    Args:
      episode: the episode.
      frames: number of pictures.
      size: width and height of each, pixels.
      first: label of the first picture.
      last: text after the time of the last one.
      until: step of the last one; by default that of the episode.
    """
    table = np.asarray(episode.arrays["table"], bool)
    steps = key_steps(table if until is None else table[: until + 1], frames)
    seconds = [f"{episode.meta['control_dt'] * step:.2f} s" for step in steps]
    return list(render_episode_frames(episode, steps, size)), [
        first,
        *seconds[1:-1],
        f"{seconds[-1]}{last}",
    ]


def grasp_steps(episode: Message) -> tuple[int, int]:
    """The first step of the grasp itself, and the first one after it: of the lift, or without the
    table.
    """
    return grasp_span(
        episode.meta, float(episode.meta["control_dt"]), np.asarray(episode.arrays["table"], bool)
    )


def _phase(episode: Message, step: int) -> str:
    """Label of the phase of a step: table removed, or a phase of an episode with approach or lift;
    else empty.
    """
    if not episode.arrays["table"][step]:
        return "table removed"
    phases = phases_of(episode.meta)
    if not {"approach", "lift"} & phases.keys():
        return ""
    time = float(episode.meta["control_dt"]) * step + 1e-6
    begun = [(begin, name) for name, begin in phases.items() if begin <= time]
    return max(begun)[1] if begun else ""


def key_steps(table: np.ndarray, frames: int) -> list[int]:
    """Steps spread evenly over an episode, with that of the table's removal; `table` (T,) bool is
    True at first.
    """
    steps = sorted({round(x) for x in np.linspace(0, len(table) - 1, frames)})
    if not table.all() and len(steps) > 2:
        removal = int(np.argmin(table))
        nearest = min(range(1, len(steps) - 1), key=lambda i: abs(steps[i] - removal))
        steps[nearest] = removal
    return sorted(set(steps))


def episode_title(episode: Message) -> str:
    """Hand, object, constraints and result in one line."""
    meta, active = episode.meta, active_blocks(episode.arrays)
    names = [name.replace("_", " ") for name, on in active.items() if on]
    result = "success" if meta["success"] else "no success"
    metrics = meta.get("metrics", {})
    shown = [
        f"{name.replace('_', ' ')} {metrics[name]:.3g}"
        for name in ("return", "links_at_removal")
        if name in metrics
    ]
    parts = [
        f"{known_hand(meta['hand']).name} hand, {meta['object']}",
        " + ".join(["heading", *names]),
        result,
        *shown,
    ]
    return "   |   ".join([*parts, f"policy version {meta['version']}"])


def save_episode_video(
    path: pathlib.Path,
    episode: Message,
    film: Film = Film(),  # noqa: B008 - frozen
    camera: Camera | None = None,
    progress: Callable[[float], None] = lambda share: None,
    *,
    until: int | None = None,
    around: Around = lambda step: [],
) -> None:
    """Writes an episode as MP4, in real time.

    Args:
      path: the file; written under another name and renamed when it is complete.
      episode: the episode.
      film: size, frame rate and overlays.
      camera: see `render_episode_frames`.
      progress: called with the share of drawn frames, from 0 to 1.
      until: control step at which the video ends, exclusive; the end of the episode by default.
      around: see `render_episode_frames`.

    Raises:
      CongraspError: the package for videos is absent, or the file cannot be written.
    """
    step = 1 / (film.fps * float(episode.meta["control_dt"]))
    last = (
        len(episode.arrays["table"]) if until is None else min(until, len(episode.arrays["table"]))
    )
    steps = [int(i * step) for i in range(int(np.ceil(last / step)))]

    def frames() -> Iterator[np.ndarray]:
        """Yields the frames in order."""
        drawn = render_episode_frames(
            episode, steps, film.size, camera, overlays=film.overlays, around=around
        )
        for done, frame in enumerate(drawn, 1):
            yield frame
            progress(done / len(steps))

    with (
        os_errors_as(f"{path} could not be written"),
        temporary_file(path, path.suffix) as (unfinished, _),
    ):
        check_spelling(path)
        save_video(unfinished, frames(), film.size, film.fps)
        unfinished.replace(path)
