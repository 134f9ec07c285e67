"""Heading sets: directions and positions from which a hand may approach an object (paper, section
Constraint Setup).

The heading position is a few centimetres inward from a surface point of the graspable region (or of
the whole surface), along a direction in the cone around its inward normal. The cross-finger axis is
drawn from a few random rolls, preferring narrow ones. A candidate is rejected if

* the object's local width along the cross-finger axis exceeds the limit; it is measured on the
  surface points that the closing fingers sweep (3 cm to both sides of the hand's middle plane, down
  to 1 cm beyond the position);
* there are no opposing surfaces: among the points of that slab, within 1.5 cm of either end of the
  width, one whose normal is within 45 degrees of the axis (ours: at friction 1, two fingers that
  press along the axis slip off anything steeper, such as two edges of a board's corner);
* another part of the object is in front of the surface point (the point would not be hit first);
* with affordance, the approach comes within 1 cm of the avoid region, or the position lies nearer
  to it than to the graspable one, or it is as wide as that where the fingers close, so that they
  would meet it first (ours: the paper's regions were held by humans, so they can be held).
"""

from typing import Any, NamedTuple

import numpy as np

from congrasp.common.hands.closure import MAX_OBJECT_WIDTH_M, Outline
from congrasp.common.objects.spec import GraspObject

INWARD = 0.02
"""Distance from the surface to the heading position along the heading direction, m."""
MAX_WIDTH = MAX_OBJECT_WIDTH_M
"""Greatest width of the object along the cross-finger axis, m."""
AVOID_MARGIN = 0.01
"""Distance of an approach from the avoid region, m; closing fingers of this thickness must not meet
it.
"""
BACK_OFF = 0.15
"""Distance from the heading position back to the start of the approach, m."""
SLAB_HALF_BREADTH = 0.03
"""Half the breadth of the slab in which the local width is measured, m: a hand is about 6 cm
broad.
"""
SLAB_BEYOND = 0.01
"""Depth of the slab beyond the heading position, at the fingertips, m."""
WIDTH_POINTS = 256
"""Surface points on which widths are measured."""
_SKIN = 0.004
"""Distance by which the widest pose exceeds the object on either side, m."""
_SIDE = 0.015
"""Depth of an object's side along the cross-finger axis in which fingertips need a surface, m."""
_LEAST_OPPOSED_COSINE = np.cos(np.arctan(1.0))
"""Least cosine of a normal with the cross-finger axis: edge of the cone of friction 1."""


class Headings(NamedTuple):
    """H headings in the object frame."""

    position: np.ndarray
    """(H, 3) p-bar, target of the hand centre, m."""
    direction: np.ndarray
    """(H, 3) v-bar, unit: direction of the hand's motion, into the surface."""
    cross: np.ndarray
    """(H, 3) unit, orthogonal to the direction: along the hand's cross-finger axis w."""


class Slab(NamedTuple):
    """P surface points along the axes of headings (...,): (..., P) each."""

    along: Any
    """Coordinate along the cross-finger axis, m."""
    in_breadth: Any
    """True within the hand's breadth."""
    depth: Any
    """Distance beyond the heading position, m."""

    def swept(self) -> Any:
        """(..., P) bool: points that closing fingers sweep."""
        return self.in_breadth & (self.depth < SLAB_BEYOND)


def max_width(outline: Outline, scale: float) -> float:
    """Greatest width of an object for a hand, m: the paper's 12 cm times its scale, or the hand's
    opening.
    """
    return min(scale * MAX_WIDTH, float(outline.gaps[0]) - 2 * _SKIN)


def local_width(headings: Headings, points: np.ndarray) -> np.ndarray:
    """Widths (..., H) in m of objects along the cross-finger axes where fingers close.

    The width is measured in the slab of the module's rules; it is 0 if the slab contains no surface
    point.

    Args:
      headings: headings with fields (..., H, 3), NumPy or JAX arrays.
      points: (..., P, 3) surface points, of which the first 256 are used, m.
    """
    xp = headings.position.__array_namespace__()
    slab = _slab(headings, points[..., :WIDTH_POINTS, :])
    swept = slab.swept()
    low = xp.where(swept, slab.along, xp.inf).min(-1)
    high = xp.where(swept, slab.along, -xp.inf).max(-1)
    return xp.maximum(high - low, 0.0)


def opposed_at(headings: Headings, obj: GraspObject, avoid: np.ndarray) -> np.ndarray:
    """(H,) bool, true where surfaces outside of the avoid region (P,) can be pressed on from both
    sides.
    """
    slab = _slab(headings, obj.points[:WIDTH_POINTS])
    touchable = slab.swept() & ~avoid[:WIDTH_POINTS]
    return pressable(slab.along, touchable, headings.cross @ obj.normals[:WIDTH_POINTS].T)


def closes_on(headings: Headings, points: np.ndarray, avoid: np.ndarray) -> np.ndarray:
    """(H,) bool, True where fingers that close at the position meet the graspable region, on both
    sides and first.

    The position is nearer to that region than to the avoid region, which along the cross-finger
    axis ends at least 5 mm farther inside (see the module's rules).

    Args:
      headings: headings in the object frame.
      points: (P, 3) surface points, of which the first 256 are used, m.
      avoid: (P,) bool, the avoid region.
    """
    points = points[:WIDTH_POINTS]
    avoid = avoid[:WIDTH_POINTS]
    along, aside, depth = _offsets(headings, points)
    slab = Slab(along, np.abs(aside) < SLAB_HALF_BREADTH, depth)
    low, high = extent(along, slab.swept() & ~avoid)
    squared = along**2 + aside**2 + depth**2
    to_graspable = squared[:, ~avoid].min(-1, initial=np.inf)
    to_avoid = squared[:, avoid].min(-1, initial=np.inf)
    return (high > low) & meets_graspable_first(slab, avoid) & (to_graspable < to_avoid)


def meets_graspable_first(slab: Slab, avoid: np.ndarray) -> np.ndarray:
    """(...,) bool, True where closing fingers meet the graspable region before the avoid region
    (P,).
    """
    low, high = extent(slab.along, slab.swept() & ~avoid)
    near_fingertips = slab.in_breadth & (slab.depth < SLAB_BEYOND + AVOID_MARGIN)
    low_avoid, high_avoid = extent(slab.along, near_fingertips & avoid)
    below = low_avoid < low + AVOID_MARGIN / 2
    above = high_avoid > high - AVOID_MARGIN / 2
    return ~(below | above)


def pressable(along: np.ndarray, between: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """(...,) bool, true where both sides of what lies between closing fingers have a surface to
    press on.

    Args:
      along: (..., P) m, surface points along the cross-finger axis.
      between: (..., P) bool, points that the fingers sweep and may touch.
      facing: (..., P) cosines of the outward normals with the axis.
    """
    low, high = extent(along, between)
    at_low_side = between & (along < low[..., None] + _SIDE)
    at_high_side = between & (along > high[..., None] - _SIDE)
    low_pressable = at_low_side & (facing < -_LEAST_OPPOSED_COSINE)
    high_pressable = at_high_side & (facing > _LEAST_OPPOSED_COSINE)
    return low_pressable.any(-1) & high_pressable.any(-1)


def extent(along: np.ndarray, flags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimum and maximum (...,) of coordinates (..., P) selected by flags (..., P)."""
    low = np.where(flags, along, np.inf).min(-1)
    high = np.where(flags, along, -np.inf).max(-1)
    return low, high


def _slab(headings: Headings, points: Any) -> Slab:
    """Surface points (..., P, 3) along the axes of headings (..., H, 3)."""
    xp = headings.position.__array_namespace__()
    along, aside, depth = _offsets(headings, points)
    return Slab(along, xp.abs(aside) < SLAB_HALF_BREADTH, depth)


def _offsets(headings: Headings, points: Any) -> tuple[Any, Any, Any]:
    """Surface points (..., P, 3) along the axes w, v x w and v of headings (..., H, 3): (..., H, P)
    m each.
    """
    xp = headings.position.__array_namespace__()
    side = xp.cross(headings.direction, headings.cross)
    along = _projected(points, headings.cross, headings.position)
    aside = _projected(points, side, headings.position)
    depth = _projected(points, headings.direction, headings.position)
    return along, aside, depth


def _projected(points: Any, axes: Any, origins: Any) -> Any:
    """Coordinates (..., H, P) of points (..., P, 3) along axes (..., H, 3) from origins."""
    return axes @ points.mT - (axes * origins).sum(-1)[..., None]
