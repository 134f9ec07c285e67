"""Labelled points on the outer surface of a union of convex pieces, and its mass properties."""

import numpy as np

from congrasp.common.objects import shapes
from congrasp.common.objects.spec import SURFACE_POINTS, Piece

DENSE = 8192
"""Surface points from which `balanced` chooses."""
_SEAM = 2e-4  # m; a point is on the outer surface if a step of this length along its normal leaves all pieces
_REACHABLE = 4e-3  # m; a mesh's surface counts as accessible if the collision pieces end within this distance
# The generalised golden ratio of four dimensions: the positive root of x^5 = x + 1 (Roberts' R4 sequence).
_STRIDE = 1.1673039782614187 ** -np.arange(1.0, 5.0)


def sample_union(
    pieces: tuple[Piece, ...], rng: np.random.Generator, count: int = SURFACE_POINTS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples points evenly over the outer surface of the union of pieces.

    The points follow a low-discrepancy sequence with a random start, so that any prefix covers the surface evenly.
    Points of one piece inside another are dropped.

    Args:
      pieces: the convex pieces, in the object frame.
      rng: generator for the start of the sequence.
      count: number of points N.

    Returns:
      Points (N, 3) and outward unit normals (N, 3) in the object frame, and indices (N,) of each point's piece.
    """
    edges = np.cumsum([shapes.proposal_area(piece) for piece in pieces])
    starts = np.concatenate([[0.0], edges[:-1]])
    offset = rng.random(4)
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    total, drawn = 0, 0
    while total < count:
        u = _sequence(offset, drawn, 2 * count)
        drawn += 2 * count
        area = u[:, 0] * edges[-1]
        owner = np.searchsorted(edges, area, side="right").clip(max=len(pieces) - 1)
        u[:, 0] = (area - starts[owner]) / (edges - starts)[owner]
        points, normals, keep = np.empty((len(u), 3)), np.empty((len(u), 3)), np.empty(len(u), bool)
        for i, piece in enumerate(pieces):
            own = owner == i
            points[own], normals[own], keep[own] = shapes.propose(piece, u[own])
        outside = points + _SEAM * normals
        for i, piece in enumerate(pieces):
            keep &= (owner == i) | ~shapes.contains(piece, outside)
        found.append((points[keep], normals[keep], owner[keep]))
        total += int(keep.sum())
    points, normals, owner = (np.concatenate(parts)[:count] for parts in zip(*found, strict=True))
    return points, normals, owner


def sample_mesh(
    triangles: np.ndarray,
    pieces: tuple[Piece, ...],
    rng: np.random.Generator,
    *,
    oriented: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples points on the part of a mesh that a finger can reach.

    Points that lie more than a few millimetres below the surface of the collision pieces (inner walls, hollows filled
    by the pieces) are dropped, unless less than a quarter would remain.

    Args:
      triangles: (F, 3, 3) corners.
      pieces: collision pieces in the same frame.
      rng: generator for the start of the low-discrepancy sequence.
      oriented: True if all triangles have outward normals; otherwise, normals that point into the pieces while the
        other side is free are flipped.

    Returns:
      Points (N, 3), outward unit normals (N, 3), and indices (N,) of each point's triangle.
    """
    points, normals, face = shapes.on_triangles(triangles, _sequence(rng.random(4), 0, 8 * SURFACE_POINTS))
    outer, inner = (
        np.any([shapes.contains(piece, points + side * _REACHABLE * normals) for piece in pieces], axis=0)
        for side in (1, -1)
    )
    if oriented:
        reachable = ~outer
    else:
        reachable = ~(outer & inner)
        normals = np.where((outer & ~inner)[:, None], -normals, normals)
    if reachable.mean() < 0.25:
        reachable[:] = True
    chosen = np.flatnonzero(reachable)[:SURFACE_POINTS]
    return points[chosen], normals[chosen], face[chosen]


def balanced(graspable: np.ndarray) -> np.ndarray:
    """Indices of `SURFACE_POINTS` surface points of which every other one lies in the graspable region.

    Evenly spread over the whole surface, too few of them are on a thin handle to tell its two sides.

    Args:
      graspable: (N,) bool, both values occur; any prefix of these points covers the surface evenly.
    """
    sides = [np.flatnonzero(graspable == side) for side in (True, False)]
    return np.stack([np.resize(side, SURFACE_POINTS // 2) for side in sides], -1).ravel()


def halves(points: np.ndarray, cut: float) -> np.ndarray:
    """Labels (N,) 0 and 1 of points (N, 3) on the two sides of a plane across their longest principal axis.

    Args:
      points: surface points.
      cut: share of the points with label 0.
    """
    centered = points - points.mean(0)
    axis = np.linalg.eigh(centered.T @ centered)[1][:, -1]
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    along = centered @ axis
    return (along > np.quantile(along, cut)).astype(np.int32)


def _sequence(offset: np.ndarray, start: int, count: int) -> np.ndarray:
    """Points (count, 4) of the low-discrepancy sequence in the unit cube, from index `start` on."""
    return (offset + np.arange(start, start + count)[:, None] * _STRIDE) % 1.0


def mass_properties(pieces: tuple[Piece, ...], densities: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass (kg), centre of mass (3,) and inertia (3, 3) about it, in the frame of the pieces.

    The object is the sum of its pieces: densities add where pieces overlap.

    Args:
      pieces: the convex pieces.
      densities: (pieces,) kg/m^3.
    """
    masses = densities * [shapes.volume(piece) for piece in pieces]
    centers, inertias = zip(*(shapes.unit_inertia(piece) for piece in pieces), strict=True)
    mass = float(masses.sum())
    center = masses @ np.array(centers) / mass
    inertia = np.zeros((3, 3))
    for m, c, own in zip(masses, np.array(centers) - center, inertias, strict=True):
        inertia += m * (own + (c @ c) * np.eye(3) - np.outer(c, c))
    return mass, center, inertia
