"""Compiled loops over triangles and over the samples of a picture, which Numba caches between
processes.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import numba
import numpy as np

from congrasp.common.io.files import cache_folder, can_cache

Function = TypeVar("Function", bound=Callable[..., Any])

GAMMA = 2.2
"""Exponent of sRGB, approximately: it is linear light to the power of 1 / GAMMA."""
NOTHING = -1
"""Index of samples without a triangle."""
_KEY_STRENGTH = 0.70
_SKY_STRENGTH = 0.50
_AMBIENT_STRENGTH = 0.05
_HIGHLIGHT_EXPONENT = 60
"""A larger exponent makes the highlight sharper."""
_ROUNDING = 1e-9
"""Tolerance of weights: a sample on an edge belongs to both sides."""
_SMALLEST_AREA = 1e-6
"""Area in samples below which a triangle covers nothing."""
_COLOUR = 6
_LIGHT = 9
_SKY = 10
_SHINE = 11
_OPACITY = 12
"""Columns of `Mesh.values`, after position and normal."""
_LIFT_SAMPLES = 1.5
"""Height above the surface at which its light is looked up, in samples of the shadow map."""
_LEAST_LIGHT = 1e-6
"""Prevents a division by zero where no lamp faces a surface."""


class Mesh(NamedTuple):
    """F projected triangles between V points."""

    corners: np.ndarray
    """(V, 2) columns and rows of points, in samples; rows count downwards."""
    nearness: np.ndarray
    """(V,) one over their depths."""
    faces: np.ndarray
    """(F, 3) the triangles."""
    values: np.ndarray
    """(V, 13) position, normal, linear colour, shares of key light and sky, strength of the
    highlight, opacity."""
    chart: np.ndarray
    """(F,) chart of a texture that replaces the colour, or `NOTHING`."""


class Bodies(NamedTuple):
    """F triangles between V points that cast shadows."""

    points: np.ndarray
    """(V, 3)."""
    faces: np.ndarray
    """(F, 3) the triangles."""
    closed: np.ndarray
    """(F,) bool, see `cover`."""


def linear(colour: np.ndarray) -> np.ndarray:
    """Converts sRGB from 0 to 1 to linear light, float32."""
    return (colour**GAMMA).astype(np.float32)


def _compiled(function: Function) -> Function:
    """Compiles a function; machine code is cached in the user's cache, unless that cannot be
    written.
    """
    folder = cache_folder("kernels")
    options: dict[str, Any] = {
        "nogil": True,
        "error_model": "numpy",
        "fastmath": {"contract", "arcp", "nsz", "afn", "reassoc"},
    }
    config: Any = numba.config
    previous = config.CACHE_DIR
    config.CACHE_DIR = str(folder)
    try:
        return numba.njit(cache=can_cache(folder.parent, "XDG_CACHE_HOME"), **options)(function)
    finally:
        config.CACHE_DIR = previous


_Weights = tuple[tuple[float, float, float], tuple[float, float, float]]


@_compiled
def _each(points: np.ndarray, i: int, j: int, k: int, axis: int) -> tuple[float, float, float]:
    """One coordinate of three points."""
    return points[i, axis], points[j, axis], points[k, axis]


@_compiled
def _weights(corners: np.ndarray, i: int, j: int, k: int) -> tuple[float, _Weights]:
    """Twice a triangle's signed area, and the weights of its first two corners as a x + b y + c.

    Weights are linear over the grid, each zero on the side across from its corner, and one in sum.
    """
    x0, x1, x2 = _each(corners, i, j, k, 0)
    y0, y1, y2 = _each(corners, i, j, k, 1)
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    first = (y1 - y2) / area, (x2 - x1) / area, (x1 * y2 - x2 * y1) / area
    second = (y2 - y0) / area, (x0 - x2) / area, (x2 * y0 - x0 * y2) / area
    return area, (first, second)


@_compiled
def _at(weights: _Weights, column: int, row: int) -> tuple[float, float, float]:
    """The weights of all three corners at a sample."""
    (a, b, c), (d, e, f) = weights
    first = a * column + b * row + c
    second = d * column + e * row + f
    return first, second, 1 - first - second


@_compiled
def cover(
    corners: np.ndarray,
    value: np.ndarray,
    faces: np.ndarray,
    closed: np.ndarray,
    top: np.ndarray,
    owner: np.ndarray,
) -> None:
    """Finds the triangle with the greatest value at each sample of a grid.

    Args:
      corners: (V, 2) columns and rows of points, in samples; rows count downwards.
      value: (V,) of the points, linear in between; a triangle with a NaN covers nothing.
      faces: (F, 3) the triangles.
      closed: (F,) bool, True for triangles that are drawn only if they face the viewer (closed
        surfaces).
      top: (height, width) greatest value so far; changed in place.
      owner: (height, width) the triangle that has it; changed in place.
    """
    height, width = top.shape
    for face in range(len(faces)):
        i, j, k = faces[face]
        area, weights = _weights(corners, i, j, k)
        # Rows count downwards, so that triangles of a closed surface that face the viewer have
        # negative areas.
        if (
            not abs(area) > _SMALLEST_AREA
            or (closed[face] and area > 0)
            or not np.isfinite(value[i] + value[j] + value[k])
        ):
            continue
        x0, x1, x2 = _each(corners, i, j, k, 0)
        y0, y1, y2 = _each(corners, i, j, k, 1)
        left = max(int(np.ceil(min(x0, x1, x2))), 0)
        right = min(int(np.floor(max(x0, x1, x2))), width - 1)
        upper = max(int(np.ceil(min(y0, y1, y2))), 0)
        lower = min(int(np.floor(max(y0, y1, y2))), height - 1)
        for row in range(upper, lower + 1):
            for column in range(left, right + 1):
                first, second, third = _at(weights, column, row)
                if min(first, second, third) >= -_ROUNDING:
                    here = first * value[i] + second * value[j] + third * value[k]
                    if here > top[row, column]:
                        top[row, column] = here
                        owner[row, column] = face


@_compiled
def _dot(a: Sequence[float] | np.ndarray, b: Sequence[float] | np.ndarray) -> float:
    """Dot product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_compiled
def _planes(mesh: Mesh, face: int, planes: np.ndarray) -> None:
    """Writes the coefficients of a triangle's n values over depth, and then of one over depth.

    Both are linear over the picture: a column + b row + c, with a, b and c the rows of `planes`
    (3, n + 1).
    """
    i, j, k = mesh.faces[face]
    near = mesh.nearness[i], mesh.nearness[j], mesh.nearness[k]
    first, second = _weights(mesh.corners, i, j, k)[1]
    for term in range(3):
        whole = 1.0 if term == 2 else 0.0
        at_i = near[0] * first[term]
        at_j = near[1] * second[term]
        at_k = near[2] * (whole - first[term] - second[term])
        planes[term, -1] = at_i + at_j + at_k
        for n in range(mesh.values.shape[1]):
            planes[term, n] = (
                at_i * mesh.values[i, n] + at_j * mesh.values[j, n] + at_k * mesh.values[k, n]
            )


@_compiled
def _interpolate(planes: np.ndarray, column: int, row: int, here: np.ndarray) -> None:
    """Writes the values of a triangle (`_planes`) at a sample into `here`, in perspective."""
    last = len(here)
    depth = 1 / (planes[0, last] * column + planes[1, last] * row + planes[2, last])
    for n in range(last):
        here[n] = depth * (planes[0, n] * column + planes[1, n] * row + planes[2, n])


@_compiled
def _look_up(texture: Any, chart: int, here: np.ndarray) -> None:
    """Replaces the colour at a position by that of a chart, bilinearly."""
    rows = texture.rows[chart]
    columns = texture.columns[chart]
    to_u = texture.to_chart[chart, 0]
    to_v = texture.to_chart[chart, 1]
    u = min(max(_dot(to_u, here) + to_u[3], 0.0), 1.0) * (rows - 1)
    v = min(max(_dot(to_v, here) + to_v[3], 0.0), 1.0) * (columns - 1)
    upper = min(int(u), rows - 2)
    left = min(int(v), columns - 2)
    down = u - upper
    right = v - left
    start = texture.first[chart] + upper * columns + left
    for n in range(3):
        above = (1 - right) * texture.texels[start, n] + right * texture.texels[start + 1, n]
        below = (1 - right) * texture.texels[start + columns, n] + right * texture.texels[
            start + columns + 1, n
        ]
        here[_COLOUR + n] = (1 - down) * above + down * below


@_compiled
def _light(here: np.ndarray, eye: np.ndarray, key: np.ndarray) -> tuple[float, float]:
    """Diffuse light and highlight of a sample with interpolated values."""
    # Tuples: a new array for each sample would take most of the time.
    ray = (here[0] - eye[0], here[1] - eye[1], here[2] - eye[2])
    normal = (here[3], here[4], here[5])
    distance = np.sqrt(_dot(ray, ray))
    length = np.sqrt(_dot(normal, normal)) + 1e-12
    half = (key[0] - ray[0] / distance, key[1] - ray[1] / distance, key[2] - ray[2] / distance)
    facing = max(_dot(normal, key) / length, 0.0)
    light = (
        _KEY_STRENGTH * here[_LIGHT] * facing
        + _SKY_STRENGTH * here[_SKY] * (0.6 + 0.4 * normal[2] / length)
        + _AMBIENT_STRENGTH
    )
    if here[_SHINE] == 0:
        return light, 0.0
    mirrored = max(_dot(normal, half) / length / np.sqrt(_dot(half, half)), 0.0)
    gloss = here[_SHINE] * here[_LIGHT] * mirrored**_HIGHLIGHT_EXPONENT
    return light, gloss


@_compiled
def shade(
    mesh: Mesh,
    texture: Any,
    owner: np.ndarray,
    eye: np.ndarray,
    key: np.ndarray,
    alpha: float,
    image: np.ndarray,
) -> None:
    """Shades the samples of a picture.

    The light is a key light with a highlight, the sky, and a little ambient light.

    Args:
      mesh: the triangles.
      texture: their `Texture`.
      owner: (height, width) the triangle that a sample shows, or `NOTHING`.
      eye: (3,) position of the camera.
      key: (3,) unit direction towards the key light.
      alpha: opacity over the image so far.
      image: (height, width, 3) sRGB; changed in place.
    """
    here = np.empty(mesh.values.shape[1])
    planes = np.empty((3, len(here) + 1))
    known = NOTHING
    for row in range(owner.shape[0]):
        for column in range(owner.shape[1]):
            face = owner[row, column]
            if face == NOTHING:
                continue
            if face != known:
                _planes(mesh, face, planes)
                known = face
            _interpolate(planes, column, row, here)
            if mesh.chart[face] != NOTHING:
                _look_up(texture, mesh.chart[face], here)
            light, gloss = _light(here, eye, key)
            cover = alpha * here[_OPACITY]
            for n in range(3):
                reflected = np.float32(min(max(here[_COLOUR + n] * light + gloss, 0.0), 1.0))
                srgb = reflected ** np.float32(1 / GAMMA)
                image[row, column, n] = cover * srgb + (1 - cover) * image[row, column, n]


@_compiled
def _lamp_picture(
    axes: np.ndarray, bodies: Bodies, top: np.ndarray, owner: np.ndarray
) -> tuple[float, float, float]:
    """Draws the heights of bodies as a distant lamp sees them (a shadow map).

    Args:
      axes: (3, 3) rows: the lamp's right, up, and the direction towards it.
      bodies: the bodies.
      top: (grid, grid) height of the body nearest to the lamp; overwritten.
      owner: (grid, grid) its triangle; overwritten.

    Returns:
      Place of the first sample along right and up, and the size of a sample, m.
    """
    # Loops: the functions of NumPy would take seconds to compile
    corners = np.empty((len(bodies.points), 2))
    height = np.empty(len(bodies.points))
    left = np.inf
    right = -np.inf
    lower = np.inf
    upper = -np.inf
    for n in range(len(bodies.points)):
        x = _dot(axes[0], bodies.points[n])
        y = _dot(axes[1], bodies.points[n])
        left = min(left, x)
        right = max(right, x)
        lower = min(lower, y)
        upper = max(upper, y)
        corners[n, 0] = x
        corners[n, 1] = y
        height[n] = _dot(axes[2], bodies.points[n])
    # One empty sample on each side, so that points beyond the map are lit.
    sample = max(right - left, upper - lower) / (len(top) - 3)
    left -= sample
    upper += sample
    for n in range(len(corners)):
        corners[n, 0] = (corners[n, 0] - left) / sample
        corners[n, 1] = (upper - corners[n, 1]) / sample
    for row in range(top.shape[0]):
        for column in range(top.shape[1]):
            top[row, column] = -np.inf
    cover(corners, height, bodies.faces, bodies.closed, top, owner)
    return left, upper, sample


@_compiled
def _unshadowed(top: np.ndarray, x: float, y: float, height: float) -> float:
    """Share of a lamp's light at a height and a place in its picture, in samples; one beyond it.

    The four samples around the place are compared with the height and interpolated bilinearly, so
    that the edge of a shadow is one sample wide.
    """
    if not (0 <= x < top.shape[1] - 1 and 0 <= y < top.shape[0] - 1):
        return 1.0
    left = int(x)
    above = int(y)
    share = 0.0
    for j in range(2):
        for i in range(2):
            if top[above + j, left + i] <= height:
                across = x - left if i else 1 - x + left
                down = y - above if j else 1 - y + above
                share += across * down
    return share


@_compiled
def light_of(
    lamps: np.ndarray,
    facing: tuple[float, float],
    points: np.ndarray,
    normals: np.ndarray,
    bodies: Bodies,
    grid: int,
) -> np.ndarray:
    """(n,) share of the light of distant lamps that reaches points past the bodies, from 0 to 1.

    Args:
      lamps: (L, 3, 3) rows of each: the lamp's right, up, and the direction towards it.
      facing: a and b of the strength a cos + b of a lamp's light, with the cosine between the
        surface's normal and the lamp; none if it is negative.
      points: (n, 3).
      normals: (n, 3) of the surfaces there.
      bodies: bodies that cast shadows.
      grid: samples along each side of a shadow map.
    """
    count = len(points)
    light = np.zeros(count)
    total = np.zeros(count)
    top = np.empty((grid, grid), np.float32)
    owner = np.empty((grid, grid), np.int32)
    for axes in lamps:
        left, upper, sample = _lamp_picture(axes, bodies, top, owner)
        lift = np.float32(_LIFT_SAMPLES * sample)
        for n in range(count):
            strength = facing[0] * _dot(axes[2], normals[n]) + facing[1]
            if strength <= 0:
                continue
            lifted = (
                points[n, 0] + lift * normals[n, 0],
                points[n, 1] + lift * normals[n, 1],
                points[n, 2] + lift * normals[n, 2],
            )
            x = (_dot(axes[0], lifted) - left) / sample
            y = (upper - _dot(axes[1], lifted)) / sample
            height = _dot(axes[2], lifted) + sample
            light[n] += strength * _unshadowed(top, x, y, height)
            total[n] += strength
    for n in range(count):
        light[n] /= max(total[n], _LEAST_LIGHT)
    return light


@_compiled
def repeated(image: np.ndarray, samples: int) -> np.ndarray:
    """(h * samples, w * samples, C) of an image (h, w, C): each pixel as a square of samples."""
    height, width, channels = image.shape
    finer = np.empty((height * samples, width * samples, channels), image.dtype)
    for row in range(height * samples):
        for column in range(width * samples):
            for channel in range(channels):
                finer[row, column, channel] = image[row // samples, column // samples, channel]
    return finer


@_compiled
def averaged(image: np.ndarray, samples: int) -> np.ndarray:
    """(h, w, 3) uint8 of an image (h * samples, w * samples, 3) in [0, 1]."""
    height = image.shape[0] // samples
    width = image.shape[1] // samples
    picture = np.empty((height, width, 3), np.uint8)
    share = 255 / (samples * samples)
    for row in range(height):
        for column in range(width):
            for channel in range(3):
                total = 0.0
                for y in range(samples * row, samples * (row + 1)):
                    for x in range(samples * column, samples * (column + 1)):
                        total += image[y, x, channel]
                picture[row, column, channel] = int(min(max(share * total, 0.0), 255.0) + 0.5)
    return picture
