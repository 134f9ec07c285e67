"""Scene of a picture, in the world frame: its shapes, and cameras that fit them.

Shapes are made of hands, objects, arms, the table, arrows and strings of beads.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.hands.skin import MATERIALS, Skin, skin_of
from congrasp.common.hands.spec import Hand, capsule_ends
from congrasp.common.objects.spec import Colours
from congrasp.services.record.episode import MovedArm
from congrasp.services.record.palette import MATERIALS as MATERIAL_COLOURS
from congrasp.services.record.palette import OBJECT, SKIN, TABLE, Colour

Kind = Literal["sphere", "capsule", "table", "mesh"]

_KEY = np.array([-0.45, -0.55, 1.0])  # towards the key light: right, away from the camera, up
_TABLE_RADIUS = 0.6  # m
FIELD_OF_VIEW = 26.0
"""Field of view of the cameras of `fit`, degrees."""
_SPACE = 1.06  # factor on the extent, for free space at the picture's edges
_STILL = 1e-3  # m of a curl that is too small for a direction


@dataclasses.dataclass(frozen=True)
class Shape:
    """A shape to draw.

    `size` is a radius and a half length along z, zeros for a mesh; `position` (3,) and `quaternion`
    (4,) are in the world frame. `colour` is sRGB in [0, 1]. With `alpha` below one the shape is
    transparent, and casts no `shadow`. `vertices` (V, 3) and `faces` (F, 3) belong to a mesh. With
    `paint`, in the shape's frame, each point of a mesh has the mean colour of the nearest paint
    points. With `normals` (V, 3) and `colours` (V, 3), the mesh is drawn unchanged: it must be
    closed, wound outwards, and fine enough.
    """

    kind: Kind
    size: tuple[float, float]
    colour: tuple[float, float, float]
    position: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    quaternion: np.ndarray = dataclasses.field(
        default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0])
    )
    alpha: float = 1.0
    shine: float = 0.25
    shadow: bool = True
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    paint: Colours | None = None
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera at `position` that looks at `target`, both (3,) in the world frame; z is
    up.
    """

    position: np.ndarray
    target: np.ndarray
    field_of_view: float = 30.0
    """Degrees from the lower to the upper edge of the picture."""

    def axes(self) -> np.ndarray:
        """(3, 3) rows: right, up and forward."""
        forward = np.subtract(self.target, self.position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])

    def key_light(self) -> np.ndarray:
        """(3,) unit direction towards the key light, which stays at the camera's left."""
        right = self.axes()[0]
        key = _KEY @ np.stack([right, np.cross([0.0, 0.0, 1.0], right), [0.0, 0.0, 1.0]])
        return key / np.linalg.norm(key)


def between(
    start: np.ndarray,
    end: np.ndarray,
    radius: float,
    colour: tuple[float, float, float],
    *,
    shadow: bool = True,
) -> Shape:
    """A capsule from `start` to `end` (3,), or a ball if they coincide; for the other arguments see
    `Shape`.
    """
    along = np.subtract(end, start)
    length = float(np.linalg.norm(along))
    middle = np.add(start, end) / 2
    if length < 1e-9:
        return Shape("sphere", (radius, 0.0), colour, middle, shadow=shadow)
    turn = Rotation.align_vectors([along / length], [[0.0, 0.0, 1.0]])[0].as_quat(scalar_first=True)
    return Shape("capsule", (radius, length / 2), colour, middle, turn, shadow=shadow)


def skin_shape(
    skin: Skin,
    position: np.ndarray,
    quaternion: np.ndarray,
    tint: Colour = SKIN,
    shares: Sequence[float] | np.ndarray | None = None,
    alpha: float = 1.0,
) -> Shape:
    """A hand's skin.

    Args:
      skin: the surface.
      position: (L, 3) origins of the links' frames in the world.
      quaternion: (L, 4) their orientations.
      tint: a colour to blend with that of the hand.
      shares: (L,) shares of that colour on each link; zero by default.
      alpha: opacity; below one the hand is transparent.
    """
    points, normals = skin.posed(
        position, Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    )
    own = skin_colours(skin)
    share = (skin.weights @ np.asarray(shares, np.float32))[:, None] if shares is not None else 0.0
    return Shape(
        "mesh",
        (0, 0),
        SKIN,
        alpha=alpha,
        shine=0.12,
        vertices=points,
        faces=skin.faces,
        normals=normals,
        colours=own + share * (np.array(tint) - own),
    )


def skin_colours(skin: Skin) -> np.ndarray:
    """(V, 3) colours of a skin, by its materials."""
    return np.array([MATERIAL_COLOURS[name] for name in MATERIALS], np.float32)[skin.material]


def capsule_shapes(hand: Hand, position: np.ndarray, quaternion: np.ndarray) -> list[Shape]:
    """The hand's capsules with its links' frames at positions (L, 3) and orientations (L, 4) in the
    world.
    """
    shapes = []
    for i, link in enumerate(hand.links):
        turn = Rotation.from_quat(quaternion[i], scalar_first=True)
        for capsule, ends in zip(link.capsules, capsule_ends(link), strict=True):
            start, end = turn.apply(ends) + position[i]
            shapes.append(between(start, end, capsule.radius, SKIN))
    return shapes


def link_frames(
    hand: Hand, q: np.ndarray, position: np.ndarray, wrist: Rotation
) -> tuple[np.ndarray, np.ndarray]:
    """Origins (L, 3) and orientations (L, 4) of the links at finger angles (F,), in the frame of
    the wrist's pose.
    """
    links, quaternion = mujoco_link_poses(hand, q)
    turned = wrist * Rotation.from_quat(quaternion, scalar_first=True)
    return wrist.apply(links) + position, turned.as_quat(scalar_first=True)


def posed_hand(  # noqa: PLR0913
    hand: Hand,
    q: np.ndarray,
    position: np.ndarray,
    wrist: Rotation,
    tint: Colour = SKIN,
    shares: Sequence[float] | np.ndarray | None = None,
    alpha: float = 1.0,
    skin: Skin | None = None,
) -> Shape:
    """The hand with finger angles (F,) and its wrist at a position (3,) m and orientation in the
    world frame.

    Tint, shares and alpha are those of `skin_shape`; the skin is `skin_of(hand)` by default.
    """
    return skin_shape(
        skin or skin_of(hand), *link_frames(hand, q, position, wrist), tint, shares, alpha
    )


def object_shape(
    mesh: tuple[np.ndarray, np.ndarray],
    position: np.ndarray,
    quaternion: np.ndarray,
    paint: Colours | None = None,
    colour: Colour = OBJECT,
) -> Shape:
    """An object.

    Args:
      mesh: (V, 3) and (F, 3) in its frame.
      position: (3,) m, world.
      quaternion: (4,) from its frame to the world.
      paint: colours of its surface, in its frame; optional.
      colour: colour without paint.
    """
    return Shape(
        "mesh",
        (0, 0),
        colour,
        np.asarray(position, float),
        np.asarray(quaternion, float),
        vertices=mesh[0],
        faces=mesh[1],
        paint=paint,
    )


def arm_shapes(arm: MovedArm, frame: int) -> list[Shape]:
    """Returns the links of an arm in a frame of its motion."""
    return [
        object_shape(
            (mesh.vertices, mesh.faces),
            arm.link_position[frame, mesh.link],
            arm.link_quaternion[frame, mesh.link],
            colour=mesh.colour,
        )
        for mesh in arm.meshes
    ]


def table_shape(below: np.ndarray) -> Shape:
    """A table top at height zero under a point (3,), whose edge fades away."""
    return Shape(
        "table",
        (_TABLE_RADIUS, 0.0),
        TABLE,
        np.array([below[0], below[1], 0.0]),
        shine=0.0,
        shadow=False,
    )


def arrow(start: np.ndarray, end: np.ndarray, radius: float, colour: Colour) -> list[Shape]:
    """A shaft with a cone whose tip is at `end` (3,), without a shadow."""
    along = np.subtract(end, start)
    direction = along / np.linalg.norm(along)
    neck = end - 6 * radius * direction
    turn = Rotation.align_vectors([direction], [[0.0, 0.0, 1.0]])[0].as_quat(scalar_first=True)
    angles = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    ring = np.stack(
        [2.4 * radius * np.cos(angles), 2.4 * radius * np.sin(angles), np.zeros(32)], -1
    )
    vertices = np.concatenate([ring, [[0, 0, 6 * radius], [0, 0, 0]]])
    here = np.arange(32)
    after = (here + 1) % 32
    faces = np.concatenate(
        [np.stack([here, after, np.full(32, 32)], -1), np.stack([after, here, np.full(32, 33)], -1)]
    )
    cone = Shape("mesh", (0, 0), colour, neck, turn, shadow=False, vertices=vertices, faces=faces)
    return [between(start, neck, radius, colour, shadow=False), cone]


def beads(points: np.ndarray, radius: float, colour: Colour) -> Shape:
    """Balls at points (N, 3) on a string, without a shadow."""
    balls = [trimesh.creation.icosphere(1, radius).apply_translation(point) for point in points]
    pairs = [
        pair for pair in itertools.pairwise(points) if np.linalg.norm(np.subtract(*pair)) > 1e-6
    ]
    string = [trimesh.creation.cylinder(0.4 * radius, segment=pair, sections=8) for pair in pairs]
    mesh: Any = trimesh.util.concatenate([*balls, *string])
    return Shape("mesh", (0, 0), colour, shadow=False, vertices=mesh.vertices, faces=mesh.faces)


def fit(points: np.ndarray, direction: np.ndarray, aspect: float) -> Camera:
    """The nearest camera that sees all points (N, 3) from `direction` (3,), which leads from them
    to the camera.
    """
    tangent = np.tan(np.radians(FIELD_OF_VIEW) / 2) / _SPACE
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    target = (points.min(0) + points.max(0)) / 2
    axes = Camera(target + direction, target).axes()
    distance = 1.0
    for _ in range(
        8
    ):  # distance and centre in turn; a few rounds converge to a fraction of a pixel
        x, y, z = axes @ (points - target).T
        distance = max((np.abs(x) / (tangent * aspect) - z).max(), (np.abs(y) / tangent - z).max())
        sides = np.stack([x, y]) / (distance + z)
        target = target + distance * (sides.max(1) + sides.min(1)) / 2 @ axes[:2]
    return Camera(target + distance * direction, target, FIELD_OF_VIEW)


def shape_points(shape: Shape) -> np.ndarray:
    """(n, 3) points, world frame, that a picture of a capsule or a mesh must contain."""
    turn = Rotation.from_quat(shape.quaternion, scalar_first=True)
    if shape.vertices is not None:
        return turn.apply(shape.vertices) + shape.position
    ends = shape.position + turn.apply([[0, 0, shape.size[1]], [0, 0, -shape.size[1]]])
    return (ends[:, None] + shape.size[0] * np.concatenate([np.eye(3), -np.eye(3)])).reshape(-1, 3)


def upright(hand: Hand) -> Rotation:
    """Rotation of the wrist frame after which the fingers point up and the palm, towards which they
    curl, faces +x.
    """
    fingers = hand.keypoints[len(hand.links) + 1 :].mean(0)
    up = fingers / np.linalg.norm(fingers)
    links = list(hand.tip_links[1:])
    curl = (mujoco_link_poses(hand, hand.q_closed)[0] - mujoco_link_poses(hand, hand.q_open)[0])[
        links
    ].mean(0)
    palm = curl - (curl @ up) * up
    if (
        np.linalg.norm(palm) < _STILL
    ):  # fingers with one joint, or around an axis, do not curl: use the thumb
        thumb = hand.keypoints[len(hand.links)] - fingers
        palm = thumb - (thumb @ up) * up
    palm = palm / np.linalg.norm(palm)
    return Rotation.from_matrix(np.stack([palm, np.cross(up, palm), up]))
