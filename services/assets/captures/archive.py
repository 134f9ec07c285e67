"""NPZ files whose arrays may hold values of any kind, read without unpickling them."""

import io
import pathlib
import zipfile
from typing import Any

import numpy as np

from common.errors import CongraspError
from common.pickles import parse_pickle


def read_archive(path: pathlib.Path) -> dict[str, Any]:
    """The file's arrays by name; what NumPy wrote as an object is that object.

    Raises:
      CongraspError: it is no NPZ file, or holds what is neither a plain value nor an array.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return {
                name.removesuffix(".npy"): _read(archive.read(name), f"{path}, '{name}'")
                for name in archive.namelist()
                if name.endswith(".npy")
            }
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise CongraspError(f"{path} cannot be read: {error}.", "Get the file again.") from None


def _read(data: bytes, name: str) -> Any:
    """One array of an archive from its bytes."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    _, _, dtype = header(stream)
    if not dtype.hasobject:
        return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    value = parse_pickle(data[stream.tell() :], name, mixed=True)
    return value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value
