"""Self-describing arrays of files, checked against the descriptions shown to their readers."""

from collections.abc import Collection, Mapping

import numpy as np


def check_arrays(
    arrays: Mapping[str, np.ndarray],
    meanings: Mapping[str, str],
    *,
    indices: Collection[str],
    largest: float,
    sizes: Mapping[str, int] | None = None,
) -> dict[str, int]:
    """Checks arrays against their descriptions.

    Args:
      arrays: arrays by name.
      meanings: descriptions of the required arrays: a shape of letters and numbers, then words, such as `(T, 3) m,
        world`. The word "text" after the shape, or "bool" anywhere, marks an array without numbers.
      indices: names of integer arrays.
      largest: exclusive bound of the absolute values.
      sizes: known sizes by letter; any other letter takes the size of the first array that has it.

    Returns:
      Sizes by letter.

    Raises:
      ValueError: an array is empty, has the wrong shape or type, or holds numbers that are not finite or too large.
      KeyError: an array is missing.
    """
    known = dict(sizes or {})
    for name, meaning in meanings.items():
        array, words = arrays[name], meaning[1 : meaning.index(")")]
        letters = words.replace(",", " ").split()
        if not array.size:
            raise ValueError(f"{name} is empty")
        if len(letters) == array.ndim:
            for letter, size in zip(letters, array.shape, strict=True):
                known.setdefault(letter, int(letter) if letter.isdigit() else size)
        wanted = [known.get(letter) for letter in letters]
        if wanted != list(array.shape):
            raise ValueError(f"{name} has shape {array.shape}, but ({words}) requires {tuple(wanted)}")
        kinds = "U" if ") text" in meaning else "b" if "bool" in meaning else "iu" if name in indices else "biuf"
        if array.dtype.kind not in kinds:
            raise ValueError(f"{name} has the type {array.dtype}")
        if kinds == "biuf" and not (np.isfinite(array).all() and np.abs(array.astype(float)).max() < largest):
            raise ValueError(f"{name} holds numbers that are not finite or too large")
    return known
