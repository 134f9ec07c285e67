"""Errors of convex pieces relative to their mesh: volume of their union, distance of the surfaces.

Both bodies are cut by parallel rays along each axis, the same for both. A ray is inside where the
winding number of the triangles around it is above zero: bodies may overlap, walls inside of others
do not count, and neither does a gap along a ray that is narrower than `_SEAM`. The rays' interior
length gives the volume; their entries and exits give the outer surface. The inside of a cup is
outside. Only the part of the surface that a ball of radius `REACH` can touch from outside counts:
no finger reaches into a crack, or into a void between pieces. A body that every ray misses is
thinner than their distance: its volume is exact, and its surface is sampled.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, label
from scipy.spatial import cKDTree
from trimesh.triangles import mass_properties

from congrasp.common.objects import shapes

POINTS = 50_000
"""Most points of a surface whose distances from the other one are computed."""
MOST_SURFACE, MOST_VOLUME = 3e-3, 0.05
"""Errors that are small enough: m, and share of the volume."""
REACH = 2e-3
"""Radius of the ball, m."""
_RAYS = 256  # along the longest side of the box around both bodies
_FINE = 0.75  # of the ball's radius: side of a cube that tells voids from the outside
_SEAM = 4e-4  # m
_OVERLAP = 1e-3  # share of its volume that a mesh may count twice
_FACING = 0.5  # cosine; walls that face one another within `_SEAM` are a crack, too
_TOUCHES = 0.8  # of the ball's radius: samples are not where the ball is nearest
# Of the rays' spacing: corners at round numbers miss the rays
_OFF_GRID = np.array([0.1236068, 0.4142136, 0.7320508])


class Fidelity(NamedTuple):
    """Errors of an object's convex pieces relative to its mesh."""

    volume: float | None
    """(Volume of the pieces' union - the mesh's) / the mesh's; None for an open mesh, which
    encloses no volume.
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
        return (
            f"{surface}, and their volume {abs(self.volume):.1%} too "
            f"{'large' if self.volume > 0 else 'small'}"
        )


def fidelity(mesh: np.ndarray, pieces: list[np.ndarray], closed: bool) -> Fidelity:
    """Compares the union of convex pieces with a mesh.

    Args:
      mesh: (F, 3, 3) corners of its triangles, m; they wind outwards where it is closed.
      pieces: (V, 3) vertices of each piece, in the same frame.
      closed: True if the mesh encloses a volume; otherwise all of it counts as surface.
    """
    union = np.concatenate([np.asarray(shapes.triangulate(piece).triangles) for piece in pieces])
    low, spacing = _grid(np.concatenate([mesh, union]))
    volume, surface = _cut(union, low, spacing)
    if closed:
        wanted, wanted_surface = _cut(mesh, low, spacing)
    else:
        wanted, wanted_surface = 0.0, _sampled(mesh)
    if closed and not (volume and wanted):
        volume, wanted = (
            float(mass_properties(triangles)["volume"]) for triangles in (union, mesh)
        )
    distance = max(_farthest(surface, wanted_surface), _farthest(wanted_surface, surface))
    return Fidelity(volume / wanted - 1 if closed else None, distance)


class _Surface(NamedTuple):
    """Points of a surface (N, 3), m, outward unit normals (N, 3) there, which (N,) are in no seam,
    which in no void.
    """

    points: np.ndarray
    normals: np.ndarray
    outer: np.ndarray
    reached: np.ndarray


def _sampled(triangles: np.ndarray) -> _Surface:
    """Random points of triangles (F, 3, 3)."""
    points, normals, _ = shapes.on_triangles(triangles, _random().random((2 * POINTS, 3)))
    return _Surface(points, normals, *np.ones((2, len(points)), bool))


def _random() -> np.random.Generator:
    """The same numbers for every object."""
    return np.random.default_rng(0)


def _farthest(surface: _Surface, other: _Surface) -> float:
    """The largest distance of a point of a surface that the ball can touch from the other surface,
    m.
    """
    # Sorted: neighbouring points are then neighbours in the tree and in memory.
    some = np.sort(_random().permutation(np.flatnonzero(surface.outer & surface.reached))[:POINTS])
    points, normals = surface.points[some], surface.normals[some]
    tree = cKDTree(surface.points)
    distance, near = tree.query(points, k=8, distance_upper_bound=_SEAM)
    facing = np.einsum(
        "nkj,nj->nk", surface.normals[np.minimum(near, len(surface.points) - 1)], normals
    )
    in_crack = (distance < _SEAM) & (facing < -_FACING)
    apart = np.isinf(tree.query(points + REACH * normals, distance_upper_bound=_TOUCHES * REACH)[0])
    touched = ~in_crack.any(-1) & apart
    return float(cKDTree(other.points[other.outer]).query(points[touched])[0].max(initial=0.0))


class _Rays(NamedTuple):
    """Crossings (N) of parallel rays with triangles."""

    axis: int
    """Axis of the rays, 0 to 2."""
    rays: np.ndarray
    """(N, 2) the ray of each crossing."""
    place: np.ndarray
    """(N,) where on the ray, in spacings."""
    points: np.ndarray
    """(N, 3) where in space, m."""
    normals: np.ndarray
    """(N, 3) unit normals of the triangles."""
    change: np.ndarray
    """(N,) of the winding number."""


def _rays(triangles: np.ndarray, low: np.ndarray, spacing: float) -> Iterator[_Rays]:
    """Yields the crossings of triangles (F, 3, 3) with rays along each axis, on a grid of this
    corner and spacing.
    """
    for axis in range(3):
        order = [(axis + 1) % 3, (axis + 2) % 3, axis]  # the rays run along the last of these
        shift = np.array([*_OFF_GRID[order[:2]], 0.0])
        rays, place, owner, normal = _crossings(
            (triangles[..., order] - low[order]) / spacing + shift
        )
        points, normals = np.empty((2, len(place), 3))
        points[:, order] = (np.column_stack([rays, place]) - shift) * spacing + low[order]
        normals[:, order] = normal[owner]
        yield _Rays(axis, rays, place, points, normals, -np.sign(normal[owner, 2]))


def _grid(triangles: np.ndarray) -> tuple[np.ndarray, float]:
    """Corner (3,) and spacing of the rays for triangles (F, 3, 3), m."""
    corners = triangles.reshape(-1, 3)
    return corners.min(0), float(np.ptp(corners, axis=0).max()) / _RAYS


def interior(triangles: np.ndarray, count: int) -> np.ndarray:
    """Evenly distributed points (`count`, 3) inside of the outward triangles (F, 3, 3) of a closed
    mesh.
    """
    low, spacing = _grid(triangles)
    spans = [
        (found.points, *_intervals(found, _SEAM / spacing))
        for found in _rays(triangles, low, spacing)
    ]
    start, end = (np.concatenate([span[0][span[side]] for span in spans]) for side in (1, 2))
    if not len(start):
        return shapes.on_triangles(triangles, _random().random((count, 3)))[0]
    along = np.cumsum(np.linalg.norm(end - start, axis=-1))
    wanted = (np.arange(count) + 0.5) / count * along[-1]
    chosen = np.searchsorted(along, wanted)
    share = (along[chosen] - wanted) / np.linalg.norm(end - start, axis=-1)[chosen]
    return end[chosen] - share[:, None] * (end - start)[chosen]


class Voxels(NamedTuple):
    """Cubes that tile the space in and around a closed mesh."""

    inside: np.ndarray
    """(X, Y, Z) bool; a wall thinner than a cube is a layer without holes, too."""
    low: np.ndarray
    """(3,) center of the first cube, m."""
    spacing: float
    """m."""

    def at(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Indices of the cubes around points (N, 3); those outside of the grid have the nearest
        cube.
        """
        nearest = np.rint((points - self.low) / self.spacing).astype(int)
        return tuple(np.clip(nearest, 0, np.array(self.inside.shape) - 1).T)


def voxels(triangles: np.ndarray, margin: float, count: int = 128) -> Voxels:
    """Cubes inside of the outward triangles (F, 3, 3) of a closed mesh, and outside up to a margin.

    Args:
      triangles: m.
      margin: m.
      count: cubes along the longest side.
    """
    corners = triangles.reshape(-1, 3)
    spacing = float(np.ptp(corners, axis=0).max()) / count
    edge = int(np.ceil(margin / spacing)) + 1
    low = corners.min(0) - edge * spacing
    shape = np.ceil(np.ptp(corners, axis=0) / spacing).astype(int) + 2 * edge + 2
    inside = np.zeros(shape, bool)
    for found in _rays(triangles, low, spacing):
        entries, exits, _ = _intervals(found, 0.0)
        start, end = (
            np.ceil(found.place[some] + _OFF_GRID[found.axis]).astype(int)
            for some in (entries, exits)
        )
        order = np.roll(range(3), 2 - found.axis)  # the rays' axis is the last
        steps = np.zeros(shape[order], np.int8)
        rows = found.rays[entries].T
        np.add.at(steps, (*rows, start), 1)
        np.add.at(steps, (*rows, np.maximum(end, start + 1)), -1)
        inside |= np.moveaxis(np.cumsum(steps, -1, dtype=np.int8) > 0, [0, 1, 2], order)
    cubes = Voxels(inside, low - _OFF_GRID * spacing, spacing)
    if not inside.any():
        inside[cubes.at(_sampled(triangles).points)] = True
    return cubes


class Enclosed(NamedTuple):
    """Measures of the space inside a closed mesh; bodies that overlap count once."""

    volume: float
    """m^3."""
    area: float
    """Of the outer surface, m^2; faces that touch are not part of it."""
    center: np.ndarray
    """(3,) m, centroid."""
    inertia: np.ndarray
    """(3, 3) m^5 about the centroid, at a density of 1."""
    overlaps: bool
    """True if bodies overlap: the other fields are then estimates, and exact otherwise."""


def enclosed(triangles: np.ndarray) -> Enclosed:
    """Measures the space inside the outward triangles (F, 3, 3) of a closed mesh, m.

    What lies in several of its bodies, by rays along each axis, is taken off the mesh's integrals.
    """
    exact = mass_properties(triangles, density=1.0)
    volume, center = float(exact["volume"]), np.asarray(exact["center_mass"])
    first, second = (
        volume * center,
        _second_moment(exact["inertia"]) + volume * np.outer(center, center),
    )
    crosses = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area, twice = float(np.linalg.norm(crosses, axis=-1).sum() / 2), 0.0
    low, spacing = _grid(triangles)
    for found in _rays(triangles, low, spacing):
        # Entries before exits in one place.
        along = np.lexsort(
            (-found.change, np.round(found.place, 4), found.rays[:, 1], found.rays[:, 0])
        )
        winding, points = np.cumsum(found.change[along]), found.points[along]
        # Up to the next crossing, it lies in two bodies or more
        start = np.flatnonzero(winding > 1.5)
        length = (points[start + 1] - points[start])[:, found.axis]
        weight = (winding[start] - 1) * length * spacing**2 / 3
        middle = (points[start] + points[start + 1]) / 2
        twice += weight.sum()
        first -= weight @ middle
        second -= (weight[:, None] * middle).T @ middle
        second[found.axis, found.axis] -= weight @ length**2 / 12
        # Rays along the axis k meet a patch in proportion to |n_k|: each crossing stands for 1 /
        # sum |n_k|.
        inner = np.minimum(winding, np.r_[0, winding[:-1]]) > 0.5
        area -= float((spacing**2 / np.abs(found.normals[along[inner]]).sum(-1)).sum())
    if twice < _OVERLAP * volume:
        return Enclosed(volume, area, center, np.asarray(exact["inertia"]), False)
    volume -= twice
    center = first / volume
    second -= volume * np.outer(center, center)
    return Enclosed(volume, area, center, np.trace(second) * np.eye(3) - second, True)


def _second_moment(inertia: np.ndarray) -> np.ndarray:
    """The integral (3, 3) of x x^T of a body with this inertia."""
    return np.trace(inertia) / 2 * np.eye(3) - inertia


def _cut(triangles: np.ndarray, low: np.ndarray, spacing: float) -> tuple[float, _Surface]:
    """Volume (m^3; the mean of three axes) and outer surface of what triangles (F, 3, 3)
    enclose.
    """
    volumes, surfaces = [], []
    for found in _rays(triangles, low, spacing):
        entries, exits, closed = _intervals(found, _SEAM / spacing)
        volumes.append((found.place[exits] - found.place[entries]).sum() * spacing**3)
        ends = np.concatenate([entries, exits, closed])
        surfaces.append(
            (found.points[ends], found.normals[ends], np.arange(len(ends)) < 2 * len(entries))
        )
    points, normals, outer = map(np.concatenate, zip(*surfaces, strict=True))
    if not len(points):
        return 0.0, _sampled(triangles)
    cubes = voxels(
        triangles,
        2 * REACH,
        min(_RAYS, int(np.ptp(triangles, axis=(0, 1)).max() / (_FINE * REACH)) + 1),
    )
    spaces, _ = label(distance_transform_edt(~cubes.inside, cubes.spacing) > _TOUCHES * REACH)
    free = binary_dilation(spaces == spaces[0, 0, 0], iterations=2, mask=~cubes.inside)
    return float(np.mean(volumes)), _Surface(
        points, normals, outer, free[cubes.at(points + REACH * normals)]
    )


def _crossings(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Intersections of rays through the integers of the first two axes, along the third, with
    triangles (F, 3, 3).

    Returns:
      (N, 2) the rays, (N,) places on them, (N,) the triangles, and (F, 3) unit normals of all
      triangles.
    """
    corners, normals = (
        triangles[:, 0],
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]),
    )
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    owner, row = _integers(triangles[:, :, 0].min(1), triangles[:, :, 0].max(1))
    start, end = triangles[owner], np.roll(triangles, -1, axis=1)[owner]
    crossed = (start[:, :, 0] <= row[:, None]) != (end[:, :, 0] <= row[:, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (row[:, None] - start[:, :, 0]) / (end[:, :, 0] - start[:, :, 0])
        side = start[:, :, 1] + share * (end[:, :, 1] - start[:, :, 1])
    span, column = _integers(
        np.where(crossed, side, np.inf).min(1), np.where(crossed, side, -np.inf).max(1)
    )
    owner, row = owner[span], row[span]
    upright = normals[owner, 2]
    rise = normals[owner, 0] * (row - corners[owner, 0]) + normals[owner, 1] * (
        column - corners[owner, 1]
    )
    seen = upright != 0
    place = corners[owner, 2][seen] - rise[seen] / upright[seen]
    return np.column_stack([row, column])[seen], place, owner[seen], normals


def _integers(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All integers k with low <= k < high for each of (N,) ranges: the range's index, and the
    integer.
    """
    first = np.ceil(low).astype(int)
    counts = np.maximum(np.ceil(high).astype(int) - first, 0)
    index = np.repeat(np.arange(len(low)), counts)
    return index, first[index] + np.arange(len(index)) - np.repeat(
        np.cumsum(counts) - counts, counts
    )


def _intervals(found: _Rays, seam: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The crossings (N,) where rays enter, those (N,) where they leave, and those (M,) at the ends
    of closed gaps.

    Args:
      found: crossings of rays.
      seam: gaps narrower than this, in spacings, are closed.
    """
    order = np.lexsort((found.place, found.rays[:, 1], found.rays[:, 0]))
    rays, place = found.rays[order], found.place[order]
    inside = np.cumsum(found.change[order]) > 0.5
    before = np.r_[False, inside[:-1]]
    entries, exits = np.flatnonzero(inside & ~before), np.flatnonzero(~inside & before)
    if not len(entries):  # the rays miss the body
        return entries, exits, entries
    same = (rays[entries[1:]] == rays[exits[:-1]]).all(-1)
    wide = ~same | (place[entries[1:]] - place[exits[:-1]] >= seam)
    closed = np.r_[entries[1:][~wide], exits[:-1][~wide]]
    return order[entries[np.r_[True, wide]]], order[exits[np.r_[wide, True]]], order[closed]
