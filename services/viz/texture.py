"""Texture of a painted mesh: an image for each triangle keeps the edges of colours sharp."""

from typing import NamedTuple

import numpy as np

from congrasp.common.objects.spec import Colours
from congrasp.services.appearance.surface_colours import colours_at
from congrasp.services.viz.kernels import linear

_FINEST_TEXEL_M = 0.0004
"""Least distance between two texels."""
_MOST_TEXELS = 240_000
"""Approximate limit of the texels of one mesh."""


class Texture(NamedTuple):
    """Images of C triangles, called charts, with T texels in all.

    The axes u and v of a chart lead from one corner of its triangle, along its two sides, to the
    other two. Rows of its image count along u, columns along v, and the first and last ones lie on
    the corners.
    """

    to_chart: np.ndarray
    """(C, 2, 4) float32, affine map from a point to u and v."""
    rows: np.ndarray
    """(C,) int32, at least 2."""
    columns: np.ndarray
    """(C,) int32, at least 2."""
    first: np.ndarray
    """(C,) int32, index of the first texel."""
    texels: np.ndarray
    """(T, 3) float32 linear reflectance."""

    def moved(self, turn: np.ndarray, position: np.ndarray) -> "Texture":
        """The texture of a mesh that is turned by a matrix (3, 3) and then moved by (3,)."""
        linear_part = self.to_chart[..., :3] @ turn.T
        offset = self.to_chart[..., 3] - linear_part @ position
        to_chart = np.concatenate([linear_part, offset[..., None]], axis=-1)
        return self._replace(to_chart=to_chart.astype(np.float32))


NO_TEXTURE = Texture(
    np.zeros((0, 2, 4), np.float32),
    np.zeros(0, np.int32),
    np.zeros(0, np.int32),
    np.zeros(0, np.int32),
    np.zeros((0, 3), np.float32),
)


def joined_textures(textures: list[Texture]) -> Texture:
    """The charts of all textures, one after the other."""
    starts = np.cumsum([0, *(len(texture.texels) for texture in textures)])
    first = [texture.first + start for texture, start in zip(textures, starts[:-1], strict=True)]
    return Texture(
        np.concatenate([texture.to_chart for texture in textures]),
        np.concatenate([texture.rows for texture in textures]),
        np.concatenate([texture.columns for texture in textures]),
        np.concatenate(first).astype(np.int32),
        np.concatenate([texture.texels for texture in textures]),
    )


def texture_of(corners: np.ndarray, paint: Colours) -> Texture:
    """The texture of triangles (C, 3, 3) whose colours are known at some points."""
    origin, first_side, second_side = _charts(corners)
    texel = _texel_size(corners)
    rows = _samples(first_side, texel)
    columns = _samples(second_side, texel)
    counts = rows * columns
    first = np.cumsum(counts) - counts
    chart = np.repeat(np.arange(len(corners)), counts)
    index = np.arange(len(chart)) - first[chart]
    u = (index // columns[chart]) / (rows[chart] - 1)
    v = (index % columns[chart]) / (columns[chart] - 1)
    is_near = u + v <= 1 + 1 / (rows[chart] - 1) + 1 / (columns[chart] - 1)
    points = origin[chart] + u[:, None] * first_side[chart] + v[:, None] * second_side[chart]
    texels = np.zeros((len(chart), 3), np.float32)
    texels[is_near] = linear(colours_at(points[is_near], paint) / 255)
    return Texture(
        _maps(origin, first_side, second_side),
        rows.astype(np.int32),
        columns.astype(np.int32),
        first.astype(np.int32),
        texels,
    )


def _charts(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins and both sides (C, 3) of charts, from the corner across from the longest side.

    So an image has as few texels as possible.
    """
    opposite = np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1)
    longest = np.linalg.norm(opposite, axis=-1).argmax(1)
    order = (longest[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(corners, order[..., None], axis=1)
    return turned[:, 0], turned[:, 1] - turned[:, 0], turned[:, 2] - turned[:, 0]


def _texel_size(corners: np.ndarray) -> float:
    """Distance between the texels of triangles (C, 3, 3), m."""
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    parallelograms = float(np.linalg.norm(np.cross(first, second), axis=-1).sum())
    return max(_FINEST_TEXEL_M, float(np.sqrt(parallelograms / _MOST_TEXELS)))


def _samples(sides: np.ndarray, texel: float) -> np.ndarray:
    """(C,) number of texels along sides (C, 3)."""
    lengths = np.linalg.norm(sides, axis=-1)
    return np.ceil(lengths / texel).astype(int).clip(1) + 1


def _maps(origin: np.ndarray, first_side: np.ndarray, second_side: np.ndarray) -> np.ndarray:
    """(C, 2, 4) float32, affine maps from points to u and v of charts."""
    sides = np.stack([first_side, second_side], axis=-1)  # (C, 3, 2)
    inverse = np.linalg.pinv(sides)
    offset = -np.einsum("cij,cj->ci", inverse, origin)
    return np.concatenate([inverse, offset[..., None]], axis=-1).astype(np.float32)
