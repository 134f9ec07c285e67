"""NPZ files of data sets, whose arrays may hold values of any kind; these are read without unpickling them."""

import pathlib
from typing import Any

import numpy as np

from congrasp.common.io.npz import read_npz
from congrasp.common.io.pickles import parse_pickle


def read_archive(path: pathlib.Path) -> dict[str, Any]:
    """The file's arrays by name; what NumPy wrote as an object is that object.

    Raises:
      CongraspError: it is no NPZ file, larger than the limits of `common.io.npz`, or holds what is neither a plain
        value nor an array.
    """
    return read_npz(path, "Get the file again.", objects=_value)


def _value(data: bytes, name: str) -> Any:
    """The object of an array's pickle."""
    value = parse_pickle(data, name, mixed=True)
    return value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value
