"""Arrays of files that say what they hold, checked against the very text that their readers see."""

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
    """Raises an error for the first array that is not what its meaning says.

    Args:
      arrays: by name.
      meanings: of those that must be there: a shape of letters and numbers, then words, `(T, 3) m, world`; the word
        "text" behind the shape or the word "bool" somewhere says that it holds no numbers.
      indices: names of those that hold whole numbers.
      largest: what no number may reach.
      sizes: what letters stand for; the others take the size of the first array that has them.

    Returns:
      The size of every letter.

    Raises:
      ValueError: an array is empty, or has another shape or type, or numbers that are not finite or too large.
      KeyError: there is no such array.
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
            raise ValueError(f"{name} has shape {array.shape}, where ({words}) is {tuple(wanted)}")
        kinds = "U" if ") text" in meaning else "b" if "bool" in meaning else "iu" if name in indices else "biuf"
        if array.dtype.kind not in kinds:
            raise ValueError(f"{name} is of the type {array.dtype}")
        if kinds == "biuf" and not (np.isfinite(array).all() and np.abs(array.astype(float)).max() < largest):
            raise ValueError(f"{name} holds numbers that are not finite, or absurdly large")
    return known
