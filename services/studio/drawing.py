"""Drawn parts of a request: the heading as an arrow, and the avoid region as paint; both in the
object frame.
"""

import itertools
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from congrasp.common.errors import CongraspError
from congrasp.common.objects.shapes import matrix
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.sampling.headings import INWARD
from congrasp.services.appearance.subdivision import subdivide
from congrasp.services.appearance.surface_colours import paint_surface

LARGEST = 1e6
"""Bound on each number of a position (m) or direction from a page; its square is finite in single
precision.
"""
_ROUNDING = 1e-6  # rad
_LOWEST_TARGET_M = 0.012  # above the table, of a target from above
_MAX_STROKE_POINTS = 2000
_versions = itertools.count(1)


class Arrow(NamedTuple):
    """A heading in the object frame."""

    position: np.ndarray
    """(3,) target of the middle of the grasping hand, m."""
    direction: np.ndarray
    """(3,) unit, direction of the approach."""
    cross: np.ndarray
    """(3,) unit, orthogonal to the direction: along the hand's cross-finger axis."""

    def roll(self, up: np.ndarray) -> float:
        """Angle in rad, in (-π, π], by which the cross-finger axis is turned around the direction
        from level.

        Args:
          up: (3,) unit, away from the table.
        """
        level = _level(self.direction, up)
        other = np.cross(self.direction, level)
        angle = float(np.arctan2(self.cross @ other, self.cross @ level))
        # -π and π are one angle, whose sign rounding would decide
        return angle if angle > _ROUNDING - np.pi else np.pi

    def with_roll(self, angle: float, up: np.ndarray) -> "Arrow":
        """The arrow with a roll of `angle` rad; see `roll`."""
        level = _level(self.direction, up)
        other = np.cross(self.direction, level)
        return self._replace(cross=np.cos(angle) * level + np.sin(angle) * other)


def arrow_through(surface: Any, direction: Any, cross: np.ndarray) -> Arrow:
    """An arrow through a point of the surface, with its target `INWARD` beyond it.

    Args:
      surface: (3,) point in the object frame, m.
      direction: (3,) of any length above zero.
      cross: (3,) cross-finger axis; made orthogonal to the direction.

    Raises:
      CongraspError: a value is not three numbers within `LARGEST`, or the direction is zero.
    """
    surface = vector("arrow's point", surface)
    direction = vector("arrow's direction", direction)
    length = np.linalg.norm(direction)
    if length < 1e-6:
        raise CongraspError("The arrow has no direction.", "Drag its tail away from its tip.")
    direction = direction / length
    return Arrow(surface + INWARD * direction, direction, _orthogonal(cross, direction))


def from_above(obj: GraspObject, rest: int) -> Arrow:
    """The arrow straight down onto an object in a resting pose, with the cross-finger axis along
    its narrower side.
    """
    turn = matrix(obj.rest_poses[rest][3:])
    world = obj.points @ turn.T
    center = (world[:, :2].max(0) + world[:, :2].min(0)) / 2
    from_center = np.linalg.norm(world[:, :2] - center, axis=-1)
    top = world[from_center.argsort()[: len(world) // 8], 2].max()
    middle = (world.max(0) + world.min(0)) / 2
    narrow = np.eye(3)[int(np.ptp(world[:, :2], axis=0).argmin())]
    height = max(top - INWARD, world[:, 2].min() + _LOWEST_TARGET_M)
    target = np.array([middle[0], middle[1], height])
    return Arrow(target @ turn, np.array([0.0, 0.0, -1.0]) @ turn, narrow @ turn)


def _level(direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(3,) unit, orthogonal to a direction and parallel to the table; for a vertical one, any
    such.
    """
    level = np.cross(up, direction)
    length = np.linalg.norm(level)
    if length > 1e-3:
        return level / length
    return _orthogonal(np.eye(3)[np.abs(up).argmin()], direction)


def _orthogonal(axis: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(3,) unit, the part of an axis that is orthogonal to a direction; any orthogonal one if that
    part vanishes.
    """
    cross = axis - axis @ direction * direction
    if np.linalg.norm(cross) < 1e-3:
        cross = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    return cross / np.linalg.norm(cross)


class Paint(NamedTuple):
    """Painted regions."""

    avoid: np.ndarray
    """(512,) bool, surface points of the painted avoid region."""
    shown: np.ndarray
    """(V,) bool, painted vertices."""
    version: int
    """Changes with the paint, and is unique across canvases."""


class Canvas:
    """The paint on one object, at first empty.

    Attributes:
      vertices, faces: (V, 3), (E, 3) of the painted mesh.
      colours: (V, 3) uint8 sRGB of the object; None if it has none.
      paint: the painted regions.
    """

    def __init__(self, obj: GraspObject):
        """Refines the object's mesh."""
        self._obj = obj
        self.colours: np.ndarray | None = None
        if obj.colours:
            self.vertices, self.faces, self.colours = paint_surface(
                obj.visual_vertices, obj.visual_faces, obj.colours
            )
        else:
            self.vertices, self.faces = subdivide(obj.visual_vertices, obj.visual_faces)
        self._set(np.zeros(len(obj.points), bool), np.zeros(len(self.vertices), bool))

    @property
    def avoid(self) -> np.ndarray:
        """(512,) bool, surface points of the painted avoid region."""
        return self.paint.avoid

    def brush(self, points: Any, radius: float, avoid: bool) -> None:
        """Paints everything within `radius` (m) of points (N, 3), or removes the paint there if
        `avoid` is False.

        Raises:
          CongraspError: see `stroke`; or the radius is not 1 mm to 20 cm.
        """
        strokes = stroke("brush stroke", points)
        if not 0.001 <= radius <= 0.2:
            raise CongraspError(f"The brush has a radius of {radius} m.", "Choose 1 mm to 20 cm.")

        def brushed(places: np.ndarray, before: np.ndarray) -> np.ndarray:
            """Painted state of some places after a stroke."""
            squared = ((places[:, None] - strokes[None]) ** 2).sum(-1).min(-1, initial=np.inf)
            return np.where(squared <= radius**2, bool(avoid), before)

        self._set(brushed(self._obj.points, self.avoid), brushed(self.vertices, self.paint.shown))

    def fill(self, avoid: bool) -> None:
        """Paints everything, or removes all paint if `avoid` is False."""
        self._set(np.full_like(self.avoid, avoid), np.full_like(self.paint.shown, avoid))

    def take_parts(self) -> None:
        """Paints the object's non-graspable parts, and nothing else."""
        avoid = self._obj.non_graspable_points
        _, nearest = cKDTree(self._obj.points).query(self.vertices)
        self._set(avoid, avoid[nearest])

    def _set(self, avoid: np.ndarray, shown: np.ndarray) -> None:
        """Sets the paint, with a new version."""
        self.paint = Paint(avoid, shown, next(_versions))


def vector(what: str, value: Any) -> np.ndarray:
    """(3,) finite numbers within `LARGEST`; raises a CongraspError for others."""
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise CongraspError(f"The {what} must be three numbers, not {ascii(value)[:60]}.")
    if np.abs(numbers).max() > LARGEST:
        raise CongraspError(f"The {what} must be within {LARGEST:g} of zero.")
    return numbers


def stroke(what: str, points: Any) -> np.ndarray:
    """(N, 3) points of a stroke of the mouse; raises a CongraspError unless they are at most 2000
    within `LARGEST`.
    """
    positions = np.asarray(points, float)
    if (
        positions.ndim != 2
        or positions.shape[1:] != (3,)
        or len(positions) > _MAX_STROKE_POINTS
        or not np.isfinite(positions).all()
    ):
        raise CongraspError(
            f"A {what} must be at most {_MAX_STROKE_POINTS} points of three numbers."
        )
    if np.abs(positions).max(initial=0.0) > LARGEST:
        raise CongraspError(f"A {what} must be within {LARGEST:g} m of the object.")
    return positions
