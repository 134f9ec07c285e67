"""Which samples of a grid triangles cover, and what their corners' values come to there."""

from typing import NamedTuple

import numpy as np


class Spans(NamedTuple):
    """Samples that triangles cover, in S spans of rows of them, along which weights are linear."""

    face: np.ndarray
    """(S,) triangle of each span."""
    base: np.ndarray
    """(3, S) weights of the corners at its first sample."""
    slope: np.ndarray
    """(3, S) by how much they grow from sample to sample."""
    span: np.ndarray
    """(n,) of each sample."""
    step: np.ndarray
    """(n,) how many samples of the span are before it."""
    sample: np.ndarray
    """(n,) its number in the grid."""

    def total(self) -> np.ndarray:
        """(n,) sum of the weights, which is one before they are scaled."""
        return self.base.sum(0)[self.span] + self.slope.sum(0)[self.span] * self.step

    def weights(self, which: np.ndarray) -> np.ndarray:
        """(3, k) of some of the samples."""
        span = self.span[which]
        return self.base[:, span] + self.slope[:, span] * self.step[which]

    def scaled(self, factor: np.ndarray) -> "Spans":
        """With the weights times those (3, F) of the triangles' corners."""
        mine = factor.astype(np.float32)[:, self.face]
        return self._replace(base=self.base * mine, slope=self.slope * mine)


def spans(x: np.ndarray, y: np.ndarray, closed: np.ndarray, width: int, height: int) -> Spans:
    """Samples of a grid that triangles cover.

    Args:
      x: (3, F) corners in columns; triangles with a NaN cover nothing.
      y: (3, F) in rows, which count downwards.
      closed: (F,) bool: only what winds outwards and faces the viewer is wanted.
      width: columns.
      height: rows.
    """
    x, y = x.astype(float), y.astype(float)
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    # Rows count downwards: what winds outwards and faces the viewer has a negative area.
    face = np.flatnonzero((np.abs(area) > 1e-6) & ~(closed & (area > 0)))
    x, y, area = x[:, face], y[:, face], area[face]
    # Weights are linear over the grid: a x + b y + c, each zero on the side across from its corner.
    one, other = [1, 2, 0], [2, 0, 1]
    a, b = (y[one] - y[other]) / area, (x[other] - x[one]) / area
    c = (x[one] * y[other] - x[other] * y[one]) / area
    upper, lower = np.ceil(y.min(0)).clip(0), np.floor(y.max(0)).clip(max=height - 1)
    which, number = _expand(lower - upper + 1)
    row = upper[which] + number
    # In each of its rows a triangle covers one span.
    slope, offset = a[:, which], b[:, which] * row + c[:, which]
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = -offset / slope
    level = np.where(offset < 0, np.inf, -np.inf)
    low = np.where(slope > 0, bound, np.where(slope < 0, -np.inf, level)).max(0)
    left = np.ceil(low.clip(0, width))
    right = np.floor(np.where(slope < 0, bound, np.inf).min(0).clip(-1, width - 1))
    span, step = _expand(right - left + 1)
    start = (row * width + left).astype(np.int64)
    base = (offset + slope * left).astype(np.float32)
    return Spans(face[which], base, slope.astype(np.float32), span, step.astype(np.float32), start[span] + step)


def _expand(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For numbers (m,) of things that each row has: the row of each thing, and its number in the row."""
    counts = counts.clip(0).astype(np.int64)
    which = np.repeat(np.arange(len(counts)), counts)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
