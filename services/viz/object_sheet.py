"""Pictures of one object: its surface, convex pieces and headings, its constraint set, and the
import of its mesh.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.hands import get_hand
from congrasp.common.hands.closure import outline
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.resting import rest_tilts
from congrasp.common.objects.shapes import tessellate
from congrasp.common.objects.spec import Colours, GraspObject
from congrasp.common.task.sampling.headings import INWARD, Headings
from congrasp.common.task.sampling.reach import within_reach
from congrasp.common.wire.codec import Message
from congrasp.services.assets.objects.mesh_files import read_mesh
from congrasp.services.assets.objects.options import length, size_in_words
from congrasp.services.assets.objects.repair import with_few_faces
from congrasp.services.assets.objects.sources import Source
from congrasp.services.record.palette import HEADING, OBJECT, PIECES, WAYPOINT, region_colours
from congrasp.services.viz.hand_shapes import posed_hand, upright
from congrasp.services.viz.raster import render_fitted
from congrasp.services.viz.shapes import (
    Shape,
    arrow,
    beads,
    object_shape,
    shape_points,
    table_shape,
)
from congrasp.services.viz.sheets import contact_sheet

_ARROWS, _LENGTH = 24, 0.08  # number of headings, length of their arrows in m
_SIZE, _SMALL, _COLUMNS = (460, 400), (240, 200), 7
_VIEW = (0.8, -0.6, 0.6)


def object_sheet(obj: GraspObject, headings: Headings) -> np.ndarray:
    """Three views of the object in its most likely resting pose.

    Left: the surface, the graspable region green and the avoid region red. Middle: the convex
    pieces. Right: some of the headings that the human hand can reach over the table, drawn from 8
    cm before the heading position up to it.

    Returns:
      (H, W, 3) uint8.
    """
    pose = np.asarray(obj.rest_poses[0], float)
    place, turn = pose[:3], Rotation.from_quat(pose[3:], scalar_first=True)
    (cleared,), (reachable,) = within_reach(headings, obj, pose[None], outline(HUMAN))
    chosen = np.flatnonzero(reachable)[:_ARROWS]
    tips, ways = turn.apply(cleared.position[chosen]) + place, turn.apply(cleared.direction[chosen])

    painted = _painted(obj)
    whole = dataclasses.replace(painted, paint=None)
    pieces = [
        dataclasses.replace(whole, colour=PIECES[i % len(PIECES)], vertices=vertices, faces=faces)
        for i, (vertices, faces) in enumerate(map(tessellate, obj.pieces))
    ]
    arrows = [
        arrow(tip - _LENGTH * way, tip, 0.0015, HEADING)
        for tip, way in zip(tips, ways, strict=True)
    ]
    panels = {
        "surface: graspable region green, avoid region red": [painted],
        f"{len(obj.pieces)} convex pieces": pieces,
        f"{len(chosen)} of the headings that the table leaves": [
            dataclasses.replace(whole, alpha=0.5),
            *itertools.chain(*arrows),
        ],
    }
    images = []
    for shapes in panels.values():
        images.append(render_fitted(shapes, _VIEW, _SIZE, [table_shape(place)]))
    title = f"{obj.name}: {1000 * obj.mass:.0f} g, resting pose 1 of {len(obj.rest_poses)}"
    return contact_sheet(images, list(panels), columns=len(panels), title=title)


def rest_picture(obj: GraspObject, rest: int, size: tuple[int, int] = _SMALL) -> np.ndarray:
    """(height, width, 3) uint8: the object on the table in one of its resting poses; size (width,
    height), pixels.
    """
    pose = np.asarray(obj.rest_poses[rest], float)
    shape = object_shape((obj.visual_vertices, obj.visual_faces), pose[:3], pose[3:])
    return render_fitted([shape], _VIEW, size, [table_shape(pose[:3])])


def rests_sheet(obj: GraspObject) -> np.ndarray:
    """(H, W, 3) uint8: the object in each of its resting poses, by the numbers that `congrasp grasp
    --rest` takes.
    """
    images = [rest_picture(obj, rest) for rest in range(len(obj.rest_poses))]
    tilts = np.degrees(rest_tilts(obj))
    labels = [
        f"{number}: {100 * height:.1f} cm high, z axis {tilt:.0f}° from up"
        for number, (height, tilt) in enumerate(zip(obj.rest_poses[:, 2], tilts, strict=True), 1)
    ]
    title = f"{obj.name}: resting poses, the likeliest first"
    return contact_sheet(images, labels, columns=min(_COLUMNS, len(images)), title=title)


def overview(objects: Sequence[GraspObject]) -> np.ndarray:
    """(H, W, 3) uint8: each object in its likeliest resting pose, graspable region green and avoid
    region red.
    """
    images, titles = [], []
    for obj in objects:
        shape = _painted(obj)
        images.append(render_fitted([shape], _VIEW, _SMALL, [table_shape(shape.position)]))
        titles.append(f"{obj.name}: {1000 * obj.mass:.0f} g")
    return contact_sheet(images, titles, columns=_COLUMNS)


def _painted(obj: GraspObject) -> Shape:
    """The object in its most likely resting pose, in the colours of its regions."""
    pose = np.asarray(obj.rest_poses[0], float)
    paint = region_colours(obj.points, obj.non_graspable_points)
    return object_shape((obj.visual_vertices, obj.visual_faces), pose[:3], pose[3:], paint)


_HEADINGS, _PATHS = 14, 4
_ARROW_LENGTH, _GAP = 0.07, 0.002  # m
_SIDE = (0.8, 0.6, 0.45)
_FRAME = (460, 360)


@dataclasses.dataclass(frozen=True)
class _Placed:
    """Constraints of an object in one of its resting poses, as shapes in the world frame."""

    arrays: Mapping[str, np.ndarray]
    """Arrays of the constraint set."""
    rest: int
    """Index of the resting pose."""
    hand: Hand

    @property
    def position(self) -> np.ndarray:
        """Position (3,) of the object, m."""
        return np.asarray(self.arrays["rest"][self.rest][:3], float)

    @property
    def rotation(self) -> Rotation:
        """Rotation of the object."""
        return Rotation.from_quat(self.arrays["rest"][self.rest][3:], scalar_first=True)

    def headings(self, region: int, chosen: np.ndarray) -> list[Shape]:
        """Arrows of headings, which end two centimetres before the heading positions."""
        shapes = []
        for h in chosen:
            direction = self.rotation.apply(self.arrays["heading/direction"][region, h])
            target = self.rotation.apply(self.arrays["heading/position"][region, h]) + self.position
            tip = target - (INWARD + _GAP) * direction
            shapes += arrow(tip - _ARROW_LENGTH * direction, tip, 0.0016, HEADING)
        return shapes

    def paths(self, region: int, chosen: np.ndarray) -> list[Shape]:
        """Strings of beads along trajectories."""
        points = self.arrays["trajectory/position"][region]
        return [
            beads(self.rotation.apply(points[m]) + self.position, 0.003, WAYPOINT) for m in chosen
        ]

    def grasps(self, region: int, chosen: np.ndarray) -> list[Shape]:
        """Hands in reference poses."""
        q, position, quaternion = (
            self.arrays[f"pose/{name}"][region] for name in ("q", "position", "quaternion")
        )
        shapes: list[Shape] = []
        for m in chosen:
            wrist = self.rotation * Rotation.from_quat(quaternion[m], scalar_first=True)
            shapes.append(
                posed_hand(self.hand, q[m], self.rotation.apply(position[m]) + self.position, wrist)
            )
        return shapes

    @property
    def body(self) -> Shape:
        """The object with its painted regions."""
        mesh = self.arrays["visual/vertices"], self.arrays["visual/faces"]
        paint = region_colours(self.arrays["surface/points"], self.arrays["surface/avoid"])
        return object_shape(mesh, self.position, self.arrays["rest"][self.rest][3:], paint)


def constraint_sheet(constraints: Message, rest: int = 0, seed: int = 0) -> np.ndarray:
    """Six pictures of the object in one of its resting poses, with a random sample of its
    constraints.

    Heading arrows end before the surface, two centimetres short of the heading positions. The
    graspable region is green, the avoid region red.

    Returns:
      (H, W, 3) uint8.
    """
    arrays, meta = constraints.arrays, constraints.meta
    rng = np.random.default_rng(seed)
    placed = _Placed(arrays, rest, get_hand(meta.get("hand_reference", meta["hand"])))

    def some(which: np.ndarray, count: int) -> np.ndarray:
        """Draws at most `count` indices of true entries."""
        return rng.permutation(np.flatnonzero(which))[:count]

    allowed, clear = arrays["heading/allowed"][:, rest], arrays["pose/allowed"][:, rest]
    whole, region = some(clear[0], _PATHS), some(clear[1], _PATHS)
    reference = placed.grasps(1, region[:1]) + placed.paths(1, region[:1])
    panels = {
        f"headings, {int(allowed[0].sum())} allowed": placed.headings(
            0, some(allowed[0], _HEADINGS)
        ),
        f"headings on the graspable region, {int(allowed[1].sum())} allowed": placed.headings(
            1, some(allowed[1], _HEADINGS)
        ),
        f"wrist trajectories, {int(clear[0].sum())} allowed": placed.paths(0, whole),
        "reference pose and its trajectory": placed.grasps(0, whole[:1])
        + placed.paths(0, whole[:1]),
        "another reference pose": placed.grasps(0, whole[1:2]),
        "reference pose on the graspable region and its trajectory": reference,
    }
    body, images = placed.body, []
    for shapes in panels.values():
        images.append(render_fitted([*shapes, body], _SIDE, _FRAME, [table_shape(placed.position)]))
    title = (
        f"{meta['object']}, {meta['hand']} hand, resting pose {rest + 1} of {len(arrays['rest'])}"
    )
    return contact_sheet(
        images, list(panels), columns=3, title=f"{title}; avoid region in dark red"
    )


_PANEL = (460, 360)
_CORNER = (0.9, -0.6, 0.45)
_BETWEEN = 0.03  # m between the hand and the object
# M; the file's mesh is drawn at the object's size if it is beyond them
_LARGEST, _SMALLEST = (
    1.5,
    0.01,
)
_LARGE_FILE = 30 << 20  # bytes


class Body(NamedTuple):
    """A mesh to draw next to the hand."""

    vertices: np.ndarray
    """(V, 3)."""
    faces: np.ndarray
    """(F, 3)."""
    colour: tuple[float, float, float]
    own: Colours | None = None
    """Colours of its surface, in place of `colour`."""


def import_sheet(
    hand: Hand, obj: GraspObject, before: trimesh.Trimesh | None, avoid: np.ndarray | None = None
) -> np.ndarray:
    """Pictures next to the open hand: the file, the object on the table, its affordance, and its
    convex pieces.

    Args:
      hand: the hand.
      obj: the imported object.
      before: the mesh of the file, in the file's unit; None omits its picture.
      avoid: (P,) bool, surface points of the avoid region; None omits the picture of the
        affordance.

    Returns:
      (H, W, 3) uint8.
    """
    rest = Rotation.from_quat(obj.rest_poses[0][3:], scalar_first=True)
    sides = tuple(np.ptp(obj.visual_vertices, axis=0).tolist())
    parts: dict[str, list[Body]] = {}
    if before is not None:
        size = float(before.extents.max())
        drawn = size if _SMALLEST <= size <= _LARGEST else max(sides)
        scaled = "" if drawn == size else " (not drawn to scale)"
        label = f"the file: {len(before.faces):,} triangles, {length(size)} long in metres{scaled}"
        parts[label] = [
            Body(
                rest.apply(np.asarray(before.vertices) * drawn / size),
                np.asarray(before.faces),
                OBJECT,
            )
        ]
    parts[f"the object: {size_in_words(sides)}, {1000 * obj.mass:.0f} g"] = [
        Body(
            rest.apply(obj.visual_vertices),
            obj.visual_faces,
            OBJECT,
            obj.colours and obj.colours._replace(points=rest.apply(obj.colours.points)),
        )
    ]
    if avoid is not None:
        label = "the affordance: green may be grasped, red must not be touched"
        parts[label] = [
            Body(
                rest.apply(obj.visual_vertices),
                obj.visual_faces,
                OBJECT,
                region_colours(rest.apply(obj.points), avoid),
            )
        ]
    pieces = enumerate(map(tessellate, obj.pieces))
    count = len(obj.pieces)
    parts[
        f"its {f'{count} convex pieces' if count > 1 else 'convex piece'}, which physics uses"
    ] = [
        Body(rest.apply(vertices), faces, PIECES[i % len(PIECES)])
        for i, (vertices, faces) in pieces
    ]
    images = [render_fitted(_beside(hand, bodies), _CORNER, _PANEL) for bodies in parts.values()]
    title = f"{obj.name} and the {hand.name} hand at true scale"
    return contact_sheet(
        images, list(parts), columns=len(parts), title="  |  ".join([title, *obj.notes])
    )


def mesh_of_file(source: Source) -> trimesh.Trimesh | None:
    """The surface in an object's files, in their unit; None if the files are too large to read
    twice.
    """
    files = [file.path for file in source.visuals or source.pieces]
    if sum(path.stat().st_size for path in files) > _LARGE_FILE:
        return None
    whole: Any = trimesh.util.concatenate([read_mesh(path) for path in files])
    return with_few_faces(whole)


def _beside(hand: Hand, bodies: list[Body]) -> list[Shape]:
    """Meshes at height zero, and the open hand, upright, next to them."""
    points = np.concatenate([body.vertices for body in bodies])
    low, high = points.min(0), points.max(0)
    middle = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    shapes = [
        object_shape(
            (body.vertices - middle, body.faces),
            np.zeros(3),
            np.array([1.0, 0.0, 0.0, 0.0]),
            body.own and body.own._replace(points=body.own.points - middle),
            body.colour,
        )
        for body in bodies
    ]
    turn = upright(hand)
    standing = posed_hand(hand, hand.q_open, np.zeros(3), turn)
    own = shape_points(standing)
    side = (high[1] - low[1]) / 2 + _BETWEEN - own[:, 1].min()
    place = np.array([-own[:, 0].mean(), side, -own[:, 2].min()])
    return [*shapes, posed_hand(hand, hand.q_open, place, turn)]
