"""Errors of convex pieces relative to their mesh: volume of their union, distance of the surfaces.

Both bodies are cut by the same parallel rays along each axis (`rays`). The rays' interior length
gives the volume; their entries and exits give the outer surface. Gaps along a ray that are narrower
than `SEAM` are closed, and the inside of a cup is outside. Only the part of the surface that a ball
of radius `REACH` can touch from outside counts: no finger reaches into a crack, or into a void
between pieces. A body that every ray misses is thinner than their distance: its volume is exact,
and its surface is sampled.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, label
from scipy.spatial import cKDTree
from trimesh.triangles import mass_properties

from congrasp.common.objects import shapes
from congrasp.services.assets.objects.interior import SEAM
from congrasp.services.assets.objects.rays import RAYS, RayGrid, cast_rays, grid_of, intervals
from congrasp.services.assets.objects.voxels import voxels

POINTS = 50_000
"""Most points of a surface whose distances from the other one are computed."""
MOST_SURFACE = 3e-3
"""Distance of the surfaces that is small enough, m."""
MOST_VOLUME = 0.05
"""Error of the volume that is small enough, as a share of it."""
REACH = 2e-3
"""Radius of the ball, m."""
_CUBE_SIDE = 0.75
"""Side of a cube that tells voids from the outside, in radii of the ball."""
_FACING = 0.5
"""Cosine of walls that face one another: those within `SEAM` are a crack, too."""
_TOUCH_DISTANCE = 0.8
"""Least distance of the ball's centre from samples of the surface that it touches, in its radii:
they are not where the ball is nearest.
"""
_NEAREST = 8
"""Samples near a point that are searched for the other wall of a crack."""


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
    def excess(self) -> float:
        """The larger of both errors as a share of the tolerance."""
        return max(self.surface / MOST_SURFACE, abs(self.volume or 0.0) / MOST_VOLUME)

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
    outer: np.ndarray
    """(N,) bool, False in seams."""
    reached: np.ndarray
    """(N,) bool, False in voids."""


class _Body(NamedTuple):
    """The space that triangles enclose."""

    volume: float
    """m^3, the mean of three axes."""
    surface: _Surface


def fidelity(
    mesh: np.ndarray, pieces: list[np.ndarray], closed: bool, open_volume: float | None = None
) -> Fidelity:
    """Compares the union of convex pieces with a mesh.

    Args:
      mesh: (F, 3, 3) corners of its triangles, m; they wind outwards where it is closed.
      pieces: (V, 3) vertices of each piece, in the same frame.
      closed: True if the mesh encloses a volume; otherwise all of it counts as surface.
      open_volume: volume that an open mesh encloses (`winding.open_volume`), m^3, if any.
    """
    piece_triangles = [np.asarray(shapes.triangulate(piece).triangles) for piece in pieces]
    union_triangles = np.concatenate(piece_triangles)
    grid = grid_of(np.concatenate([mesh, union_triangles]))
    union = _cut(union_triangles, grid)
    if not closed:
        distance = _hausdorff_distance(union.surface, _sampled(mesh))
        volume_error = union.volume / open_volume - 1 if open_volume else None
        return Fidelity(volume_error, distance)
    reference = _cut(mesh, grid)
    union_volume = union.volume
    mesh_volume = reference.volume
    if not (union_volume and mesh_volume):
        union_volume = float(mass_properties(union_triangles)["volume"])
        mesh_volume = float(mass_properties(mesh)["volume"])
    distance = _hausdorff_distance(union.surface, reference.surface)
    return Fidelity(union_volume / mesh_volume - 1, distance)


def _sampled(triangles: np.ndarray) -> _Surface:
    """Random points of triangles (F, 3, 3)."""
    points, normals, _ = shapes.on_triangles(triangles, _random().random((2 * POINTS, 3)))
    everywhere = np.ones(len(points), bool)
    return _Surface(points, normals, outer=everywhere, reached=everywhere)


def _random() -> np.random.Generator:
    """The same numbers for every object."""
    return np.random.default_rng(0)


def _hausdorff_distance(first: _Surface, second: _Surface) -> float:
    """The larger of the farthest distances of both surfaces from each other, m."""
    return max(_farthest(first, second), _farthest(second, first))


def _farthest(surface: _Surface, other: _Surface) -> float:
    """The largest distance of a touchable point of a surface from the other surface, m."""
    candidates = np.flatnonzero(surface.outer & surface.reached)
    # Sorted: neighbouring points are then neighbours in the tree and in memory.
    chosen = np.sort(_random().permutation(candidates)[:POINTS])
    points = surface.points[chosen]
    normals = surface.normals[chosen]
    tree = cKDTree(surface.points)
    distance, near = tree.query(points, k=_NEAREST, distance_upper_bound=SEAM)
    near_normals = surface.normals[np.minimum(near, len(surface.points) - 1)]
    cosine = np.einsum("nkj,nj->nk", near_normals, normals)
    in_crack = ((distance < SEAM) & (cosine < -_FACING)).any(-1)
    ball_centers = points + REACH * normals
    to_surface = tree.query(ball_centers, distance_upper_bound=_TOUCH_DISTANCE * REACH)[0]
    touched = ~in_crack & np.isinf(to_surface)
    distances = cKDTree(other.points[other.outer]).query(points[touched])[0]
    return float(distances.max(initial=0.0))


def _cut(triangles: np.ndarray, grid: RayGrid) -> _Body:
    """Volume and outer surface of what triangles (F, 3, 3) enclose."""
    volumes = []
    points = []
    normals = []
    outer = []
    for crossings in cast_rays(triangles, grid):
        entries, exits, closed = intervals(crossings, SEAM / grid.spacing)
        lengths = crossings.place[exits] - crossings.place[entries]
        volumes.append(lengths.sum() * grid.spacing**3)
        ends = np.concatenate([entries, exits, closed])
        points.append(crossings.points[ends])
        normals.append(crossings.normals[ends])
        outer.append(np.arange(len(ends)) < 2 * len(entries))
    all_points = np.concatenate(points)
    if not len(all_points):
        return _Body(0.0, _sampled(triangles))
    all_normals = np.concatenate(normals)
    reached = _is_outside(triangles, all_points + REACH * all_normals)
    surface = _Surface(all_points, all_normals, np.concatenate(outer), reached)
    return _Body(float(np.mean(volumes)), surface)


def _is_outside(triangles: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """(N,) bool, True for centres (N, 3) of balls that are not in a void of triangles (F, 3, 3)."""
    longest = np.ptp(triangles, axis=(0, 1)).max()
    count = min(RAYS, int(longest / (_CUBE_SIDE * REACH)) + 1)
    cubes = voxels(triangles, 2 * REACH, count)
    clearance = distance_transform_edt(~cubes.inside, cubes.spacing)
    spaces, _ = label(clearance > _TOUCH_DISTANCE * REACH)
    outside = spaces == spaces[0, 0, 0]
    outside = binary_dilation(outside, iterations=2, mask=~cubes.inside)
    return outside[cubes.at(centers)]
