"""Draft of an object, returned by families of the procedural generator, and its pieces.

Mesh pieces of lathed, hollow, extruded and swept shapes are convex and gapless by construction:
neighbours share the face between them, so that their union has no cracks, and volumes add up.
"""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

from congrasp.common.objects.spec import MAX_MESH_VERTICES, Piece

_SIDES = 16
"""Corners of the cross-section of a lathed shape."""
_FLAT = 3e-4
"""Depth to which a profile may lie below the chord that replaces it, m."""
_STATIONS = 3
"""Outer corners of a wall's segment around the axis."""
Rng = np.random.Generator
Vector = tuple[float, float, float]


class Draft(NamedTuple):
    """An object proposed by a family; lengths in metres."""

    pieces: tuple[Piece, ...]
    part_names: tuple[str, ...] = ()
    """Empty: the object is labelled by its two halves."""
    graspable: tuple[bool, ...] = ()
    """For each part, true if it belongs to the graspable region."""
    weight: tuple[float, ...] = ()
    """Relative density of each part; empty means equal."""
    density: tuple[float, float] = (300.0, 1000.0)
    """Range of the density, kg/m^3."""
    heavier: float = 1.0
    """Factor on the mass. It leaves the shape bitwise unchanged, which another density would
    not.
    """
    thin: bool = False
    """The graspable region may be less than a tenth of the surface; half of the surface points lie
    on it.
    """


Builder = Callable[[Rng], Draft]


def enter(table: dict[str, Builder], builder: Builder) -> Builder:
    """Registers a family in its module's table under the function's name without trailing
    underscores.
    """
    table[builder.__name__.rstrip("_")] = builder
    return builder


def box(half: Vector, center: Vector = (0, 0, 0), part: int = 0) -> Piece:
    """A box with these half extents."""
    return Piece("box", half, center, part=part)


def ellipsoid(radii: Vector, center: Vector = (0, 0, 0), part: int = 0) -> Piece:
    """An ellipsoid with these radii."""
    return Piece("ellipsoid", radii, center, part=part)


def cylinder(start: Vector, end: Vector, radius: float, part: int = 0) -> Piece:
    """A cylinder between the centres of its ends."""
    center, quat, half = _between(start, end)
    return Piece("cylinder", (radius, half, 0), center, quat, part=part)


def capsule(start: Vector, end: Vector, radius: float, part: int = 0) -> Piece:
    """A capsule between the centres of its round ends."""
    center, quat, half = _between(start, end)
    return Piece("capsule", (radius, half, 0), center, quat, part=part)


def mesh(vertices: np.ndarray, part: int = 0) -> Piece:
    """The convex hull of points (V, 3)."""
    center = vertices.mean(0)
    return Piece("mesh", (0, 0, 0), tuple(center), vertices=vertices - center, part=part)


def polar(radius: float, turn: float, z: float) -> Vector:
    """A point by cylindrical coordinates."""
    return radius * np.cos(turn), radius * np.sin(turn), z


def either(rng: Rng) -> tuple[bool, bool]:
    """Selects one of two parts at random."""
    first = bool(rng.random() < 0.5)
    return first, not first


def _between(start: Vector, end: Vector) -> tuple[Vector, tuple[float, float, float, float], float]:
    """Centre, quaternion (z axis along the segment) and half length of a segment."""
    a = np.array(start, float)
    b = np.array(end, float)
    x, y, z = (b - a) / np.linalg.norm(b - a)
    q = np.array([1 + z, -y, x, 0.0]) if z > -1 + 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
    q /= np.linalg.norm(q)
    return tuple((a + b) / 2), tuple(q), float(np.linalg.norm(b - a)) / 2


def hull(*parts: Sequence[Sequence[float]] | np.ndarray, part: int = 0) -> Piece:
    """A mesh piece from the corners of the convex hull of points (V, 3), given in any number of
    arrays.
    """
    points = np.concatenate([np.asarray(points, float) for points in parts])
    return mesh(points[np.sort(ConvexHull(points).vertices)], part)


def grid(xs: Sequence[float], ys: Sequence[float], zs: Sequence[float]) -> np.ndarray:
    """Points (V, 3) with every combination of these coordinates; z changes fastest."""
    return np.array(list(itertools.product(xs, ys, zs)), float)


def thickened(
    corners: Sequence[Sequence[float]] | np.ndarray, axis: int, half: float, *, part: int = 0
) -> Piece:
    """A plate: the hull of corners (V, 3) that are moved by `half` metres to both sides.

    Args:
      corners: corners of a polygon.
      axis: index of the coordinate along which the corners move.
      half: half of the thickness, m.
      part: part of the piece.
    """
    offset = np.zeros(3)
    offset[axis] = half
    back = np.zeros(3)
    back[axis] = -half
    return hull(np.add(corners, back), np.add(corners, offset), part=part)


def lathe(
    profile: Sequence[tuple[float, float]],
    *,
    part: int = 0,
    squash: float = 1.0,
    sides: int = _SIDES,
) -> list[Piece]:
    """A solid of revolution around z, with one piece for each stretch of the profile that is
    convex.

    Args:
      profile: (height, radius) in ascending order of heights, m; straight between.
      part: part of the pieces.
      squash: factor on y: below 1 the cross-section is an ellipse.
      sides: number of corners of a cross-section.
    """
    max_rings = MAX_MESH_VERTICES // sides
    pieces = []
    first = 0
    while first < len(profile) - 1:
        last = first + 1
        while last + 1 < len(profile):
            is_full = last + 1 - first >= max_rings
            if is_full or not _bulges(profile[first : last + 2]):
                break
            last += 1
        rings = [ring(radius, z, sides, squash) for z, radius in profile[first : last + 1]]
        pieces.append(hull(*rings, part=part))
        first = last
    return pieces


def shell(
    profile: Sequence[tuple[float, float, float]], sides: int, *, part: int = 0, squash: float = 1.0
) -> list[Piece]:
    """A wall of revolution around z: `sides` pieces for each step of the profile.

    Args:
      profile: (height, outer radius, inner radius) in ascending order of heights, m; straight
        between.
      sides: pieces around the axis; the outside of each has two facets, the inside one.
      part: part of the pieces.
      squash: factor on y.
    """
    turns = 2 * np.pi / sides * np.arange(sides + 1)
    pieces = []
    for pair in itertools.pairwise(profile):
        for start, end in itertools.pairwise(turns):
            outside = []
            inside = []
            for z, outer_radius, inner_radius in pair:
                for turn in np.linspace(start, end, _STATIONS):
                    outside.append(_around(outer_radius, turn, z, squash))
                for turn in (start, end):
                    inside.append(_around(inner_radius, turn, z, squash))
            pieces.append(hull(outside, inside, part=part))
    return pieces


def vessel(
    profile: Sequence[tuple[float, float]],
    wall: float,
    sides: int,
    *,
    part: int = 0,
    squash: float = 1.0,
) -> list[Piece]:
    """An open vessel: a floor, and a wall of the same thickness.

    Args:
      profile: (height, outer radius) in ascending order of heights from 0, m; the first step holds
        the floor.
      wall: thickness, m.
      sides: pieces around the axis.
      part: part of the pieces.
      squash: factor on y.
    """
    heights, radii = np.array(profile).T
    corners = (_STATIONS - 1) * sides
    radius_above_floor = np.interp(wall, heights, radii)
    bottom = ring(radii[0], heights[0], corners, squash)
    top = ring(radius_above_floor, wall, corners, squash)
    floor = hull(bottom, top, part=part)
    wall_profile = [(wall, radius_above_floor, radius_above_floor - wall)]
    for z, radius in profile:
        if z > wall:
            wall_profile.append((z, radius, radius - wall))
    return [floor, *shell(wall_profile, sides, part=part, squash=squash)]


def extrude(
    outline: np.ndarray, low: float, high: float, *, taper: float = 1.0, part: int = 0
) -> list[Piece]:
    """A prism over a star-shaped outline, with one piece for each convex sector.

    Args:
      outline: (V, 2) corners, counterclockwise around the origin, from which all of the border is
        visible, m.
      low: height of the bottom, m.
      high: height of the top, m.
      taper: factor on the outline at the top.
      part: part of the pieces.
    """
    max_corners = MAX_MESH_VERTICES // 2 - 1
    count = len(outline)
    convex = _turns_left(np.roll(outline, 1, 0), outline, np.roll(outline, -1, 0))
    if convex.all() and count <= max_corners:
        return [_prism(outline, low, high, taper, part)]
    # Sectors begin at a reflex corner if there is one.
    first_corner = int(convex.argmin())
    outline = np.roll(outline, -first_corner, 0)
    convex = np.roll(convex, -first_corner, 0)
    closed = np.concatenate([outline, outline[:1]])
    first = 0
    pieces = []
    while first < count:
        last = first + 1
        while last < count:
            is_full = last - first >= max_corners - 2
            if is_full or not convex[last] or not _sector(closed[first : last + 2]):
                break
            last += 1
        sector = np.concatenate([np.zeros((1, 2)), closed[first : last + 1]])
        pieces.append(_prism(sector, low, high, taper, part))
        first = last
    return pieces


def sweep(
    path: np.ndarray,
    normal: Sequence[float] | np.ndarray,
    width: float | np.ndarray,
    thickness: float | np.ndarray,
    *,
    rounded: bool = False,
    closed: bool = False,
    part: int = 0,
) -> list[Piece]:
    """A bar along a path in a plane, with one piece for each of its segments.

    Args:
      path: (n, 3) centres of cross-sections, m; bends are below a right angle.
      normal: (3,) unit normal of the plane.
      width: across the path in its plane, m; one, or (n,).
      thickness: along the normal, m; one, or (n,).
      rounded: True for octagonal cross-sections, False for rectangular ones.
      closed: joins the last centre to the first.
      part: part of the pieces.
    """
    count = len(path)
    up = np.array(normal, float)
    ways = np.roll(path, -1, 0) - path
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    if closed:
        before = np.roll(ways, 1, 0)
    else:
        ways[-1] = ways[-2]
        before = np.concatenate([ways[:1], ways[:-1]])
    side = np.cross(up, before + ways)
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    # A mitre is longer than the bar's width
    side /= (side * np.cross(up, ways)).sum(-1, keepdims=True)
    if rounded:
        turns = np.pi / 4 * np.arange(8) + np.pi / 8
    else:
        turns = np.pi / 2 * np.arange(4) + np.pi / 4
    corners = np.stack([np.cos(turns), np.sin(turns)], -1) / np.cos(turns[0])
    across = np.broadcast_to(width, count)[:, None] / 2 * side
    along = np.broadcast_to(thickness, count)[:, None] / 2 * up
    sections = path[:, None] + corners[:, :1] * across[:, None] + corners[:, 1:] * along[:, None]
    pieces = [hull(start, end, part=part) for start, end in itertools.pairwise(sections)]
    if closed:
        pieces.append(hull(sections[-1], sections[0], part=part))
    return pieces


def slab(
    half: Sequence[float], corner: float, center: Sequence[float] = (0, 0, 0), *, part: int = 0
) -> Piece:
    """A plate of half extents (3,) along z whose upright edges are rounded with a radius, m."""
    x, y, z = half
    turns = np.linspace(0, np.pi / 2, 4)
    arc = corner * np.stack([np.cos(turns), np.sin(turns)], -1)
    quarter = arc + np.array([x - corner, y - corner])
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    outline = np.concatenate([quarter * sign for sign in signs]) + np.array(center[:2])
    return _prism(outline, center[2] - z, center[2] + z, 1.0, part)


def moved(piece: Piece, shift: Sequence[float] | np.ndarray) -> Piece:
    """Returns the piece translated by (3,) metres."""
    x, y, z = np.add(piece.pos, shift).tolist()
    return dataclasses.replace(piece, pos=(x, y, z))


def ring(radius: float, z: float, sides: int = _SIDES, squash: float = 1.0) -> np.ndarray:
    """Corners (sides, 3) of a polygon around z."""
    turns = 2 * np.pi / sides * np.arange(sides)
    return np.array([_around(radius, turn, z, squash) for turn in turns])


def arc(
    start: float, end: float, count: int, radii: tuple[float, float], center: Sequence[float]
) -> np.ndarray:
    """Points (count, 3) on an ellipse in the x-z plane between two angles, rad, with radii along x
    and z.
    """
    turns = np.linspace(start, end, count)
    offsets = np.stack([radii[0] * np.cos(turns), 0 * turns, radii[1] * np.sin(turns)], -1)
    return np.array(center) + offsets


def smooth(rng: np.random.Generator, count: int, low: float, high: float) -> np.ndarray:
    """Values (count,) of a random smooth curve that reaches both bounds."""
    at = np.linspace(0, 1, count)[:, None]
    amplitudes = rng.normal(size=3) / np.array([1.0, 1.5, 2.5])
    phases = rng.uniform(0, 2 * np.pi, 3)
    waves = amplitudes * np.cos(np.pi * np.array([1, 2, 3]) * at + phases)
    values = waves.sum(-1)
    return low + (high - low) * (values - values.min()) / np.ptp(values)


def _around(radius: float, turn: float, z: float, squash: float) -> tuple[float, float, float]:
    """A point by cylindrical coordinates, squashed along y."""
    return radius * np.cos(turn), squash * radius * np.sin(turn), z


def _bulges(profile: Sequence[tuple[float, float]]) -> bool:
    """True if a profile of (height, radius) is convex: nowhere below the chords between its
    points.
    """
    z, radius = np.array(profile).T
    for first, middle, last in itertools.combinations(range(len(z)), 3):
        chord = np.interp(z[middle], z[[first, last]], radius[[first, last]])
        if radius[middle] <= chord - _FLAT:
            return False
    return True


def _turns_left(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(...,) bool: True where the path over points (..., 2) turns left or is straight."""
    first = b - a
    second = c - b
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0] > -1e-12


def _sector(corners: np.ndarray) -> bool:
    """True if the origin and corners (n, 2) around it make a convex polygon."""
    loop = np.concatenate([np.zeros((1, 2)), corners])
    return bool(_turns_left(np.roll(loop, 1, 0), loop, np.roll(loop, -1, 0)).all())


def _prism(outline: np.ndarray, low: float, high: float, taper: float, part: int) -> Piece:
    """The hull of an outline (V, 2) at the bottom and, scaled about the origin, at the top."""
    bottom = np.column_stack([outline, np.full(len(outline), low)])
    top = np.column_stack([taper * outline, np.full(len(outline), high)])
    return hull(bottom, top, part=part)
