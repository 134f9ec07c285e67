"""Outward normals of a cloud of surface points, for surfaces that arrive without them.

Planes are fitted to the nearest neighbours of each point, as in Hoppe et al. 1992. Near an edge
such a plane cuts the corner; there that of a neighbour is taken if it fits much better.

A camera sees the outer side of each of its points. For the cloud of a whole object three cues vote
on the side:

* The field of equal charges at all points, which drives each charge out of the object.
* The mean height of a point above its neighbours, which is positive where the surface is convex.
* Its height above a paraboloid through its neighbours. Of a thin wall both sides are among these:
  the paraboloid lies between them.

Each point then counts the votes of the neighbours in its plane. With 256 points thin walls remain
uncertain: about one normal in eight of a bowl 3 mm thick points inward.
"""

import jax
import jax.numpy as jnp

from congrasp.common.task.types import Array

_PLANE_NEIGHBOURS = 6
"""Neighbours of a plane."""
_HEIGHT_NEIGHBOURS = 10
"""Neighbours of the mean height."""
_PARABOLOID_POINTS = 16
"""Points of the paraboloid: neighbours and the point itself."""
_BETTER_FIT = 25.0
"""Factor by which a neighbour's plane must fit better than a point's own."""
_CONVEX_WEIGHT = 3.0
"""Weight of the mean height, relative to that of the field."""
_PARABOLOID_WEIGHT = 20.0
"""Weight of the height above the paraboloid, relative to that of the field."""
_MAX_COPLANAR_SLOPE = 0.15
"""Largest height over distance of neighbours in one plane."""
_SMALL = 1e-9
"""Least divisor."""


@jax.jit
def estimated_normals(points: Array, eye: Array | None = None) -> Array:
    """Outward unit normals (B, N, 3) of clouds (B, N, 3).

    Repeated points count once. The result has no gradient.

    Args:
      points: points of the surface of an object, in any unit and frame.
      eye: (B, 3) positions of cameras toward which the normals point; None for clouds of whole
        objects.
    """
    points = jnp.asarray(points, jnp.float32)
    middle = jnp.mean(points, 1, keepdims=True)
    size = jnp.sqrt(jnp.mean(jnp.sum((points - middle) ** 2, -1), -1))[:, None, None]
    local = (points - middle) / jnp.maximum(size, _SMALL)
    if eye is None:
        normal = jax.vmap(_outward)(local)
    else:
        to_eye = (eye[:, None] - middle) / jnp.maximum(size, _SMALL) - local
        normal = jax.vmap(_plane_normals)(local)
        faces_away = jnp.sum(normal * to_eye, -1, keepdims=True) < 0.0
        normal = jnp.where(faces_away, -normal, normal)
    first = jnp.argmax(jnp.all(points[:, :, None] == points[:, None], -1), -1)
    return jnp.take_along_axis(normal, first[..., None], 1)


def _plane_normals(points: Array) -> Array:
    """Unit normals (N, 3) of planes through the neighbours of points (N, 3), on either side."""
    index, differs = _neighbours(points, _PLANE_NEIGHBOURS + 1)
    return _planes(points, index, differs)


def _neighbours(points: Array, count: int) -> tuple[Array, Array]:
    """Indices (N, count) of each point's nearest points, itself first, and (N, count) 1 where they
    differ, else 0.
    """
    squared = jnp.sum((points[:, None] - points) ** 2, -1)
    earlier = jnp.tri(len(points), k=-1, dtype=bool)
    repeated = jnp.any((squared == 0.0) & earlier, -1)
    # A point is its own nearest one, also if it repeats another.
    squared = jnp.where(repeated, jnp.inf, squared)
    squared = jnp.where(jnp.eye(len(points), dtype=bool), -1.0, squared)
    negative, index = jax.lax.top_k(-squared, min(count, len(points)))
    return index, (negative != 0.0) & jnp.isfinite(negative)


def _planes(points: Array, index: Array, differs: Array) -> Array:
    """Unit normals (N, 3) of planes, on either side, for neighbours (N, K) of points (N, 3)."""
    weight = differs[..., None].astype(jnp.float32)
    total = jnp.sum(weight, -2)
    middle = jnp.sum(weight * points[index], -2) / total
    offset = (points[index] - middle[:, None]) * weight
    spread = jnp.einsum("nki,nkj->nij", offset, offset, precision=jax.lax.Precision.HIGHEST)
    normal = _least_axis(spread)
    thickness = jnp.sum(jnp.sum(offset * normal[:, None], -1) ** 2, -1) / total[:, 0]
    above = jnp.sum((points[:, None] - middle[index]) * normal[index], -1)
    misfit = jnp.where(differs, thickness[index] + above**2, jnp.inf)
    best = jnp.argmin(misfit, -1)
    other = jnp.take_along_axis(index, best[:, None], -1)[:, 0]
    better = _BETTER_FIT * jnp.min(misfit, -1) < misfit[:, 0]
    return jnp.where(better[:, None], normal[other], normal)


def _least_axis(matrix: Array) -> Array:
    """Unit eigenvectors (..., 3) of the least eigenvalues of symmetric matrices (..., 3, 3), in
    closed form.

    Smith 1961, Eigenvalues of a symmetric 3 x 3 matrix; the eigenvector is the longest cross
    product of two rows of the matrix less the eigenvalue.
    """
    eye = jnp.eye(3)
    mean = jnp.trace(matrix, axis1=-2, axis2=-1)[..., None, None] / 3.0
    centred = matrix - mean * eye
    scale = jnp.sqrt(jnp.sum(centred**2, (-2, -1)) / 6.0)[..., None, None]
    unit = centred / jnp.maximum(scale, _SMALL)
    angle = jnp.arccos(jnp.clip(jnp.linalg.det(unit) / 2.0, -1.0, 1.0)) / 3.0
    least = 2.0 * jnp.cos(angle + 2.0 * jnp.pi / 3.0)
    rows = unit - least[..., None, None] * eye
    crossed = jnp.cross(rows, jnp.roll(rows, 1, -2))
    length = jnp.linalg.norm(crossed, axis=-1)
    longest = jnp.argmax(length, -1)[..., None, None]
    axis = jnp.take_along_axis(crossed, longest, -2)[..., 0, :]
    length = jnp.max(length, -1)[..., None]
    return jnp.where(length > 1e-6, axis / jnp.maximum(length, _SMALL), jnp.array((0.0, 0.0, 1.0)))


def _outward(points: Array) -> Array:
    """Outward unit normals (N, 3) of one object's cloud (N, 3) with a root mean square radius of
    1.
    """
    index, differs = _neighbours(points, _PARABOLOID_POINTS)
    in_plane = slice(_PLANE_NEIGHBOURS + 1)
    normal = _planes(points, index[:, in_plane], differs[:, in_plane])
    weight = differs.astype(jnp.float32)
    offset = points[index] - points[:, None]
    height = jnp.sum(offset * normal[:, None], -1)
    distance = jnp.linalg.norm(offset, axis=-1)
    near = slice(1, _HEIGHT_NEIGHBOURS + 1)
    mean_distance = jnp.maximum(jnp.sum((distance * weight)[:, near], -1), _SMALL)
    convex = -jnp.sum((height * weight)[:, near], -1) / mean_distance
    above_paraboloid = _above_paraboloid(normal, offset, height, weight)
    vote = _field(points, normal) + _CONVEX_WEIGHT * convex + _PARABOLOID_WEIGHT * above_paraboloid
    neighbour_height = jnp.sum(offset * normal[index], -1)
    rise = jnp.maximum(jnp.abs(height), jnp.abs(neighbour_height))
    coplanar = rise < _MAX_COPLANAR_SLOPE * distance
    agree = weight * coplanar * jnp.sum(normal[:, None] * normal[index], -1)
    vote = vote + jnp.sum(agree * jnp.clip(vote, -1.0, 1.0)[index], -1)
    return jnp.where(vote[:, None] < 0.0, -normal, normal)


def _field(points: Array, normal: Array) -> Array:
    """Cosines (N,) between normals and the field of equal charges at all points; softened near each
    charge.
    """
    offset = points[:, None] - points
    squared = jnp.sum(offset**2, -1)
    # A seventh of the points' distance on a sphere, squared
    soft = 4.0 * jnp.pi / len(points) / 50.0
    field = jnp.sum(offset / (squared + soft)[..., None] ** 1.5, 1)
    return jnp.sum(field * normal, -1) / jnp.maximum(jnp.linalg.norm(field, axis=-1), _SMALL)


def _above_paraboloid(normal: Array, offset: Array, height: Array, weight: Array) -> Array:
    """Heights (N,) of points above paraboloids a + b x + c y + d (x^2 + y^2) through neighbours,
    over their distance.

    Args:
      normal: (N, 3) unit normals.
      offset: (N, K, 3) from the points to the neighbours.
      height: (N, K) part of the offsets along the normals.
      weight: (N, K) of the neighbours.
    """
    along = jnp.cross(normal, jnp.eye(3)[jnp.argmin(jnp.abs(normal), -1)])
    along = along / jnp.linalg.norm(along, axis=-1, keepdims=True)
    across = jnp.cross(normal, along)
    x = jnp.sum(offset * along[:, None], -1)
    y = jnp.sum(offset * across[:, None], -1)
    squared_radius = x * x + y * y
    total_weight = jnp.sum(weight, -1, keepdims=True)
    scale = jnp.sqrt(jnp.sum(weight * squared_radius, -1, keepdims=True) / total_weight)
    scale = jnp.maximum(scale, _SMALL)
    basis = jnp.stack([jnp.ones_like(x), x / scale, y / scale, squared_radius / scale**2], -1)
    # Weighted least squares, by the normal equations with a ridge of 1e-4.
    highest = jax.lax.Precision.HIGHEST
    matrix = jnp.einsum("nki,nkj,nk->nij", basis, basis, weight, precision=highest)
    matrix = matrix + 1e-4 * jnp.eye(4)
    right_side = jnp.einsum("nki,nk->ni", basis, height * weight, precision=highest)
    coefficients = jnp.linalg.solve(matrix, right_side[..., None])
    return -coefficients[:, 0, 0] / scale[:, 0]
