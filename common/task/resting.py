"""Resting pose of an object: the mean of a tracker's readings; imports neither NumPy nor JAX."""

from typing import Any

Array = Any


def resting_mean(
    xp: Any, mean: Array, count: Array, reading: Array, table: Array, settle: float
) -> tuple[Array, Array]:
    """Adds a reading to an object's mean pose while it rests on the table and no reading is far
    from the mean.

    Args:
      xp: numpy or jax.numpy.
      mean: (..., 7) position, m, and quaternion so far.
      count: (...) number of readings in the mean; 0 for good once the object has moved or the table
        is removed.
      reading: (..., 7) newest reading.
      table: (...) bool: the table is present.
      settle: largest distance of an included reading from the mean, m.

    Returns:
      The mean and the count with the newest reading.
    """
    away = reading[..., :3] - mean[..., :3]
    still = (count > 0) & table & (xp.sqrt((away * away).sum(-1)) <= settle)
    # A quaternion and its negative are one rotation.
    same_sign = (mean[..., 3:] * reading[..., 3:]).sum(-1)[..., None] >= 0.0
    turn = count[..., None] * mean[..., 3:] + xp.where(same_sign, 1.0, -1.0) * reading[..., 3:]
    length = xp.sqrt((turn * turn).sum(-1))[..., None]
    position = mean[..., :3] + away / (count[..., None] + 1)
    updated = xp.concatenate([position, turn / xp.maximum(length, 1e-9)], -1)
    return xp.where(still[..., None], updated, mean), xp.where(still, count + 1, 0)
