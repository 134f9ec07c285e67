"""Pictures of the import of an object: its file and the result, next to a hand at true scale."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.hands.spec import Hand
from congrasp.common.objects.shapes import tessellate
from congrasp.common.objects.spec import Colours, GraspObject
from congrasp.services.appearance.palette import OBJECT, PIECES, Colour
from congrasp.services.appearance.surface_colours import region_colours
from congrasp.services.assets.objects.mesh_files import read_mesh
from congrasp.services.assets.objects.repair import with_few_faces
from congrasp.services.assets.objects.sizes import length, size_in_words
from congrasp.services.assets.objects.sources import Source
from congrasp.services.viz.hand_shapes import posed_hand, upright
from congrasp.services.viz.raster import render_fitted
from congrasp.services.viz.shapes import Shape, object_shape, shape_points, table_shape
from congrasp.services.viz.sheets import contact_sheet, with_lines

_SIZE = (460, 360)
"""Width and height of a picture, pixels."""
_VIEW = (0.9, -0.6, 0.45)
"""Direction from the object to the camera."""
_GAP_M = 0.05
"""Distance of the hand from the object."""
_LARGEST_M = 1.5
_SMALLEST_M = 0.01
"""Lengths between which a file in metres is drawn to scale."""
_MAX_FILE_BYTES = 30 << 20


class Body(NamedTuple):
    """A mesh to draw next to the hand, in the object frame or that of its file."""

    vertices: np.ndarray
    """(V, 3) m."""
    faces: np.ndarray
    """(F, 3)."""
    colour: Colour = OBJECT
    paint: Colours | None = None
    """Colours of its surface, in place of `colour`."""

    def turned(self, turn: Rotation) -> "Body":
        """The mesh after a rotation about the origin."""
        return self._moved(turn.apply)

    def shifted(self, offset: np.ndarray) -> "Body":
        """The mesh after a shift by (3,) m."""
        return self._moved(lambda points: points + offset)

    def scaled(self, factor: float) -> "Body":
        """The mesh at another size."""
        return self._moved(lambda points: factor * points)

    def _moved(self, change: Any) -> "Body":
        """The mesh after a change of all its points (N, 3)."""
        paint = self.paint
        if paint is not None:
            paint = paint._replace(points=change(np.asarray(paint.points, float)))
        return self._replace(vertices=change(np.asarray(self.vertices, float)), paint=paint)


def import_sheet(
    hand: Hand, obj: GraspObject, before: trimesh.Trimesh | None, avoid: np.ndarray | None = None
) -> np.ndarray:
    """Pictures on the table, next to the open hand: the file, the object, and its convex pieces.

    All lie in the object's likeliest resting pose.

    Args:
      hand: the hand.
      obj: the imported object.
      before: the mesh of the file, in the file's unit; None omits its picture.
      avoid: (P,) bool, surface points of the avoid region; None omits the picture of the
        affordance.

    Returns:
      (H, W, 3) uint8.
    """
    panels: dict[str, list[Body]] = {}
    if before is not None:
        label, body = _of_file(before, obj)
        panels[label] = [body]
    sides = tuple(np.ptp(obj.visual_vertices, axis=0).tolist())
    imported = Body(obj.visual_vertices, obj.visual_faces, paint=obj.colours)
    panels[f"the object: {size_in_words(sides)}, {1000 * obj.mass:.0f} g"] = [imported]
    if avoid is not None:
        regions = region_colours(obj.points, avoid)
        label = "the affordance: green may be grasped, red must not be touched"
        panels[label] = [imported._replace(paint=regions)]
    panels[_pieces_label(obj)] = _pieces(obj)

    rest = Rotation.from_quat(obj.rest_poses[0][3:], scalar_first=True)
    images = []
    for bodies in panels.values():
        shapes = _beside(hand, [body.turned(rest) for body in bodies])
        images.append(render_fitted(shapes, _VIEW, _SIZE, [table_shape(np.zeros(3))]))
    title = f"{obj.name} and the {hand.name} hand at true scale"
    sheet = contact_sheet(images, list(panels), columns=len(panels), title=title)
    return with_lines(sheet, obj.notes)


def _of_file(before: trimesh.Trimesh, obj: GraspObject) -> tuple[str, Body]:
    """Label and mesh of the file, whose unit is drawn as a metre if that is a plausible size."""
    size = float(before.extents.max())
    drawn = size
    remark = ""
    if not _SMALLEST_M <= size <= _LARGEST_M:
        drawn = float(np.ptp(obj.visual_vertices, axis=0).max())
        remark = " (not drawn to scale)"
    paint = obj.colours
    if paint is not None:
        # From the object frame to that of the file
        points = (paint.points - np.array(obj.origin)) / obj.file_scale
        paint = paint._replace(points=points)
    body = Body(np.asarray(before.vertices), np.asarray(before.faces), paint=paint)
    label = f"the file: {len(before.faces):,} triangles, {length(size)} long in metres{remark}"
    return label, body.scaled(drawn / size)


def _pieces_label(obj: GraspObject) -> str:
    """Label of the picture of the convex pieces."""
    count = len(obj.pieces)
    if count == 1:
        return "its convex piece, which physics uses"
    return f"its {count} convex pieces, which physics uses"


def _pieces(obj: GraspObject) -> list[Body]:
    """The convex pieces, each in a colour."""
    bodies = []
    for i, piece in enumerate(obj.pieces):
        vertices, faces = tessellate(piece)
        bodies.append(Body(vertices, faces, PIECES[i % len(PIECES)]))
    return bodies


def mesh_of_file(source: Source) -> trimesh.Trimesh | None:
    """The surface in an object's files, in their unit; None if they are too large to read twice."""
    files = [file.path for file in source.visuals or source.pieces]
    if sum(path.stat().st_size for path in files) > _MAX_FILE_BYTES:
        return None
    whole: Any = trimesh.util.concatenate([read_mesh(path) for path in files])
    return with_few_faces(whole)


def _beside(hand: Hand, bodies: Sequence[Body]) -> list[Shape]:
    """Meshes at height zero, and the open hand, upright, next to them."""
    points = np.concatenate([body.vertices for body in bodies])
    low = points.min(0)
    high = points.max(0)
    middle = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    origin = np.zeros(3)
    unturned = np.array([1.0, 0.0, 0.0, 0.0])
    shapes = []
    for body in bodies:
        placed = body.shifted(-middle)
        mesh = (placed.vertices, placed.faces)
        shapes.append(object_shape(mesh, origin, unturned, placed.paint, placed.colour))
    turn = upright(hand)
    hand_points = shape_points(posed_hand(hand, hand.q_open, origin, turn))
    side = (high[1] - low[1]) / 2 + _GAP_M - hand_points[:, 1].min()
    place = np.array([-hand_points[:, 0].mean(), side, -hand_points[:, 2].min()])
    return [*shapes, posed_hand(hand, hand.q_open, place, turn)]
