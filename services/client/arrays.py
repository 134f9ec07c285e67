"""Arrays of joints from untrusted values; needs only NumPy."""

from typing import Any

import numpy as np


def as_numbers(value: Any, size: int) -> np.ndarray:
    """(size,) float64; all NaN if `value` is no such array."""
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        return np.full(size, np.nan)
    return array if array.shape == (size,) else np.full(size, np.nan)


def bounded(values: np.ndarray, most: np.ndarray) -> np.ndarray:
    """(J,) values clipped to limits: those of fingers separately, those of the wrist's slides and
    hinges by norm.
    """
    clipped = np.clip(values, -most, most)
    for three in (slice(-6, -3), slice(-3, None)):
        length = np.linalg.norm(values[three])
        longest = most[three].min()
        if not length <= longest:
            # Rounding
            clipped[three] = np.clip(values[three] * (longest / length), -longest, longest)
    return clipped
