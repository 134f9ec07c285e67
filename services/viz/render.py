"""Pictures of hands and of recorded episodes."""

import collections
import itertools
import os
import pathlib
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from common.errors import CongraspError
from common.hands import get_hand
from common.hands.spec import Hand, link_origin
from common.task.types import MASKS
from common.wire.codec import Message
from services.assets.hands.kinematics import mujoco_link_poses
from services.record.reader import read_episodes
from services.viz.raster import Raster
from services.viz.raycast import Camera, Scene, Shape, between
from services.viz.shade import render_scene, visible
from services.viz.sheets import contact_sheet, save_video

SKIN = (0.70, 0.73, 0.79)
TOUCHING = (0.13, 0.74, 0.63)
OBJECT = (0.95, 0.62, 0.24)
OBJECT_MINUS = (0.72, 0.23, 0.22)
APPROACH = (0.22, 0.40, 0.86)
WAYPOINT = (0.53, 0.30, 0.75)
TABLE = (0.80, 0.79, 0.77)
_TABLE_RADIUS, _TABLE_HALF_HEIGHT = 0.28, 0.008
_FULL_CONTACT = 2.0  # force at which a link takes the full contact colour, N
_FIELD_OF_VIEW, _ELEVATION = 26.0, 24.0  # degrees
_ARROW_SEARCH, _ARROW_GAP = 0.012, 0.004  # radius in which the approach looks for the object, space before it, m
_SPACE = 1.06  # free space at the picture's edges
_LINK_SPACE = 0.03  # how far a link reaches around its origin, m
_FRAME_SECONDS = 0.04  # between two frames of a video
_FALL = 0.1  # how far the camera follows a falling object, m


def hand_shapes(
    hand: Hand,
    position: np.ndarray,
    quaternion: np.ndarray,
    colours: Sequence[tuple[float, float, float]] | None = None,
    alpha: float = 1.0,
) -> list[Shape]:
    """The hand's capsules.

    Args:
      hand: the hand.
      position: (L, 3) origins of the links' frames in the world.
      quaternion: (L, 4) their orientations.
      colours: one for each link; skin otherwise.
      alpha: below one the hand is seen through.
    """
    shapes = []
    for i, link in enumerate(hand.links):
        turn = Rotation.from_quat(quaternion[i], scalar_first=True)
        for capsule in link.capsules:
            start, end = turn.apply(np.subtract([capsule.start, capsule.end], link_origin(link))) + position[i]
            shapes.append(between(start, end, capsule.radius, colours[i] if colours else SKIN, alpha=alpha))
    return shapes


def posed_hand(
    hand: Hand,
    q: np.ndarray,
    position: np.ndarray,
    wrist: Rotation,
    colour: tuple[float, float, float],
    alpha: float = 1.0,
) -> list[Shape]:
    """The hand with finger angles (F,) and its wrist at a position (3,) and orientation in the world."""
    links, quaternion = mujoco_link_poses(hand, q)
    turned = (wrist * Rotation.from_quat(quaternion, scalar_first=True)).as_quat(scalar_first=True)
    return hand_shapes(hand, wrist.apply(links) + position, turned, [colour] * len(hand.links), alpha)


def table_shape(below: np.ndarray) -> Shape:
    """A round table top at height zero under a point (3,)."""
    position = np.array([below[0], below[1], -_TABLE_HALF_HEIGHT], float)
    return Shape("cylinder", (_TABLE_RADIUS, _TABLE_HALF_HEIGHT, 0), TABLE, position, shine=0.0)


def arrow(start: np.ndarray, end: np.ndarray, radius: float, colour: tuple[float, float, float]) -> list[Shape]:
    """A shaft with a cone whose tip is at `end` (3,)."""
    along = np.subtract(end, start)
    direction = along / np.linalg.norm(along)
    neck = end - 6 * radius * direction
    turn = Rotation.align_vectors([direction], [[0.0, 0.0, 1.0]])[0].as_quat(scalar_first=True)
    angles = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    ring = np.stack([2.4 * radius * np.cos(angles), 2.4 * radius * np.sin(angles), np.zeros(32)], -1)
    vertices = np.concatenate([ring, [[0, 0, 6 * radius], [0, 0, 0]]])
    here = np.arange(32)
    after = (here + 1) % 32
    faces = np.concatenate([np.stack([here, after, np.full(32, 32)], -1), np.stack([after, here, np.full(32, 33)], -1)])
    cone = Shape("mesh", (0, 0, 0), colour, neck, turn, vertices=vertices, faces=faces)
    return [between(start, neck, radius, colour), cone]


def beads(points: np.ndarray, radius: float, colour: tuple[float, float, float]) -> Shape:
    """Balls at points (N, 3) on a string, as one mesh: every further shape would slow down all rays."""
    balls = [trimesh.creation.icosphere(1, radius).apply_translation(point) for point in points]
    pairs = [pair for pair in itertools.pairwise(points) if np.linalg.norm(np.subtract(*pair)) > 1e-6]
    string = [trimesh.creation.cylinder(0.4 * radius, segment=pair, sections=8) for pair in pairs]
    mesh: Any = trimesh.util.concatenate([*balls, *string])
    return Shape("mesh", (0, 0, 0), colour, vertices=mesh.vertices, faces=mesh.faces)


def episode_shapes(episode: Message, step: int) -> list[Shape]:
    """Hand, object, table and active constraints of one control step of an episode."""
    arrays = episode.arrays
    hand = get_hand(episode.meta["hand"])
    force = np.linalg.norm(arrays["contact_force"][step], axis=-1)
    share = np.where(force > 1e-3, 0.5 + 0.5 * np.minimum(force / _FULL_CONTACT, 1.0), 0.0)[:, None]
    colours = [tuple(colour) for colour in share * TOUCHING + (1 - share) * SKIN]
    shapes = hand_shapes(hand, arrays["link_position"][step], arrays["link_quaternion"][step], colours)
    shapes.append(_object(episode, step))
    if arrays["table"][step]:
        shapes.append(table_shape(arrays["object_position"][0]))
    return shapes + _constraints(hand, episode, step)


def _object(episode: Message, step: int) -> Shape:
    arrays = episode.arrays
    affordance = arrays["goal/mask"][MASKS.index("affordance")] > 0
    minus = np.asarray(arrays["surface_minus"], bool)
    painted = affordance and bool(minus.any())
    return Shape(
        "mesh",
        (0, 0, 0),
        OBJECT,
        np.asarray(arrays["object_position"][step], float),
        np.asarray(arrays["object_quaternion"][step], float),
        vertices=arrays["visual_vertices"],
        faces=arrays["visual_faces"],
        paint_points=np.asarray(arrays["surface_points"]) if painted else None,
        paint_colours=np.where(minus[:, None], OBJECT_MINUS, OBJECT) if painted else None,
    )


def _constraints(hand: Hand, episode: Message, step: int) -> list[Shape]:
    """Markers of the active constraints, which are given in the object's frame."""
    arrays = episode.arrays
    origin = np.asarray(arrays["object_position"][step], float)
    turn = Rotation.from_quat(arrays["object_quaternion"][step], scalar_first=True)
    mask = dict(zip(MASKS, arrays["goal/mask"] > 0, strict=True))
    direction = turn.apply(arrays["goal/heading_direction"])
    # The target lies inside the object: the arrow ends where its line enters.
    off = arrays["surface_points"] - arrays["goal/heading_position"]
    along = off @ arrays["goal/heading_direction"]
    across = np.linalg.norm(off - along[:, None] * arrays["goal/heading_direction"], axis=-1)
    depth = max(0.0, -float(along[across < _ARROW_SEARCH].min(initial=0.0))) + _ARROW_GAP
    tip = turn.apply(arrays["goal/heading_position"]) + origin - depth * direction
    shapes = arrow(tip - 0.08 * direction, tip, 0.0028, APPROACH)
    if mask["trajectory"]:
        points = turn.apply(arrays["goal/trajectory_position"]) + origin
        shapes.append(beads(points, 0.0035, WAYPOINT))
    if mask["pose_finger"]:
        wrist = turn * Rotation.from_quat(arrays["goal/pose_quaternion"], scalar_first=True)
        position = turn.apply(arrays["goal/pose_position"]) + origin
        shapes += posed_hand(hand, arrays["goal/pose_q"], position, wrist, APPROACH, alpha=0.25)
    return shapes


def fit(points: np.ndarray, direction: np.ndarray, aspect: float) -> Camera:
    """The nearest camera that sees all points (N, 3) from `direction` (3,), which leads from them to the camera."""
    tangent = np.tan(np.radians(_FIELD_OF_VIEW) / 2) / _SPACE
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    target = (points.min(0) + points.max(0)) / 2
    axes = Camera(target + direction, target).axes()
    distance = 1.0
    for _ in range(8):  # alternately near enough and in the middle; a few rounds settle to a fraction of a pixel
        x, y, z = axes @ (points - target).T
        distance = max((np.abs(x) / (tangent * aspect) - z).max(), (np.abs(y) / tangent - z).max())
        sides = np.stack([x, y]) / (distance + z)
        target = target + distance * (sides.max(1) + sides.min(1)) / 2 @ axes[:2]
    return Camera(target + distance * direction, target, _FIELD_OF_VIEW)


def best_camera(episode: Message, steps: Sequence[int], aspect: float = 4 / 3) -> Camera:
    """A camera that holds everything that happens in the steps, from where object and touching links show most."""
    points = np.concatenate([_extent(episode, step) for step in steps])
    looks = [Scene(episode_shapes(episode, steps[i])) for i in sorted({len(steps) // 2, len(steps) - 1})]
    links = sum(len(link.capsules) for link in get_hand(episode.meta["hand"]).links)

    def score(camera: Camera) -> float:
        total = 0.0
        for scene in looks:
            shown, rest = scene.shapes[: links + 1], scene.shapes[links + 1 :]
            worth = np.array([0.2 if shape.colour == SKIN else 1.0 for shape in shown] + [0.5] * len(rest))
            seen = visible(scene, camera, (round(72 * aspect), 72))
            total += float(worth[seen[seen >= 0]].sum() - 0.5 * (seen == links + 1).sum())
        return total

    azimuths = np.radians(np.arange(0, 360, 30))
    directions = [np.array([np.cos(a), np.sin(a), np.tan(np.radians(_ELEVATION))]) for a in azimuths]
    return max((fit(points, direction, aspect) for direction in directions), key=score)


def _extent(episode: Message, step: int) -> np.ndarray:
    """(N, 3) points that a picture of a step must hold: the links, the corners of the object's box and a trajectory.

    An object that has fallen far may leave the picture.
    """
    arrays = episode.arrays
    links = np.asarray(arrays["link_position"][step], float)
    around = (links[:, None] + _LINK_SPACE * np.concatenate([np.eye(3), -np.eye(3)])).reshape(-1, 3)
    if arrays["object_position"][step, 2] < arrays["object_position"][0, 2] - _FALL:
        return around
    turn = Rotation.from_quat(arrays["object_quaternion"][step], scalar_first=True)
    low, high = arrays["visual_vertices"].min(0), arrays["visual_vertices"].max(0)
    points = [np.where(np.indices((2, 2, 2)).reshape(3, -1).T, high, low)]
    if arrays["goal/mask"][MASKS.index("trajectory")] > 0:
        points.append(arrays["goal/trajectory_position"])
    return np.concatenate([around, turn.apply(np.concatenate(points)) + arrays["object_position"][step]])


def render_episode_frames(
    episode: Message,
    steps: Iterable[int],
    size: tuple[int, int] = (640, 480),
    camera: Camera | None = None,
    *,
    quick: bool = False,
) -> Iterator[np.ndarray]:
    """Pictures (height, width, 3) uint8 of control steps of an episode, all from one camera.

    Args:
      episode: an episode message (`services.record.reader.read_episodes` yields them from MCAP).
      steps: control steps, from 0.
      size: width and height in pixels.
      camera: from where; the best of a circle around the scene otherwise.
      quick: plainer light, many times faster.
    """
    steps = list(steps)
    seen_from = camera or best_camera(episode, steps, size[0] / size[1])
    if not quick:
        for step in steps:
            yield render_scene(episode_shapes(episode, step), seen_from, size)
        return
    raster = Raster()
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        yield from pool.map(lambda step: raster.draw(episode_shapes(episode, step), seen_from, size), steps)


def episode_sheet(
    episode: Message,
    *,
    moments: int = 8,
    size: tuple[int, int] = (440, 330),
    steps: Sequence[int] | None = None,
    camera: Camera | None = None,
    quick: bool = False,
) -> np.ndarray:
    """An episode in a few moments (its first and last step, and the table's removal, among them), with its metrics.

    Args:
      episode: the episode.
      moments: number of pictures.
      size: width and height of each, pixels.
      steps: which moments; spread evenly otherwise.
      camera: see `render_episode_frames`, as is `quick`.
      quick: plainer light, many times faster.
    """
    steps = steps or key_steps(np.asarray(episode.arrays["table"], bool), moments)
    dt = float(episode.meta["control_dt"])
    table = np.asarray(episode.arrays["table"], bool)
    labels = [f"{dt * step:.2f} s" + ("" if table[step] else "   table away") for step in steps]
    images = list(render_episode_frames(episode, steps, size, camera, quick=quick))
    return contact_sheet(images, labels, columns=min(4, len(steps)), title=episode_title(episode))


def episode_strip(
    episode: Message,
    moments: int,
    size: tuple[int, int],
    first: str,
    last: str,
    *,
    until: int | None = None,
    quick: bool = False,
) -> tuple[list[np.ndarray], list[str]]:
    """A contact sheet's row: pictures of an episode's key moments, and their labels.

    Args:
      episode: the episode.
      moments: number of pictures.
      size: width and height of each, pixels.
      first: label of the first picture.
      last: what to say after the time of the last one.
      until: step of the last one; the episode's last if not given.
      quick: plainer light, many times faster.
    """
    table = np.asarray(episode.arrays["table"], bool)
    steps = key_steps(table if until is None else table[: until + 1], moments)
    seconds = [f"{episode.meta['control_dt'] * step:.2f} s" for step in steps]
    return list(render_episode_frames(episode, steps, size, quick=quick)), [
        first,
        *seconds[1:-1],
        f"{seconds[-1]}{last}",
    ]


def key_steps(table: np.ndarray, moments: int) -> list[int]:
    """Steps spread evenly over an episode whose `table` (T,) is present at first; the removal's step is among them."""
    steps = sorted({round(x) for x in np.linspace(0, len(table) - 1, moments)})
    if not table.all() and len(steps) > 2:
        removal = int(np.argmin(table))
        nearest = min(range(1, len(steps) - 1), key=lambda i: abs(steps[i] - removal))
        steps[nearest] = removal
    return sorted(set(steps))


def episode_title(episode: Message) -> str:
    """Hand, object, constraints and result in one line."""
    meta, mask = episode.meta, episode.arrays["goal/mask"]
    names = [name.replace("_", " ") for name, bit in zip(MASKS, mask, strict=True) if bit > 0]
    result = "success" if meta["success"] else "no success"
    metrics = meta.get("metrics", {})
    shown = [
        f"{name.replace('_', ' ')} {metrics[name]:.3g}" for name in ("return", "links_at_removal") if name in metrics
    ]
    parts = [f"{get_hand(meta['hand']).name} hand, {meta['object']}", " + ".join(["heading", *names]), result, *shown]
    return "   |   ".join([*parts, f"policy version {meta['version']}"])


def hand_sheet(hand: Hand, *, size: tuple[int, int] = (400, 400)) -> np.ndarray:
    """The hand open, half closed and closed (columns), from the palm, the thumb's side and between (rows)."""
    poses = {"open": hand.q_open, "half closed": (hand.q_open + hand.q_closed) / 2, "closed": hand.q_closed}
    up = upright(hand)
    placed = {}
    for name, q in poses.items():
        position, quaternion = mujoco_link_poses(hand, q)
        turned = (up * Rotation.from_quat(quaternion, scalar_first=True)).as_quat(scalar_first=True)
        placed[name] = hand_shapes(hand, up.apply(position), turned)
    points = np.concatenate([shape_points(shape) for shapes in placed.values() for shape in shapes])
    thumb = np.sign(up.apply(hand.keypoints[len(hand.links)])[1])
    images, labels = [], []
    for view, azimuth in {"palm": 0.0, "between": 50.0, "thumb's side": 95.0}.items():
        angle = thumb * np.radians(azimuth)
        camera = fit(points, np.array([np.cos(angle), np.sin(angle), 0.25]), size[0] / size[1])
        images += [render_scene(shapes, camera, size) for shapes in placed.values()]
        labels += [f"{name}, {view}" for name in placed]
    title = f"{hand.name} hand: {len(hand.joints)} finger joints, {len(hand.links)} links"
    return contact_sheet(images, labels, columns=len(poses), title=title)


def upright(hand: Hand) -> Rotation:
    """Turns the wrist frame so that the fingers point up and the palm, where the fingers curl to, faces +x."""
    fingers = hand.keypoints[len(hand.links) + 1 :].mean(0)
    up = fingers / np.linalg.norm(fingers)
    links = list(hand.tip_links[1:])
    curl = (mujoco_link_poses(hand, hand.q_closed)[0] - mujoco_link_poses(hand, hand.q_open)[0])[links].mean(0)
    palm = curl - (curl @ up) * up
    palm = palm / np.linalg.norm(palm)
    return Rotation.from_matrix(np.stack([palm, np.cross(up, palm), up]))


def shape_points(shape: Shape) -> np.ndarray:
    """(n, 3) points of the world that a picture of a capsule or a mesh must hold."""
    turn = Rotation.from_quat(shape.quaternion, scalar_first=True)
    if shape.vertices is not None:
        return turn.apply(shape.vertices) + shape.position
    ends = shape.position + turn.apply([[0, 0, shape.size[1]], [0, 0, -shape.size[1]]])
    return (ends[:, None] + shape.size[0] * np.concatenate([np.eye(3), -np.eye(3)])).reshape(-1, 3)


def pick_episode(path: pathlib.Path, index: int, *, success: bool = False) -> Message:
    """One of the recorded episodes at `path`; -1 is the last. A CongraspError says how many there are."""
    last: collections.deque[Message] = collections.deque(maxlen=max(1, -index))
    count = 0
    for episode in read_episodes(path):
        if episode.meta["success"] or not success:
            last.append(episode)
            count += 1
            if count == index + 1:
                break
    if not -count <= index < count:
        kind = "successful episodes" if success else "episodes"
        raise CongraspError(f"{path} holds {count} {kind}, not one with index {index}.")
    return last[0 if index < 0 else -1]


def save_episode_video(
    path: pathlib.Path, episode: Message, size: tuple[int, int] = (640, 480), camera: Camera | None = None
) -> None:
    """An episode as MP4: at half its speed while the table stands, then in real time."""
    table = np.asarray(episode.arrays["table"], bool)
    step = max(1, round(_FRAME_SECONDS / 2 / float(episode.meta["control_dt"])))
    removal = int(table.sum())
    steps = [*range(0, removal, step), *range(removal, len(table), 2 * step)]
    save_video(path, render_episode_frames(episode, steps, size, camera, quick=True), size, 1 / _FRAME_SECONDS)
