"""Redirects headings whose approach passes an avoid region to graspable surface points."""

from typing import NamedTuple

from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.constraints.heading import HeadingGoal
from congrasp.common.task.sampling.headings import INWARD, MAX_WIDTH
from congrasp.common.task.types import Array, Surface

REACH = 0.15
"""Length of the approach before the heading position that is checked against the avoid region,
m.
"""
MARGIN = 0.01
"""Distance that the approach should keep from the avoid region, m."""
_CANDIDATE_POINTS = 24
"""Graspable surface points to which a heading may be redirected."""
_RADIAN_LENGTH = 0.1
"""Distance between two heading positions that counts as much as a rotation by 1 rad, m."""
_VIOLATION_COST = 100.0
"""Cost of a violated rule, greater than that of any change of a heading."""
_TUBE_RADIUS = 0.01
"""Radius around the approach that must be free in front of the surface point, m."""
_SLAB_HALF_BREADTH = 0.03
"""Half the breadth of the slab in which the width is measured, m."""
_SLAB_BEYOND = 0.01
"""Depth of the slab beyond the heading position, m."""


def redirected(hand: Hand, surface: Surface, heading: HeadingGoal) -> HeadingGoal:
    """Redirects headings (B, ...) to graspable surface points.

    The candidates are surface points of the graspable region, each approached along the heading's
    direction and along the direction from the heading's start. The heading's position is 2 cm
    behind the point, times the hand's factor on objects. The result is the candidate that violates
    the fewest rules of `common.task.sampling.headings`, and among equals the one with the smallest
    change: a rotation by 1 rad counts as much as 10 cm between the positions. Rules:

    * No obstacle is in front of the point within 1 cm of the approach.
    * The approach stays 1 cm away from the avoid region, and ends nearer to the graspable one.
    * The object is no wider than 12 cm, times the same factor, along the cross-finger direction
      where fingers close.

    Args:
      hand: the hand.
      surface: labelled surface points.
      heading: headings to redirect.
    """
    candidates = _candidates(hand, surface, heading)
    cosine = jnp.sum(candidates.direction * heading.direction[:, None], -1)
    angle = jnp.arccos(jnp.clip(cosine, -1.0, 1.0))
    distance = jnp.linalg.norm(candidates.position - heading.position[:, None], axis=-1)
    change = angle + distance / _RADIAN_LENGTH
    cost = _VIOLATION_COST * _violations(hand, surface, candidates) + change
    best = jnp.argmin(cost, -1)[:, None, None]
    chosen = [jnp.take_along_axis(array, best, 1)[:, 0] for array in candidates]
    return HeadingGoal(*chosen)


def _candidates(hand: Hand, surface: Surface, heading: HeadingGoal) -> HeadingGoal:
    """Candidates (B, 2 n, 3) of `redirected`: n points in the heading's direction, then the same
    from its start.
    """
    index = _spread(~surface.avoid)
    targets = jnp.take_along_axis(surface.points, index[..., None], 1)
    unchanged = jnp.broadcast_to(heading.direction[:, None], targets.shape)
    start = heading.position - REACH * heading.direction
    straight = targets - start[:, None]
    straight = straight / jnp.maximum(jnp.linalg.norm(straight, axis=-1, keepdims=True), 1e-6)
    direction = jnp.concatenate([unchanged, straight], 1)
    position = jnp.concatenate([targets, targets], 1) + hand.object_scale * INWARD * direction
    first_direction = jnp.broadcast_to(heading.direction[:, None], direction.shape)
    first_cross = jnp.broadcast_to(heading.cross[:, None], direction.shape)
    turn = rotations.shortest(first_direction, direction, first_cross)
    return HeadingGoal(position, direction, rotations.rotate(turn, first_cross))


def _spread(flags: Array) -> Array:
    """Indices (B, n) of up to `_CANDIDATE_POINTS` true flags (B, N), evenly spread over them."""
    count = jnp.cumsum(flags, -1)
    rank = jnp.arange(_CANDIDATE_POINTS) * count[:, -1:] // _CANDIDATE_POINTS
    return jnp.argmax(count[:, None] > rank[..., None], -1)


class _Offsets(NamedTuple):
    """Surface points relative to heading positions: (B, n, N) each, m or m^2."""

    depth: Array
    """Coordinate along the direction, beyond the position."""
    along: Array
    """Coordinate along the cross-finger axis."""
    squared: Array
    """Squared distance from the position."""
    from_line: Array
    """Squared distance from the line of the approach."""


def _violations(hand: Hand, surface: Surface, headings: HeadingGoal) -> Array:
    """Number (B, n) of rules that headings (B, n, 3) violate, see `redirected`."""
    offsets = _offsets(surface, headings)
    inward = hand.object_scale * INWARD
    hidden = _is_hidden(offsets, inward)
    meets_avoid = _meets_avoid_region(offsets, surface.avoid[:, None])
    wide = _width(offsets) > hand.object_scale * MAX_WIDTH
    return hidden.astype(jnp.int32) + meets_avoid + wide


def _offsets(surface: Surface, headings: HeadingGoal) -> _Offsets:
    """Surface points relative to headings.

    Computed by coordinates, so that the loops over the surface points, the longest of a reset, run
    along memory.
    """
    points = jnp.moveaxis(surface.points, -1, 0)
    positions = jnp.moveaxis(headings.position, -1, 0)
    offset = [
        point[:, None] - position[..., None]
        for point, position in zip(points, positions, strict=True)
    ]
    depth = _projected(offset, headings.direction)
    along = _projected(offset, headings.cross)
    squared = sum(coordinate * coordinate for coordinate in offset)
    return _Offsets(depth, along, squared, squared - depth**2)


def _projected(offset: list[Array], axes: Array) -> Array:
    """Dot products (B, n, N) of offsets, by coordinates (B, n, N), with axes (B, n, 3)."""
    coordinates = zip(offset, jnp.moveaxis(axes, -1, 0), strict=True)
    return sum(coordinate * axis[..., None] for coordinate, axis in coordinates)


def _is_hidden(offsets: _Offsets, inward: float) -> Array:
    """(B, n) bool: another part of the object is in front of the surface point, which is `inward`
    m before the position.
    """
    before = (offsets.depth < -inward - 1.5 * _TUBE_RADIUS) & (offsets.depth > -REACH - inward)
    return jnp.any(before & (offsets.from_line < _TUBE_RADIUS**2), -1)


def _meets_avoid_region(offsets: _Offsets, avoid: Array) -> Array:
    """(B, n) bool: the approach comes near the avoid region (B, 1, N), or ends nearer to it than to
    the graspable one.
    """
    past = offsets.depth - jnp.clip(offsets.depth, -REACH, 0.0)
    from_approach = offsets.from_line + past**2
    near = jnp.min(jnp.where(avoid, from_approach, jnp.inf), -1) < MARGIN**2
    to_avoid = jnp.min(jnp.where(avoid, offsets.squared, jnp.inf), -1)
    to_graspable = jnp.min(jnp.where(~avoid, offsets.squared, jnp.inf), -1)
    return near | (to_avoid < to_graspable)


def _width(offsets: _Offsets) -> Array:
    """Width (B, n) of the object along the cross-finger axis where fingers close, m."""
    aside_squared = offsets.from_line - offsets.along**2
    slab = (aside_squared < _SLAB_HALF_BREADTH**2) & (offsets.depth < _SLAB_BEYOND)
    low = jnp.min(jnp.where(slab, offsets.along, jnp.inf), -1)
    high = jnp.max(jnp.where(slab, offsets.along, -jnp.inf), -1)
    return high - low
