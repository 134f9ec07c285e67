"""Geometry of convex pieces: volume, inertia, containment, support, surface samples and triangle
meshes.

Of a union of pieces: labelled points on its outer surface, and mass properties.
"""

import functools
from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull

from congrasp.common.objects.spec import SURFACE_POINTS, Piece
from congrasp.common.runtime.lazy_trimesh import trimesh
from congrasp.common.runtime.physics_library import mujoco

DENSE = 8192
"""Surface points from which `balanced` chooses."""
_SEGMENTS = 24
"""Sides of the triangle mesh of a round primitive."""
_SEAM = 2e-4
"""Step along its normal, in m, with which a point of the outer surface leaves all pieces."""
_REACHABLE = 4e-3
"""A mesh's surface counts as accessible if the collision pieces end within this distance, m."""
_MIN_REACHABLE_SHARE = 0.25
"""Share of accessible points below which all points of a mesh are used."""
_STRIDE = 1.1673039782614187 ** -np.arange(1.0, 5.0)
"""Steps (4,) of the low-discrepancy sequence: powers of the generalised golden ratio of four
dimensions, the positive root of x^5 = x + 1 (Roberts' R4 sequence)."""


def rotation(piece: Piece) -> np.ndarray:
    """Rotation (3, 3) from the piece's frame to the object frame."""
    return matrix(piece.quat)


def matrix(quat: Sequence[float] | np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a unit quaternion (w, x, y, z)."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, np.asarray(quat, np.float64))
    return flat.reshape(3, 3)


def hull_of(vertices: np.ndarray) -> ConvexHull:
    """Convex hull of points (V, 3); the `equations` of its facets point outwards. The last few
    hulls are cached.

    Raises:
      scipy.spatial.QhullError: the points lie in a plane.
    """
    return _hull(np.ascontiguousarray(vertices, np.float64).tobytes())


@functools.lru_cache(maxsize=32)
def _hull(data: bytes) -> ConvexHull:
    """The convex hull of points (n, 3), given as bytes of float64."""
    return ConvexHull(np.frombuffer(data).reshape(-1, 3))


def triangulate(vertices: np.ndarray) -> "trimesh.Trimesh":
    """Convex hull of points (V, 3) as a closed mesh with outward normals; it is cached and must not
    be modified.
    """
    return _triangulated(np.ascontiguousarray(vertices, np.float64).tobytes())


@functools.lru_cache(maxsize=32)
def _triangulated(data: bytes) -> "trimesh.Trimesh":
    """Mesh of the hull of points given as bytes of float64."""
    hull = _hull(data)
    vertices = hull.points
    faces = hull.simplices
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0
    faces = np.where(inward[:, None], faces[:, ::-1], faces)
    used, renumbered = np.unique(faces, return_inverse=True)
    return trimesh.Trimesh(vertices[used], renumbered.reshape(-1, 3), process=False)


def volume(piece: Piece) -> float:
    """Volume in cubic metres."""
    a, b, c = piece.size
    if piece.kind == "box":
        return 8 * a * b * c
    if piece.kind == "cylinder":
        return 2 * np.pi * a**2 * b
    if piece.kind == "capsule":
        return 2 * np.pi * a**2 * b + 4 / 3 * np.pi * a**3
    if piece.kind == "ellipsoid":
        return 4 / 3 * np.pi * a * b * c
    return float(hull_of(_vertices(piece)).volume)


def unit_inertia(piece: Piece) -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass (3,) and inertia (3, 3) about it for one kilogram of uniform density, in the
    object frame.
    """
    if piece.kind == "mesh":
        properties = triangulate(_vertices(piece)).mass_properties
        center = np.asarray(properties["center_mass"])
        inertia = np.asarray(properties["inertia"]) / properties["mass"]
    else:
        center = np.zeros(3)
        squares = _mean_squares(piece)
        inertia = np.diag(squares.sum() - squares)
    r = rotation(piece)
    return np.asarray(piece.pos) + r @ center, r @ inertia @ r.T


def _mean_squares(piece: Piece) -> np.ndarray:
    """Mean squares (3,) of the coordinates in a primitive piece, in its frame, m^2."""
    a, b, c = piece.size
    if piece.kind == "box":
        return np.array([a, b, c]) ** 2 / 3
    if piece.kind == "ellipsoid":
        return np.array([a, b, c]) ** 2 / 5
    if piece.kind == "cylinder":
        return np.array([a**2 / 4, a**2 / 4, b**2 / 3])
    # A cylinder and two half balls whose centres of mass are 3a/8 beyond its ends.
    cylinder = 2 * np.pi * a**2 * b
    ball = 4 / 3 * np.pi * a**3
    axial = cylinder * b**2 / 3 + ball * (a**2 / 5 + b**2 + 3 * a * b / 4)
    radial = cylinder * a**2 / 4 + ball * a**2 / 5
    return np.array([radial, radial, axial]) / (cylinder + ball)


def contains(piece: Piece, points: np.ndarray) -> np.ndarray:
    """Mask (N,) of the points (N, 3) of the object frame that lie inside the piece."""
    x = (points - np.asarray(piece.pos)) @ rotation(piece)
    a, b, c = piece.size
    if piece.kind == "box":
        return (np.abs(x) < [a, b, c]).all(-1)
    if piece.kind == "cylinder":
        return (np.hypot(x[:, 0], x[:, 1]) < a) & (np.abs(x[:, 2]) < b)
    if piece.kind == "capsule":
        x[:, 2] -= np.clip(x[:, 2], -b, b)
        return (x**2).sum(-1) < a**2
    if piece.kind == "ellipsoid":
        return ((x / [a, b, c]) ** 2).sum(-1) < 1
    equations = hull_of(_vertices(piece)).equations
    return (x @ equations[:, :3].T + equations[:, 3] < 0).all(-1)


def support(piece: Piece, directions: np.ndarray) -> np.ndarray:
    """Largest coordinate (D,) of the piece along unit directions (D, 3) of the object frame."""
    d = directions @ rotation(piece)
    a, b, c = piece.size
    if piece.kind == "box":
        reach = np.abs(d) @ np.array([a, b, c])
    elif piece.kind == "cylinder":
        reach = a * np.hypot(d[:, 0], d[:, 1]) + b * np.abs(d[:, 2])
    elif piece.kind == "capsule":
        reach = a + b * np.abs(d[:, 2])
    elif piece.kind == "ellipsoid":
        reach = np.linalg.norm(d * [a, b, c], axis=-1)
    else:
        reach = (d @ _vertices(piece).T).max(-1)
    return reach + directions @ np.asarray(piece.pos)


def proposal_area(piece: Piece) -> float:
    """Area from which `propose` draws; larger than the surface's area where `propose` rejects
    points.
    """
    a, b, c = piece.size
    if piece.kind == "box":
        return 8 * (a * b + b * c + c * a)
    if piece.kind == "cylinder":
        return 2 * np.pi * a * (a + 2 * b)
    if piece.kind == "capsule":
        return 4 * np.pi * a * (a + b)
    if piece.kind == "ellipsoid":
        return 4 * np.pi * a * b * c / min(a, b, c)
    return float(hull_of(_vertices(piece)).area)


def propose(piece: Piece, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples points uniformly on the piece's surface for `u` (N, 4) uniform in the unit cube.

    Returns:
      Points (N, 3) and outward unit normals (N, 3) in the object frame, and a mask (N,) of points
      to keep. It is True everywhere except for ellipsoids, where points are rejected to correct the
      area distortion of the map from the sphere.
    """
    a, b, c = piece.size
    keep = np.ones(len(u), bool)
    if piece.kind == "box":
        x, n = _propose_box(np.array([a, b, c]), u)
    elif piece.kind == "cylinder":
        x, n = _propose_cylinder(a, b, u)
    elif piece.kind == "capsule":
        x, n = _propose_capsule(a, b, u)
    elif piece.kind == "ellipsoid":
        unit = _sphere(u)
        radii = np.array([a, b, c])
        gradient = unit / radii
        stretch = np.linalg.norm(gradient, axis=-1)
        keep = u[:, 3] * (1 / radii.min()) < stretch
        x = unit * radii
        n = gradient / stretch[:, None]
    else:
        x, n, _ = on_triangles(np.asarray(triangulate(_vertices(piece)).triangles), u)
    r = rotation(piece)
    return x @ r.T + np.asarray(piece.pos), n @ r.T, keep


def on_triangles(triangles: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples points uniformly on triangles (F, 3, 3) for `u` (N, >= 3) uniform in the unit cube.

    Returns:
      Points (N, 3), unit normals (N, 3) by the right-hand rule, and indices (N,) of each point's
      triangle.
    """
    crosses = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    doubled = np.linalg.norm(crosses, axis=-1)
    edges = np.cumsum(doubled)
    face = np.searchsorted(edges, u[:, 0] * edges[-1], side="right").clip(max=len(edges) - 1)
    root = np.sqrt(u[:, 1])
    weights = np.stack([1 - root, root * (1 - u[:, 2]), root * u[:, 2]], -1)
    points = np.einsum("ni,nij->nj", weights, triangles[face])
    normals = crosses[face] / doubled[face, None]
    return points, normals, face


def tessellate(piece: Piece) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) on the surface in the object frame, and faces (F, 3) with outward normals."""
    a, b, c = piece.size
    if piece.kind == "mesh":
        mesh = triangulate(_vertices(piece))
        x = np.asarray(mesh.vertices)
        faces = np.asarray(mesh.faces)
    else:
        unit, faces = _template(piece.kind)
        if piece.kind == "capsule":
            x = unit * a + np.sign(unit[:, 2:]) * [0, 0, b]
        elif piece.kind == "cylinder":
            x = unit * [a, a, b]
        else:
            x = unit * [a, b, c]
    return x @ rotation(piece).T + np.asarray(piece.pos), faces


def mesh_of(pieces: Sequence[Piece]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32 and faces (F, 3) int32 of all pieces, concatenated, in the object
    frame.
    """
    all_vertices = []
    all_faces = []
    vertex_count = 0
    for piece in pieces:
        vertices, faces = tessellate(piece)
        all_vertices.append(vertices)
        all_faces.append(faces + vertex_count)
        vertex_count += len(vertices)
    vertices = np.concatenate(all_vertices).astype(np.float32)
    faces = np.concatenate(all_faces).astype(np.int32)
    return vertices, faces


@functools.cache
def _template(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a primitive of unit size."""
    if kind == "box":
        mesh = trimesh.creation.box((2, 2, 2))
    elif kind == "cylinder":
        mesh = trimesh.creation.cylinder(1.0, 2.0, sections=_SEGMENTS)
    else:
        # An even number of rings has none on the equator, where a capsule is cut in two.
        rings = 9 if kind == "capsule" else 10
        mesh = trimesh.creation.uv_sphere(1.0, count=(rings, _SEGMENTS // 2))
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _vertices(piece: Piece) -> np.ndarray:
    """Vertices (V, 3) of a mesh piece."""
    if piece.vertices is None:
        raise ValueError(f"a {piece.kind} piece has no vertices")
    return piece.vertices


def _sphere(u: np.ndarray) -> np.ndarray:
    """Points (n, 3) distributed evenly over the unit sphere, from random numbers (n, 2 or more)."""
    z = 2 * u[:, 0] - 1
    ring = np.sqrt(1 - z**2)
    turn = 2 * np.pi * u[:, 1]
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], -1)


def _propose_box(half: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (n, 3) on a box of half extents (3,)."""
    areas = np.prod(half) / half
    edges = np.cumsum(areas) / areas.sum()
    axis = np.searchsorted(edges[:2], u[:, 0], side="right")
    start = np.concatenate([[0.0], edges[:2]])[axis]
    side = np.where((u[:, 0] - start) / (edges[axis] - start) < 0.5, -1.0, 1.0)
    x = np.empty((len(u), 3))
    rows = np.arange(len(u))
    x[rows, axis] = side
    x[rows, (axis + 1) % 3] = 2 * u[:, 1] - 1
    x[rows, (axis + 2) % 3] = 2 * u[:, 2] - 1
    normals = np.zeros_like(x)
    normals[rows, axis] = side
    return x * half, normals


def _propose_cylinder(radius: float, half: float, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (n, 3) on a cylinder along z."""
    share = 2 * half / (2 * half + radius)
    turn = 2 * np.pi * u[:, 1]
    around = np.stack([np.cos(turn), np.sin(turn), np.zeros(len(u))], -1)
    on_side = u[:, 0] < share
    along = np.where(on_side, u[:, 0] / share, (u[:, 0] - share) / (1 - share))
    end = np.where(along < 0.5, -1.0, 1.0)[:, None] * [0.0, 0.0, 1.0]
    side = radius * around + (half * (2 * along - 1))[:, None] * [0.0, 0.0, 1.0]
    cap = (radius * np.sqrt(u[:, 2]))[:, None] * around + half * end
    return np.where(on_side[:, None], side, cap), np.where(on_side[:, None], around, end)


def _propose_capsule(radius: float, half: float, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (n, 3) on a capsule along z."""
    # The area of a sphere is uniform along its axis, like that of a cylinder: one coordinate covers
    # both.
    along = (2 * u[:, 0] - 1) * (radius + half)
    center = np.clip(along, -half, half)
    z = (along - center) / radius
    ring = np.sqrt(1 - z**2)
    turn = 2 * np.pi * u[:, 1]
    normals = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], -1)
    return radius * normals + center[:, None] * [0.0, 0.0, 1.0], normals


def sample_union(
    pieces: tuple[Piece, ...], rng: np.random.Generator, count: int = SURFACE_POINTS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples points evenly over the outer surface of the union of pieces.

    The points follow a low-discrepancy sequence with a random start, so that any prefix covers the
    surface evenly. Points of one piece inside another are dropped.

    Args:
      pieces: the convex pieces, in the object frame.
      rng: generator for the start of the sequence.
      count: number of points N.

    Returns:
      Points (N, 3) and outward unit normals (N, 3) in the object frame, and indices (N,) of each
      point's piece.
    """
    edges = np.cumsum([proposal_area(piece) for piece in pieces])
    starts = np.concatenate([[0.0], edges[:-1]])
    offset = rng.random(4)
    batches: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    total = 0
    drawn = 0
    while total < count:
        u = _sequence(offset, drawn, 2 * count)
        drawn += 2 * count
        area = u[:, 0] * edges[-1]
        owner = np.searchsorted(edges, area, side="right").clip(max=len(pieces) - 1)
        u[:, 0] = (area - starts[owner]) / (edges - starts)[owner]
        points = np.empty((len(u), 3))
        normals = np.empty((len(u), 3))
        keep = np.empty(len(u), bool)
        for i, piece in enumerate(pieces):
            is_owned = owner == i
            points[is_owned], normals[is_owned], keep[is_owned] = propose(piece, u[is_owned])
        outside = points + _SEAM * normals
        for i, piece in enumerate(pieces):
            keep &= (owner == i) | ~contains(piece, outside)
        batches.append((points[keep], normals[keep], owner[keep]))
        total += int(keep.sum())
    points, normals, owner = map(np.concatenate, zip(*batches, strict=True))
    return points[:count], normals[:count], owner[:count]


def sample_mesh(
    triangles: np.ndarray, pieces: tuple[Piece, ...], rng: np.random.Generator, *, oriented: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples points on the part of a mesh that a finger can reach.

    Points that lie more than a few millimetres below the surface of the collision pieces (inner
    walls, hollows filled by the pieces) are dropped, unless less than a quarter would remain.

    Args:
      triangles: (F, 3, 3) corners.
      pieces: collision pieces in the same frame.
      rng: generator for the start of the low-discrepancy sequence.
      oriented: True if all triangles have outward normals; otherwise, normals that point into the
        pieces while the other side is free are flipped.

    Returns:
      Points (N, 3), outward unit normals (N, 3), and indices (N,) of each point's triangle.
    """
    u = _sequence(rng.random(4), 0, 8 * SURFACE_POINTS)
    points, normals, face = on_triangles(triangles, u)
    is_covered_outside = _in_any(pieces, points + _REACHABLE * normals)
    is_covered_inside = _in_any(pieces, points - _REACHABLE * normals)
    if oriented:
        reachable = ~is_covered_outside
    else:
        reachable = ~(is_covered_outside & is_covered_inside)
        is_inverted = is_covered_outside & ~is_covered_inside
        normals = np.where(is_inverted[:, None], -normals, normals)
    if reachable.mean() < _MIN_REACHABLE_SHARE:
        reachable[:] = True
    chosen = np.flatnonzero(reachable)[:SURFACE_POINTS]
    return points[chosen], normals[chosen], face[chosen]


def _in_any(pieces: Sequence[Piece], points: np.ndarray) -> np.ndarray:
    """Mask (N,) of the points (N, 3) that lie inside at least one piece."""
    return np.any([contains(piece, points) for piece in pieces], axis=0)


def balanced(graspable: np.ndarray) -> np.ndarray:
    """Indices of `SURFACE_POINTS` surface points of which every other one lies in the graspable
    region.

    Evenly spread over the whole surface, too few of them are on a thin handle to tell its two
    sides.

    Args:
      graspable: (N,) bool, both values occur; any prefix of these points covers the surface evenly.
    """
    sides = [np.flatnonzero(graspable == side) for side in (True, False)]
    return np.stack([np.resize(side, SURFACE_POINTS // 2) for side in sides], -1).ravel()


def halves(points: np.ndarray, cut: float) -> np.ndarray:
    """Labels (N,) 0 and 1 of points (N, 3) on the two sides of a plane across their longest
    principal axis.

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


def mass_properties(
    pieces: tuple[Piece, ...], densities: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass (kg), centre of mass (3,) and inertia (3, 3) about it, in the frame of the pieces.

    The object is the sum of its pieces: densities add where pieces overlap.

    Args:
      pieces: the convex pieces.
      densities: (pieces,) kg/m^3.
    """
    masses = densities * [volume(piece) for piece in pieces]
    centers, unit_inertias = zip(*map(unit_inertia, pieces), strict=True)
    mass = float(masses.sum())
    center = masses @ np.array(centers) / mass
    offsets = np.array(centers) - center
    inertia = np.zeros((3, 3))
    for piece_mass, offset, unit in zip(masses, offsets, unit_inertias, strict=True):
        # The parallel axis theorem.
        inertia += piece_mass * (unit + (offset @ offset) * np.eye(3) - np.outer(offset, offset))
    return mass, center, inertia
