"""Groups of objects in the test on unseen geometry: by size, mass and family."""

from collections.abc import Sequence

import numpy as np

_SIZES = ("small", "medium", "large")
_MASSES = ("light", "mid", "heavy")


def terciles(
    values: np.ndarray, names: Sequence[str], unit: str, factor: float
) -> tuple[np.ndarray, list[str]]:
    """Divides objects into three groups of equal size by a property (N,).

    Returns:
      Groups (N,) of the objects, 0 to 2, and labels of the groups with their bounds.
    """
    low, high = np.quantile(values, [1 / 3, 2 / 3]).tolist()
    labels = [
        f"{names[0]} (up to {factor * low:.3g} {unit})",
        f"{names[1]} ({factor * low:.3g} to {factor * high:.3g} {unit})",
        f"{names[2]} (above {factor * high:.3g} {unit})",
    ]
    return (values > low).astype(int) + (values > high), labels


def object_groups(
    sizes: np.ndarray, masses: np.ndarray, families: np.ndarray
) -> list[tuple[str, np.ndarray]]:
    """Labels and members (N,) bool of the groups of objects in the test on unseen geometry.

    The paper stratifies by size without giving bounds. The groups are terciles of the largest side
    (m), terciles of the mass (kg), and families.
    """
    groups = []
    for values, names, unit, factor in (
        (sizes, _SIZES, "cm", 100.0),
        (masses, _MASSES, "g", 1000.0),
    ):
        tercile, labels = terciles(values, names, unit, factor)
        groups += [(label, tercile == i) for i, label in enumerate(labels)]
    for family in np.unique(families):
        groups.append((f"family {family}", families == family))
    return groups
