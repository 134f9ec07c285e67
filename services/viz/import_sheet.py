"""Picture of a mesh's import: before and after, with a hand at true scale."""

from typing import Any, NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.hands.spec import Hand
from congrasp.common.objects.shapes import tessellate
from congrasp.common.objects.spec import Colours, GraspObject
from congrasp.services.assets.objects.mesh_files import read_mesh
from congrasp.services.assets.objects.repair import with_few_faces
from congrasp.services.assets.objects.sizes import length, size_in_words
from congrasp.services.assets.objects.sources import Source
from congrasp.services.record.palette import AVOID, GRASPABLE, OBJECT, PIECES
from congrasp.services.viz.raster import render_fitted
from congrasp.services.viz.scene import Shape
from congrasp.services.viz.shapes import object_shape, posed_hand, shape_points, upright
from congrasp.services.viz.sheets import contact_sheet

_SIZE = (460, 360)
_VIEW = (0.9, -0.6, 0.45)
_GAP = 0.03  # m between the hand and the object
_LARGEST, _SMALLEST = 1.5, 0.01  # m; the file's mesh is drawn at the object's size if it is beyond them
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
    """Pictures next to the open hand: the file, the object on the table, its affordance, and its convex pieces.

    Args:
      hand: the hand.
      obj: the imported object.
      before: the mesh of the file, in the file's unit; None omits its picture.
      avoid: (P,) bool, surface points of the avoid region; None omits the picture of the affordance.

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
        parts[label] = [Body(rest.apply(np.asarray(before.vertices) * drawn / size), np.asarray(before.faces), OBJECT)]
    parts[f"the object: {size_in_words(sides)}, {1000 * obj.mass:.0f} g"] = [
        Body(
            rest.apply(obj.visual_vertices),
            obj.visual_faces,
            OBJECT,
            obj.colours and obj.colours._replace(points=rest.apply(obj.colours.points)),
        )
    ]
    if avoid is not None:
        colours = np.round(255 * np.where(avoid[:, None], AVOID, GRASPABLE)).astype(np.uint8)
        regions = Colours(rest.apply(obj.points), colours)
        label = "the affordance: green may be grasped, red must not be touched"
        parts[label] = [Body(rest.apply(obj.visual_vertices), obj.visual_faces, OBJECT, regions)]
    pieces = enumerate(map(tessellate, obj.pieces))
    count = len(obj.pieces)
    parts[f"its {f'{count} convex pieces' if count > 1 else 'convex piece'}, which physics uses"] = [
        Body(rest.apply(vertices), faces, PIECES[i % len(PIECES)]) for i, (vertices, faces) in pieces
    ]
    images = [render_fitted(_beside(hand, bodies), _VIEW, _SIZE) for bodies in parts.values()]
    title = f"{obj.name} beside the {hand.name} hand at true scale"
    return contact_sheet(images, list(parts), columns=len(parts), title="  |  ".join([title, *obj.notes]))


def mesh_of_file(source: Source) -> trimesh.Trimesh | None:
    """The surface in an object's files, in their unit; None if the files are too large to read twice."""
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
            body.own and (body.own.points - middle, body.own.values / 255),
            body.colour,
        )
        for body in bodies
    ]
    turn = upright(hand)
    standing = posed_hand(hand, hand.q_open, np.zeros(3), turn)
    own = shape_points(standing)
    side = (high[1] - low[1]) / 2 + _GAP - own[:, 1].min()
    place = np.array([-own[:, 0].mean(), side, -own[:, 2].min()])
    return [*shapes, posed_hand(hand, hand.q_open, place, turn)]
