"""Pictures of one object: its surface, convex pieces and headings, and its constraint set on the table."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands import get_hand
from congrasp.common.hands.closure import outline
from congrasp.common.hands.human import HUMAN
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.resting import rest_tilts
from congrasp.common.objects.shapes import tessellate
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.sampling.headings import INWARD, Headings, within_reach
from congrasp.common.wire.codec import Message
from congrasp.services.record.palette import AVOID, GRASPABLE, HEADING, PIECES, WAYPOINT
from congrasp.services.viz.raster import render_fitted
from congrasp.services.viz.scene import Shape
from congrasp.services.viz.shapes import arrow, beads, object_shape, posed_hand, table_shape
from congrasp.services.viz.sheets import contact_sheet

_ARROWS, _LENGTH = 24, 0.08  # number of headings, length of their arrows in m
_SIZE, _SMALL, _COLUMNS = (460, 400), (240, 200), 7
_VIEW = (0.8, -0.6, 0.6)


def object_sheet(obj: GraspObject, headings: Headings) -> np.ndarray:
    """Three views of the object in its most likely resting pose.

    Left: the surface, the graspable region green and the avoid region red. Middle: the convex pieces. Right: some of
    the headings that the human hand can reach over the table, drawn from 8 cm before the heading position up to it.

    Returns:
      (H, W, 3) uint8.
    """
    pose = np.asarray(obj.rest_poses[0], float)
    place, turn = pose[:3], Rotation.from_quat(pose[3:], scalar_first=True)
    (cleared,), (reachable,) = within_reach(headings, obj, pose[None], outline(HUMAN))
    chosen = np.flatnonzero(reachable)[:_ARROWS]
    tips, ways = turn.apply(cleared.position[chosen]) + place, turn.apply(cleared.direction[chosen])

    painted = _painted(obj)
    whole = dataclasses.replace(painted, paint_points=None, paint_colours=None)
    pieces = [
        dataclasses.replace(whole, colour=PIECES[i % len(PIECES)], vertices=vertices, faces=faces)
        for i, (vertices, faces) in enumerate(map(tessellate, obj.pieces))
    ]
    arrows = [arrow(tip - _LENGTH * way, tip, 0.0015, HEADING) for tip, way in zip(tips, ways, strict=True)]
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
    """(height, width, 3) uint8: the object on the table in one of its resting poses; size (width, height), pixels."""
    pose = np.asarray(obj.rest_poses[rest], float)
    shape = dataclasses.replace(_painted(obj), position=pose[:3], quaternion=pose[3:])
    shape = dataclasses.replace(shape, paint_points=None, paint_colours=None)
    return render_fitted([shape], _VIEW, size, [table_shape(pose[:3])])


def rests_sheet(obj: GraspObject) -> np.ndarray:
    """(H, W, 3) uint8: the object in each of its resting poses, by the numbers that `congrasp grasp --rest` takes."""
    images = [rest_picture(obj, rest) for rest in range(len(obj.rest_poses))]
    tilts = np.degrees(rest_tilts(obj))
    labels = [
        f"{number}: {100 * height:.1f} cm high, z axis {tilt:.0f}° from up"
        for number, (height, tilt) in enumerate(zip(obj.rest_poses[:, 2], tilts, strict=True), 1)
    ]
    title = f"{obj.name}: resting poses, the likeliest first"
    return contact_sheet(images, labels, columns=min(_COLUMNS, len(images)), title=title)


def overview(objects: Sequence[GraspObject]) -> np.ndarray:
    """(H, W, 3) uint8: each object in its likeliest resting pose, graspable region green and avoid region red."""
    images, titles = [], []
    for obj in objects:
        shape = _painted(obj)
        images.append(render_fitted([shape], _VIEW, _SMALL, [table_shape(shape.position)]))
        titles.append(f"{obj.name}: {1000 * obj.mass:.0f} g")
    return contact_sheet(images, titles, columns=_COLUMNS)


def _painted(obj: GraspObject) -> Shape:
    """The object in its most likely resting pose, in the colours of its regions."""
    pose = np.asarray(obj.rest_poses[0], float)
    paint = np.where(obj.non_graspable_points[:, None], AVOID, GRASPABLE)
    return object_shape((obj.visual_vertices, obj.visual_faces), pose[:3], pose[3:], (obj.points, paint))


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
        return [beads(self.rotation.apply(points[m]) + self.position, 0.003, WAYPOINT) for m in chosen]

    def grasps(self, region: int, chosen: np.ndarray) -> list[Shape]:
        """Hands in reference poses."""
        q, position, quaternion = (self.arrays[f"pose/{name}"][region] for name in ("q", "position", "quaternion"))
        shapes: list[Shape] = []
        for m in chosen:
            wrist = self.rotation * Rotation.from_quat(quaternion[m], scalar_first=True)
            shapes.append(posed_hand(self.hand, q[m], self.rotation.apply(position[m]) + self.position, wrist))
        return shapes

    @property
    def body(self) -> Shape:
        """The object with its painted regions."""
        mesh = self.arrays["visual/vertices"], self.arrays["visual/faces"]
        paint = self.arrays["surface/points"], np.where(self.arrays["surface/avoid"][:, None], AVOID, GRASPABLE)
        return object_shape(mesh, self.position, self.arrays["rest"][self.rest][3:], paint)


def constraint_sheet(constraints: Message, rest: int = 0, seed: int = 0) -> np.ndarray:
    """Six pictures of the object in one of its resting poses, with some of its constraints drawn by the seed.

    Approach arrows end before the surface, two centimetres short of the heading positions;
    the graspable region is green, and the avoid region red.

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
        f"headings, {int(allowed[0].sum())} allowed": placed.headings(0, some(allowed[0], _HEADINGS)),
        f"headings on the graspable region, {int(allowed[1].sum())} allowed": placed.headings(
            1, some(allowed[1], _HEADINGS)
        ),
        f"wrist trajectories, {int(clear[0].sum())} allowed": placed.paths(0, whole),
        "reference pose and its trajectory": placed.grasps(0, whole[:1]) + placed.paths(0, whole[:1]),
        "another reference pose": placed.grasps(0, whole[1:2]),
        "reference pose on the graspable region and its trajectory": reference,
    }
    body, images = placed.body, []
    for shapes in panels.values():
        images.append(render_fitted([*shapes, body], _SIDE, _FRAME, [table_shape(placed.position)]))
    title = f"{meta['object']}, {meta['hand']} hand, resting pose {rest + 1} of {len(arrays['rest'])}"
    return contact_sheet(images, list(panels), columns=3, title=f"{title}; avoid region in dark red")
