"""NPZ files of data sets, whose arrays may hold dictionaries as pickles."""

import pathlib

import numpy as np

from congrasp.common.io.npz import read_npz
from congrasp.common.io.pickles import read_pickles


def read_archive(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Arrays of a file by name; those of dictionaries have the names of `common.io.pickles.read_pickle`.

    Raises:
      CongraspError: it is no NPZ file, larger than the limits of `common.io.npz`, or holds what is neither a plain
        value nor an array.
    """
    arrays = read_npz(path, "Get the file again.", pickled=True)
    pickles = {name: arrays.pop(name) for name, value in list(arrays.items()) if isinstance(value, bytes)}
    found = read_pickles((f"{path}, '{name[:60]}'", data) for name, data in pickles.items())
    for name, inside in zip(pickles, found, strict=True):
        arrays |= {f"{name}/{key}".removesuffix("/"): array for key, array in inside.items()}
    return arrays
