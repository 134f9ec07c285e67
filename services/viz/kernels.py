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
def _interpolate(mesh: Mesh, face: int, column: int, row: int, here: np.ndarray) -> None:
    """Writes the values of a triangle at a sample into `here`, in perspective."""
    i, j, k = mesh.faces[face]
    first, second, third = _at(_weights(mesh.corners, i, j, k)[1], column, row)
    first *= mesh.nearness[i]
    second *= mesh.nearness[j]
    third *= mesh.nearness[k]
    depth = 1 / (first + second + third)
    for n in range(len(here)):
        total = first * mesh.values[i, n] + second * mesh.values[j, n] + third * mesh.values[k, n]
        here[n] = depth * total


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
    for row in range(owner.shape[0]):
        for column in range(owner.shape[1]):
            face = owner[row, column]
            if face == NOTHING:
                continue
            _interpolate(mesh, face, column, row, here)
            if mesh.chart[face] != NOTHING:
                _look_up(texture, mesh.chart[face], here)
            light, gloss = _light(here, eye, key)
            cover = alpha * here[_OPACITY]
            for n in range(3):
                reflected = np.float32(min(max(here[_COLOUR + n] * light + gloss, 0.0), 1.0))
                srgb = reflected ** np.float32(1 / GAMMA)
                image[row, column, n] = cover * srgb + (1 - cover) * image[row, column, n]


@_compiled
def add_light(
    points: np.ndarray,
    strength: np.ndarray,
    axes: np.ndarray,
    origin: np.ndarray,
    sample: float,
    top: np.ndarray,
    total: np.ndarray,
) -> None:
    """Adds the light of a distant lamp to points that no body shadows (a shadow map).

    The four samples of the lamp's picture around a point are compared with it and interpolated
    bilinearly, so that the edge of a shadow is one sample wide.

    Args:
      points: (n, 3).
      strength: (n,) light of the lamp without shadow.
      axes: (3, 3) rows: the lamp's right, up, and the direction towards it.
      origin: (3,) along these: of the first sample of the lamp's picture, and the bias added to a
        point's height.
      sample: size of a sample, m.
      top: (height, width) height of the body nearest to the lamp.
      total: (n,) light; changed in place.
    """
    for n in range(len(points)):
        x = min(max((_dot(axes[0], points[n]) - origin[0]) / sample, 0.0), top.shape[1] - 1.001)
        y = min(max((origin[1] - _dot(axes[1], points[n])) / sample, 0.0), top.shape[0] - 1.001)
        height = _dot(axes[2], points[n]) + origin[2]
        left = int(x)
        above = int(y)
        share = 0.0
        for j in range(2):
            for i in range(2):
                if top[above + j, left + i] <= height:
                    across = x - left if i else 1 - x + left
                    down = y - above if j else 1 - y + above
                    share += across * down
        total[n] += share * strength[n]


@_compiled
def _mean(image: np.ndarray, row: int, column: int, channel: int, samples: int) -> float:
    """Mean of a square of samples from a row and a column on."""
    total = 0.0
    for y in range(row, row + samples):
        for x in range(column, column + samples):
            total += image[y, x, channel]
    return total / samples**2


@_compiled
def averaged(image: np.ndarray, samples: int) -> np.ndarray:
    """(h, w, 3) uint8 of an image (h * samples, w * samples, 3) in [0, 1]."""
    height = image.shape[0] // samples
    width = image.shape[1] // samples
    picture = np.empty((height, width, 3), np.uint8)
    for row in range(height):
        for column in range(width):
            for channel in range(3):
                mean = _mean(image, row * samples, column * samples, channel, samples)
                picture[row, column, channel] = int(255 * min(max(mean, 0.0), 1.0) + 0.5)
    return picture
