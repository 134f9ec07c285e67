"""Arrays of joints from untrusted values; needs only NumPy."""

from typing import Any

import numpy as np


def as_numbers(value: Any, size: int) -> np.ndarray:
    """Returns a value as an array (size,) float64; all NaN if it cannot be converted to one."""
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        return np.full(size, np.nan)
    if array.shape != (size,):
        return np.full(size, np.nan)
    return array


def bounded(values: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Returns values (J,) within limits (J,).

    Those of fingers are clipped separately. Those of the wrist's three slides are shortened
    together, so that their norm is within the least of their limits; likewise those of its three
    hinges.
    """
    clipped = np.clip(values, -limits, limits)
    for triple in (slice(-6, -3), slice(-3, None)):
        norm = np.linalg.norm(values[triple])
        limit = limits[triple].min()
        if not norm <= limit:  # also NaN
            # Clipped as well, since rounding may exceed the limit.
            clipped[triple] = np.clip(values[triple] * (limit / norm), -limit, limit)
    return clipped
