"""Pictures of objects: surface, convex pieces, headings and resting poses."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.hands.closure import outline
from congrasp.common.hands.files import HUMAN
from congrasp.common.objects.resting import rest_tilts
from congrasp.common.objects.shapes import tessellate
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.sampling.headings import Headings
from congrasp.common.task.sampling.reach import within_reach
from congrasp.services.appearance.palette import HEADING, PIECES
from congrasp.services.appearance.surface_colours import region_colours
from congrasp.services.viz.raster import render_fitted
from congrasp.services.viz.shapes import Shape, arrow, object_shape, table_shape
from congrasp.services.viz.sheets import contact_sheet

_MOST_ARROWS = 24
_ARROW_LENGTH_M = 0.08
_ARROW_RADIUS_M = 0.0015
_SIZE = (460, 400)
_SMALL = (240, 200)
"""Sizes of pictures, pixels."""
_COLUMNS = 7
_VIEW = (0.8, -0.6, 0.6)
"""Direction from the object to the camera."""


def object_sheet(obj: GraspObject, headings: Headings) -> np.ndarray:
    """Three views of the object in its most likely resting pose.

    Left: the surface, the graspable region green and the avoid region red. Middle: the convex
    pieces. Right: some of the headings that the human hand can reach over the table, drawn from 8
    cm before the heading position up to it.

    Returns:
      (H, W, 3) uint8.
    """
    place = np.asarray(obj.rest_poses[0][:3], float)
    painted = _painted(obj)
    plain = dataclasses.replace(painted, paint=None)
    arrows = _reachable_headings(obj, headings)
    panels = {
        "surface: graspable region green, avoid region red": [painted],
        f"{len(obj.pieces)} convex pieces": _pieces(obj, plain),
        f"{len(arrows)} of the headings that the table leaves": [
            dataclasses.replace(plain, alpha=0.5),
            *itertools.chain(*arrows),
        ],
    }
    table = table_shape(place)
    images = [render_fitted(shapes, _VIEW, _SIZE, [table]) for shapes in panels.values()]
    title = f"{obj.name}: {1000 * obj.mass:.0f} g, resting pose 1 of {len(obj.rest_poses)}"
    return contact_sheet(images, list(panels), columns=len(panels), title=title)


def _pieces(obj: GraspObject, placed: Shape) -> list[Shape]:
    """The convex pieces of an object in the pose of `placed`, each in a colour."""
    pieces = []
    for i, piece in enumerate(obj.pieces):
        vertices, faces = tessellate(piece)
        colour = PIECES[i % len(PIECES)]
        pieces.append(dataclasses.replace(placed, colour=colour, vertices=vertices, faces=faces))
    return pieces


def _reachable_headings(obj: GraspObject, headings: Headings) -> list[list[Shape]]:
    """Arrows of some headings that the human hand can reach in the first resting pose."""
    pose = np.asarray(obj.rest_poses[0], float)
    place = pose[:3]
    turn = Rotation.from_quat(pose[3:], scalar_first=True)
    (cleared,), (is_reachable,) = within_reach(headings, obj, pose[None], outline(HUMAN))
    chosen = np.flatnonzero(is_reachable)[:_MOST_ARROWS]
    tips = turn.apply(cleared.position[chosen]) + place
    directions = turn.apply(cleared.direction[chosen])
    return [
        arrow(tip - _ARROW_LENGTH_M * direction, tip, _ARROW_RADIUS_M, HEADING)
        for tip, direction in zip(tips, directions, strict=True)
    ]


def rest_picture(obj: GraspObject, rest: int, size: tuple[int, int] = _SMALL) -> np.ndarray:
    """The object on the table in one of its resting poses.

    Args:
      obj: the object.
      rest: index of the resting pose, from 0.
      size: width and height in pixels.

    Returns:
      (height, width, 3) uint8.
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
    images = []
    titles = []
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
