"""Errors of convex pieces relative to their mesh: volume of their union, distance of the surfaces.

Both bodies are measured by the same parallel rays along each axis (`rays`). The rays' interior
length gives the volume; their entries and exits give the outer surface. Gaps along a ray that are
narrower than `SEAM_WIDTH_M` are closed, and the inside of a cup is outside.

Only the part of the surface that a ball of radius `_BALL_RADIUS_M` can touch from outside counts:
no finger reaches into a crack, or into a void between pieces. A ball that touches a wall of a crack
has its centre in the opposite wall.

A body that every ray misses is thinner than the distance between rays. Its volume is then computed
from its triangles, so that overlaps of pieces count twice, and its surface is sampled at random.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, label
from scipy.spatial import cKDTree
from trimesh.triangles import mass_properties

from congrasp.common.objects import shapes
from congrasp.services.assets.objects.interior import SEAM_WIDTH_M
from congrasp.services.assets.objects.rays import (
    RAYS,
    Crossings,
    Intervals,
    RayGrid,
    cast_rays,
    grid_of,
    intervals,
)
from congrasp.services.assets.objects.voxels import voxels

MAX_SURFACE_ERROR_M = 3e-3
"""Accepted Hausdorff distance of the surfaces."""
MAX_VOLUME_ERROR = 0.05
"""Accepted error of the volume, as a share of it."""
_MAX_POINTS = 50_000
"""Limit of the points of a surface whose distances from the other one are computed."""
_BALL_RADIUS_M = 2e-3
_MAX_CUBE_SIDE = 0.75
"""Longest side of the cubes that tell voids from the outside, in radii of the ball."""
_MIN_CLEARANCE = 0.8
"""Least distance of the centre of a ball from the surface, in its radii. It is less than 1, since
samples of the surface are not where the ball is nearest."""


class Fidelity(NamedTuple):
    """Errors of an object's convex pieces relative to its mesh."""

    volume: float | None
    """(Volume of the pieces' union - the mesh's) / the mesh's; None for an open mesh that encloses
    no volume.
    """
    surface: float
    """Hausdorff distance of the two outer surfaces, m: the larger of both directions, by sampled
    points.
    """

    @property
    def tolerance_ratio(self) -> float:
        """The larger of both errors, each divided by the accepted one; the pieces are accepted up
        to 1.
        """
        volume = abs(self.volume or 0.0)
        return max(self.surface / MAX_SURFACE_ERROR_M, volume / MAX_VOLUME_ERROR)

    def __str__(self) -> str:
        """Formats both errors as a phrase."""
        surface = f"their surface is at most {1000 * self.surface:.1f} mm off the mesh's"
        if self.volume is None:
            return f"{surface}; their volume has nothing to compare with, because the mesh is open"
        direction = "large" if self.volume > 0 else "small"
        return f"{surface}, and their volume {abs(self.volume):.1%} too {direction}"


class _Surface(NamedTuple):
    """Points of a surface."""

    points: np.ndarray
    """(N, 3) m."""
    normals: np.ndarray
    """(N, 3) outward unit normals."""
    outside_seams: np.ndarray
    """(N,) bool, False for walls of gaps that were closed."""
    outside_voids: np.ndarray
    """(N,) bool, False where a ball that touches the point is in the body or in a void of it."""


class _Body(NamedTuple):
    """The space that triangles enclose."""

    volume: float
    """m^3, the mean of three axes; 0 if every ray misses the body."""
    surface: _Surface


def fidelity(
    mesh: np.ndarray, pieces: list[np.ndarray], is_closed: bool, open_volume: float | None = None
) -> Fidelity:
    """Compares the union of convex pieces with a mesh.

    Args:
      mesh: (F, 3, 3) corners of its triangles, m; they wind outwards if it is closed.
      pieces: (V, 3) vertices of each piece, in the same frame.
      is_closed: True if the mesh encloses a volume; otherwise all of it counts as surface.
      open_volume: volume that an open mesh encloses (`winding.open_volume`), m^3, if any.
    """
    piece_triangles = [np.asarray(shapes.triangulate(piece).triangles) for piece in pieces]
    union_triangles = np.concatenate(piece_triangles)
    grid = grid_of(np.concatenate([mesh, union_triangles]))
    union = _measure(union_triangles, grid)
    if not is_closed:
        distance = _hausdorff_distance(union.surface, _sample_surface(mesh))
        volume_error = union.volume / open_volume - 1 if open_volume else None
        return Fidelity(volume_error, distance)
    reference = _measure(mesh, grid)
    if union.volume and reference.volume:
        volume_ratio = union.volume / reference.volume
    else:
        union_volume = float(mass_properties(union_triangles)["volume"])
        volume_ratio = union_volume / float(mass_properties(mesh)["volume"])
    distance = _hausdorff_distance(union.surface, reference.surface)
    return Fidelity(volume_ratio - 1, distance)


def _volume_along(crossings: Crossings, inside: Intervals, spacing: float) -> float:
    """Volume of the parts of rays along one axis that are inside, for rays `spacing` apart."""
    lengths = crossings.place[inside.exits] - crossings.place[inside.entries]
    return float(lengths.sum() * spacing**3)


def _sample_surface(triangles: np.ndarray) -> _Surface:
    """Random points of triangles (F, 3, 3)."""
    points, normals, _ = shapes.on_triangles(triangles, _random().random((2 * _MAX_POINTS, 3)))
    all_points = np.ones(len(points), bool)
    return _Surface(points, normals, outside_seams=all_points, outside_voids=all_points)


def _random() -> np.random.Generator:
    """The same numbers for every object."""
    return np.random.default_rng(0)


def _hausdorff_distance(first: _Surface, second: _Surface) -> float:
    """The larger of the farthest distances of both surfaces from each other, m."""
    return max(_farthest(first, second), _farthest(second, first))


def _farthest(surface: _Surface, other: _Surface) -> float:
    """The largest distance of a touchable point of a surface from the other surface, m."""
    points = _touchable_points(surface)
    distances = cKDTree(other.points[other.outside_seams]).query(points)[0]
    return float(distances.max())


def _touchable_points(surface: _Surface) -> np.ndarray:
    """Points (N, 3) at which a ball touches a surface from outside, at most `_MAX_POINTS`.

    A surface without such a point returns all points, so that it does not count as faultless.
    """
    candidates = np.flatnonzero(surface.outside_seams & surface.outside_voids)
    # Sorted: neighbouring points are then neighbours in the tree and in memory.
    chosen = np.sort(_random().permutation(candidates)[:_MAX_POINTS])
    points = surface.points[chosen]
    ball_centers = points + _BALL_RADIUS_M * surface.normals[chosen]
    clearance = _MIN_CLEARANCE * _BALL_RADIUS_M
    distances, _ = cKDTree(surface.points).query(ball_centers, distance_upper_bound=clearance)
    is_touchable = np.isinf(distances)  # no point is within the clearance
    if not is_touchable.any():
        return surface.points
    return points[is_touchable]


def _measure(triangles: np.ndarray, grid: RayGrid) -> _Body:
    """Measures volume and outer surface of what triangles (F, 3, 3) enclose, by rays."""
    volumes = []
    points = []
    normals = []
    outside_seams = []
    for crossings in cast_rays(triangles, grid):
        inside = intervals(crossings, SEAM_WIDTH_M / grid.spacing)
        volumes.append(_volume_along(crossings, inside, grid.spacing))
        outer_ends = np.concatenate([inside.entries, inside.exits])
        ends = np.concatenate([outer_ends, inside.closed])
        points.append(crossings.points[ends])
        normals.append(crossings.normals[ends])
        outside_seams.append(np.arange(len(ends)) < len(outer_ends))
    all_points = np.concatenate(points)
    if not len(all_points):
        return _Body(0.0, _sample_surface(triangles))
    all_normals = np.concatenate(normals)
    ball_centers = all_points + _BALL_RADIUS_M * all_normals
    surface = _Surface(
        points=all_points,
        normals=all_normals,
        outside_seams=np.concatenate(outside_seams),
        outside_voids=are_outside(triangles, ball_centers),
    )
    return _Body(float(np.mean(volumes)), surface)


def are_outside(triangles: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """(N,) bool, True for centres (N, 3) of balls that are not in a void of triangles (F, 3, 3).

    A void is a space that no ball can enter from the edge of the grid without touching the body.
    """
    longest = np.ptp(triangles, axis=(0, 1)).max()
    count = min(RAYS, int(longest / (_MAX_CUBE_SIDE * _BALL_RADIUS_M)) + 1)
    cubes = voxels(triangles, 2 * _BALL_RADIUS_M, count)
    clearance = distance_transform_edt(~cubes.inside, cubes.spacing)
    # The spaces that the centre of a ball can move in
    spaces, _ = label(clearance > _MIN_CLEARANCE * _BALL_RADIUS_M)
    outside = spaces == spaces[0, 0, 0]
    # Centres of balls that touch the body are at the edge of that space, and cubes are coarse: the
    # layers of cubes up to the body count as outside, too.
    layers = math.ceil(_MIN_CLEARANCE / _MAX_CUBE_SIDE)
    outside = binary_dilation(outside, iterations=layers, mask=~cubes.inside)
    return outside[cubes.at(centers)]
