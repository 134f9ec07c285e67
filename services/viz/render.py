"""Pictures and videos of recorded episodes."""

import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.transform import Rotation

from congrasp.common.hands import known_hand
from congrasp.common.hands.skin import skin_of
from congrasp.common.hands.spec import Hand
from congrasp.common.runtime.parallel import cores
from congrasp.common.task.constraints.markers import Arrow, Ghost, Paint, Polyline
from congrasp.common.wire.codec import Message
from congrasp.services.record.goals import active_blocks, grasp_span, markers, phases_of
from congrasp.services.record.palette import HEADING, OBJECT, WAYPOINT
from congrasp.services.viz.raster import render_scene, visible
from congrasp.services.viz.scene import Camera, Shape
from congrasp.services.viz.shapes import (
    arrow,
    beads,
    capsule_shapes,
    fit,
    object_shape,
    posed_hand,
    skin_shape,
    table_shape,
)
from congrasp.services.viz.sheets import contact_sheet, save_video

Around = Callable[[int], Sequence[Shape]]
"""Shapes around the grasp at a control step, such as the arm that carries the hand."""
TOUCHING = (0.13, 0.74, 0.63)
OBJECT_AVOID = (0.72, 0.23, 0.22)
_TOUCH = 1e-3  # force from which a link touches, N
_FULL_CONTACT = 2.0  # force at which a link takes most of the contact colour, N
_ELEVATION = 24.0  # degrees
_ARROW_SEARCH, _ARROW_GAP = 0.012, 0.004  # radius in which the approach looks for the object, space before it, m
_GAP = 3  # between two views of a picture, pixels
_FALL = 0.1  # how far the camera follows a falling object, m


class Film(NamedTuple):
    """How a video is drawn."""

    size: tuple[int, int] = (1280, 720)
    """Width and height in pixels, both even."""
    fps: float = 25.0
    """Frames a second."""
    overlays: bool = False
    """Draws the active constraints, and in green where the hand touches."""


def episode_shapes(episode: Message, step: int, *, overlays: bool = True) -> list[Shape]:
    """Hand, object and table of one control step of an episode; as overlays its active constraints and contacts."""
    bodies = _bodies(episode, step, overlays=overlays)
    return bodies + (_constraints(known_hand(episode.meta["hand"]), episode, step) if overlays else [])


def _bodies(episode: Message, step: int, *, overlays: bool) -> list[Shape]:
    """Hand, object and table of one control step of an episode."""
    arrays = episode.arrays
    hand = known_hand(episode.meta["hand"])
    force = np.linalg.norm(arrays["contact_force"][step], axis=-1)
    share = np.where(force > _TOUCH, 0.3 + 0.3 * np.minimum(force / _FULL_CONTACT, 1.0), 0.0) * overlays
    links = arrays["link_position"][step], arrays["link_quaternion"][step]
    shapes = [skin_shape(skin_of(hand), *links, TOUCHING, share), _object(episode, step, painted=overlays)]
    if arrays["table"][step]:
        shapes.append(table_shape(arrays["object_position"][0]))
    return shapes


def _object(episode: Message, step: int, *, painted: bool = True) -> Shape:
    """The object at a step in its own colours, painted where its avoid region is a constraint."""
    arrays = episode.arrays
    avoid = np.asarray(arrays["surface_minus"], bool)
    marked = painted and bool(avoid.any()) and any(isinstance(marker, Paint) for _, marker in markers(arrays))
    paint = None
    if "colour_values" in arrays:
        points, colours = arrays["colour_points"], arrays["colour_values"] / 255
        if marked:
            near = cKDTree(arrays["surface_points"]).query(points)[1]
            colours = np.where(avoid[near, None], OBJECT_AVOID, colours)
        paint = points, colours
    elif marked:
        paint = arrays["surface_points"], np.where(avoid[:, None], OBJECT_AVOID, OBJECT)
    mesh = arrays["visual_vertices"], arrays["visual_faces"]
    return object_shape(mesh, arrays["object_position"][step], arrays["object_quaternion"][step], paint)


def _constraints(hand: Hand, episode: Message, step: int) -> list[Shape]:
    """Markers of the active constraints, which are given in the object's frame; the object is painted already."""
    arrays = episode.arrays
    origin = np.asarray(arrays["object_position"][step], float)
    turn = Rotation.from_quat(arrays["object_quaternion"][step], scalar_first=True)
    shapes: list[Shape] = []
    for _, marker in markers(arrays):
        if isinstance(marker, Arrow):
            direction = turn.apply(marker.direction)
            tip = turn.apply(_outside(marker, arrays["surface_points"])) + origin
            shapes += arrow(tip - 0.08 * direction, tip, 0.0028, HEADING)
        elif isinstance(marker, Polyline):
            shapes.append(beads(turn.apply(marker.points) + origin, 0.0035, WAYPOINT))
        elif isinstance(marker, Ghost) and marker.q is not None:
            wrist = turn * Rotation.from_quat(marker.quaternion, scalar_first=True)
            position = turn.apply(marker.position) + origin
            shapes.append(posed_hand(hand, marker.q, position, wrist, HEADING, np.ones(len(hand.links)), alpha=0.25))
    return shapes


def _outside(marker: Arrow, surface: np.ndarray) -> np.ndarray:
    """(3,) where an arrow to a point inside the object ends: before its line enters the surface (P, 3)."""
    off = surface - marker.tip
    along = off @ marker.direction
    across = np.linalg.norm(off - along[:, None] * marker.direction, axis=-1)
    depth = max(0.0, -float(along[across < _ARROW_SEARCH].min(initial=0.0))) + _ARROW_GAP
    return np.asarray(marker.tip - depth * marker.direction)


def best_camera(episode: Message, steps: Sequence[int], aspect: float = 4 / 3) -> Camera:
    """A camera that holds everything that happens in the steps, from where object and touching links show most."""
    points = np.concatenate([_extent(episode, step) for step in steps])
    points = points[ConvexHull(points).vertices]  # what holds these holds all
    pictured = [_worths(episode, steps[i]) for i in sorted({len(steps) // 2, len(steps) - 1})]

    def score(camera: Camera) -> float:
        """How much of object, touching links and constraints a camera shows."""
        total = 0.0
        for shapes, worth in pictured:
            seen = visible(shapes, camera, (round(72 * aspect), 72))
            total += float(np.array(worth)[seen[seen >= 0]].sum())
        return total

    azimuths = np.radians(np.arange(0, 360, 30))
    directions = [np.array([np.cos(a), np.sin(a), np.tan(np.radians(_ELEVATION))]) for a in azimuths]
    return max((fit(points, direction, aspect) for direction in directions), key=score)


def _worths(episode: Message, step: int) -> tuple[list[Shape], list[float]]:
    """What there is at a step, the hand as capsules, and what a sample of each is worth to a picture."""
    arrays = episode.arrays
    hand = known_hand(episode.meta["hand"])
    capsules = capsule_shapes(hand, arrays["link_position"][step], arrays["link_quaternion"][step])
    touching = np.linalg.norm(arrays["contact_force"][step], axis=-1)[hand.capsule_links] > _TOUCH
    rest = episode_shapes(episode, step)[1:]
    worth = [1.0 if touches else 0.2 for touches in touching]
    return [*capsules, *rest], [*worth, 1.0, *(0.0 if shape.kind == "cylinder" else 0.5 for shape in rest[1:])]


def _extent(episode: Message, step: int) -> np.ndarray:
    """(N, 3) points that a picture of a step must hold: the skin, the corners of the object's box and a trajectory.

    An object that has fallen far may leave the picture.
    """
    arrays = episode.arrays
    hand = known_hand(episode.meta["hand"])
    turns = Rotation.from_quat(arrays["link_quaternion"][step], scalar_first=True)
    around = skin_of(hand).posed(arrays["link_position"][step], turns.as_matrix())[0]
    if arrays["object_position"][step, 2] < arrays["object_position"][0, 2] - _FALL:
        return around
    turn = Rotation.from_quat(arrays["object_quaternion"][step], scalar_first=True)
    low, high = arrays["visual_vertices"].min(0), arrays["visual_vertices"].max(0)
    points = [np.where(np.indices((2, 2, 2)).reshape(3, -1).T, high, low)]
    points += [marker.points for _, marker in markers(arrays) if isinstance(marker, Polyline)]
    return np.concatenate([around, turn.apply(np.concatenate(points)) + arrays["object_position"][step]])


def thumb_camera(episode: Message, step: int, aspect: float) -> Camera:
    """A camera that looks at hand and object of a step from the thumb's side."""
    hand = known_hand(episode.meta["hand"])
    wrist = Rotation.from_quat(episode.arrays["link_quaternion"][step, 0], scalar_first=True)
    knuckles = [hand.keypoints[[link.name for link in hand.links].index(root)] for root in hand.finger_roots]
    side = wrist.apply(knuckles[0] - np.mean(knuckles[1:], 0)) * [1.0, 1.0, 0.0]
    if np.linalg.norm(side) < 1e-6:
        side = np.array([1.0, 0.0, 0.0])
    direction = side / np.linalg.norm(side) + [0.0, 0.0, np.tan(np.radians(_ELEVATION))]
    return fit(_extent(episode, step), direction, aspect)


def grasp_picture(episode: Message, step: int, size: tuple[int, int] = (1280, 720)) -> np.ndarray:
    """A step as (height, width, 3) uint8, without overlays: framed on the grasp, and from the thumb's side."""
    width, height = size
    left = 2 * width // 3
    shapes = episode_shapes(episode, step, overlays=False)
    cameras = best_camera(episode, [step], left / height), thumb_camera(episode, step, (width - left) / height)
    widths = left, width - left
    views = [render_scene(shapes, camera, (w, height)) for camera, w in zip(cameras, widths, strict=True)]
    views[1][:, :_GAP] = 255
    return np.concatenate(views, 1)


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
      camera: from where; the best of a circle around the scene otherwise.
      overlays: see `Film`.
      around: further shapes at a control step.
    """
    steps = list(steps)
    seen_from = camera or best_camera(episode, steps, size[0] / size[1])

    def drawn(step: int) -> np.ndarray:
        return render_scene([*episode_shapes(episode, step, overlays=overlays), *around(step)], seen_from, size)

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
    """An episode in a few frames (its first and last step, and the table's removal, among them), with its metrics.

    Args:
      episode: the episode.
      frames: number of pictures.
      size: width and height of each, pixels.
      steps: control steps of the pictures; spread evenly otherwise.
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
      last: what to say after the time of the last one.
      until: step of the last one; the episode's last if not given.
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
    """The first step of the grasp itself, and the first one after it: of the lift, or without the table."""
    return grasp_span(episode.meta, float(episode.meta["control_dt"]), np.asarray(episode.arrays["table"], bool))


def _phase(episode: Message, step: int) -> str:
    """What a step is part of, as far as it is worth saying: approach, lift, hold, or that the table was removed."""
    if not episode.arrays["table"][step]:
        return "table removed"
    phases = phases_of(episode.meta)
    if not {"approach", "lift"} & phases.keys():
        return ""
    time = float(episode.meta["control_dt"]) * step + 1e-6
    begun = [(begin, name) for name, begin in phases.items() if begin <= time]
    return max(begun)[1] if begun else ""


def key_steps(table: np.ndarray, frames: int) -> list[int]:
    """Steps spread evenly over an episode whose `table` (T,) is present at first; the removal's step is among them."""
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
        f"{name.replace('_', ' ')} {metrics[name]:.3g}" for name in ("return", "links_at_removal") if name in metrics
    ]
    parts = [f"{known_hand(meta['hand']).name} hand, {meta['object']}", " + ".join(["heading", *names]), result, *shown]
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
    """An episode as MP4, in real time.

    Args:
      path: the file; it is written under another name and renamed when it is whole.
      episode: the episode.
      film: size, frame rate and overlays.
      camera: see `render_episode_frames`.
      progress: told which share of the frames is drawn.
      until: its first control step that is not drawn; all are by default.
      around: see `render_episode_frames`.

    Raises:
      CongraspError: the package for videos is absent, or the file cannot be written.
    """
    step = 1 / (film.fps * float(episode.meta["control_dt"]))
    last = len(episode.arrays["table"]) if until is None else min(until, len(episode.arrays["table"]))
    steps = [int(i * step) for i in range(int(np.ceil(last / step)))]

    def frames() -> Iterator[np.ndarray]:
        """The frames, one after another."""
        drawn = render_episode_frames(episode, steps, film.size, camera, overlays=film.overlays, around=around)
        for done, frame in enumerate(drawn, 1):
            yield frame
            progress(done / len(steps))

    unfinished = path.with_name(f".{path.name}")
    save_video(unfinished, frames(), film.size, film.fps)
    unfinished.replace(path)
