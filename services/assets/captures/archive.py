"""NPZ files of data sets, whose arrays may hold dictionaries as pickles."""

import pathlib

import numpy as np

from congrasp.common.io.npz import read_npz
from congrasp.common.io.pickles import read_pickles


def read_archive(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Reads the arrays of a file by name; those of dictionaries are named as in `common.io.pickles.read_pickle`.

    Raises:
      CongraspError: it is not an NPZ file, exceeds the limits of `common.io.npz`, or holds anything but plain values
        and arrays.
    """
    arrays = read_npz(path, "Download the file again.", pickled=True)
    pickles = {name: arrays.pop(name) for name, value in list(arrays.items()) if isinstance(value, bytes)}
    found = read_pickles((f"{path}, '{name[:60]}'", data) for name, data in pickles.items())
    for name, inside in zip(pickles, found, strict=True):
        arrays |= {f"{name}/{key}".removesuffix("/"): array for key, array in inside.items()}
    return arrays
