"""Pictures of recorded episodes: single steps, frames, contact sheets and strips."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from congrasp.common.episode.episode import Episode
from congrasp.common.runtime.resources import cores
from congrasp.services.viz.camera import Camera
from congrasp.services.viz.episode_scene import episode_shapes
from congrasp.services.viz.raster import render_scene
from congrasp.services.viz.shapes import Shape
from congrasp.services.viz.sheets import contact_sheet
from congrasp.services.viz.views import View, camera_of, views

Around = Callable[[int], Sequence[Shape]]
"""Shapes around the grasp at a control step, such as the arm that carries the hand."""
_GAP_PIXELS = 3
"""Gap between the two views of a picture."""
_SHEET_COLUMNS = 4
_TITLE_METRICS = ("return", "links_at_removal")
"""Metrics in the title of an episode."""


def nothing_around(step: int) -> Sequence[Shape]:
    """No shapes around the grasp."""
    del step
    return ()


def grasp_picture(
    episode: Episode, step: int, size: tuple[int, int] = (1280, 720), view: View | None = None
) -> np.ndarray:
    """Two pictures of one step without overlays, from `view` and, on the right, from its side.

    Args:
      episode: the episode.
      step: its control step.
      size: width and height of both pictures together, pixels.
      view: view of the left picture; the best one by default.

    Returns:
      (height, width, 3) uint8.
    """
    width, height = size
    left_width = 2 * width // 3
    right_width = width - left_width
    best, aside = views(episode, [step])
    left = _step_picture(episode, step, (left_width, height), view or best)
    right = _step_picture(episode, step, (right_width, height), aside)
    right[:, :_GAP_PIXELS] = 255
    return np.concatenate([left, right], axis=1)


def _step_picture(episode: Episode, step: int, size: tuple[int, int], view: View) -> np.ndarray:
    """(height, width, 3) uint8, one step without overlays from one view."""
    width, height = size
    camera = camera_of(episode, [step], width / height, view)
    return render_scene(episode_shapes(episode, step, overlays=False), camera, size)


def render_episode_frames(
    episode: Episode,
    steps: Iterable[int],
    size: tuple[int, int] = (640, 480),
    camera: Camera | None = None,
    *,
    overlays: bool = True,
) -> Iterator[np.ndarray]:
    """Pictures (height, width, 3) uint8 of control steps of an episode, all from one camera.

    Args:
      episode: an episode (`services.record.reader.read_episodes` yields them from MCAP).
      steps: control steps, from 0.
      size: width and height in pixels.
      camera: the camera; by default one for the best view.
      overlays: draws the active constraints, and links in contact in green.
    """
    steps = list(steps)
    if camera is None:
        width, height = size
        camera = camera_of(episode, steps, width / height, overlays=overlays)
    return draw_frames(episode, steps, size, [camera] * len(steps), overlays=overlays)


def draw_frames(
    episode: Episode,
    steps: Sequence[int],
    size: tuple[int, int],
    cameras: Sequence[Camera],
    *,
    overlays: bool,
    around: Around = nothing_around,
) -> Iterator[np.ndarray]:
    """Yields pictures (height, width, 3) uint8 of control steps, each from a camera of its own.

    Args:
      episode: the episode.
      steps: its control steps.
      size: width and height in pixels.
      cameras: one for each step.
      overlays: draws the active constraints, and links in contact in green.
      around: further shapes at a control step.
    """

    def draw(step: int, camera: Camera) -> np.ndarray:
        """Draws one picture."""
        shapes = [*episode_shapes(episode, step, overlays=overlays), *around(step)]
        return render_scene(shapes, camera, size)

    with ThreadPoolExecutor(cores()) as pool:
        yield from pool.map(draw, steps, cameras)


def episode_sheet(
    episode: Episode,
    *,
    frames: int = 8,
    size: tuple[int, int] = (440, 330),
    steps: Sequence[int] | None = None,
    camera: Camera | None = None,
) -> np.ndarray:
    """An episode in a few frames, with its metrics in the title.

    Args:
      episode: the episode.
      frames: number of pictures.
      size: width and height of each, pixels.
      steps: control steps of the pictures; by default `key_steps`.
      camera: see `render_episode_frames`.

    Returns:
      (H, W, 3) uint8.
    """
    steps = steps or key_steps(episode.table, frames)
    dt = episode.control_dt
    labels = [f"{dt * step:.2f} s   {phase_label(episode, step)}".rstrip() for step in steps]
    images = list(render_episode_frames(episode, steps, size, camera))
    columns = min(_SHEET_COLUMNS, len(steps))
    return contact_sheet(images, labels, columns=columns, title=episode_title(episode))


def episode_strip(
    episode: Episode,
    frames: int,
    size: tuple[int, int],
    first: str,
    last: str,
    *,
    last_step: int | None = None,
) -> tuple[list[np.ndarray], list[str]]:
    """A contact sheet's row: pictures of an episode's key steps, and their labels.

    Args:
      episode: the episode.
      frames: number of pictures.
      size: width and height of each, pixels.
      first: label of the first picture.
      last: text after the time of the last one.
      last_step: step of the last picture; by default that of the episode.
    """
    table = episode.table
    if last_step is not None:
        table = table[: last_step + 1]
    steps = key_steps(table, frames)
    seconds = [f"{episode.control_dt * step:.2f} s" for step in steps]
    images = list(render_episode_frames(episode, steps, size))
    return images, [first, *seconds[1:-1], f"{seconds[-1]}{last}"]


def phase_label(episode: Episode, step: int) -> str:
    """Label of a step: its table is removed, or its phase if the episode has an approach or a lift.

    Empty for other episodes.
    """
    if not episode.table[step]:
        return "table removed"
    phases = episode.phases
    if not {"approach", "lift"} & phases.keys():
        return ""
    time = episode.control_dt * step + 1e-6
    past = [(start, name) for name, start in phases.items() if start <= time]
    if not past:
        return ""
    return max(past)[1]


def key_steps(table: np.ndarray, frames: int) -> list[int]:
    """Steps spread evenly over an episode: the first and the last, and that of the table's removal.

    Args:
      table: (T,) bool, True before the removal.
      frames: number of steps.
    """
    steps = sorted({round(x) for x in np.linspace(0, len(table) - 1, frames)})
    if not table.all() and len(steps) > 2:
        removal = int(np.argmin(table))
        nearest = min(range(1, len(steps) - 1), key=lambda i: abs(steps[i] - removal))
        steps[nearest] = removal
    return sorted(set(steps))


def episode_title(episode: Episode) -> str:
    """Hand, object, constraints and result in one line."""
    constraints = ["heading"]
    for name, is_active in episode.active.items():
        if is_active:
            constraints.append(name.replace("_", " "))
    parts = [
        f"{episode.hand} hand, {episode.object}",
        " + ".join(constraints),
        "success" if episode.success else "no success",
    ]
    for name in _TITLE_METRICS:
        if name in episode.metrics:
            parts.append(f"{name.replace('_', ' ')} {episode.metrics[name]:.3g}")
    parts.append(f"policy version {episode.version}")
    return "   |   ".join(parts)
