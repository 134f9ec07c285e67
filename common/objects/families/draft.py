"""Draft of an object, returned by families of the procedural generator, and its primitive pieces."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from congrasp.common.objects.spec import Piece

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
    """Factor on the mass. It leaves the shape bitwise unchanged, which another density would not."""
    thin: bool = False
    """The graspable region may be less than a tenth of the surface; half of the surface points lie on it."""


Builder = Callable[[Rng], Draft]


def enter(table: dict[str, Builder], builder: Builder) -> Builder:
    """Registers a family in its module's table under the function's name without trailing underscores."""
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
    a, b = np.array(start, float), np.array(end, float)
    x, y, z = (b - a) / np.linalg.norm(b - a)
    q = np.array([1 + z, -y, x, 0.0]) if z > -1 + 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])
    q /= np.linalg.norm(q)
    return tuple((a + b) / 2), tuple(q), float(np.linalg.norm(b - a)) / 2
