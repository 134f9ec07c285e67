"""NPZ files read within limits: what an array says of its size is checked before there is memory for it."""

import io
import math
import pathlib
import zipfile
import zlib
from typing import Any

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_file

MAX_BYTES = 512 << 20
"""Bytes that the arrays of a file may have together, unless the caller says otherwise."""
MAX_ARRAYS = 1000
"""Arrays of a file."""
_KINDS = "biufUS"
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_UNREADABLE = (ValueError, LookupError, RuntimeError, OverflowError, SyntaxError, TypeError, MemoryError)


def read_npz(
    path: pathlib.Path,
    remedy: str,
    *,
    kind: str = "an NPZ file",
    largest: int = MAX_BYTES,
    most: int = MAX_ARRAYS,
    pickled: bool = False,
) -> dict[str, Any]:
    """The arrays of a file by name: numbers, booleans and texts.

    Args:
      path: the file.
      remedy: what to do, for an error's text.
      kind: what the file should be, for the same.
      largest: bytes that all arrays together may have.
      most: arrays of the file.
      pickled: arrays of objects are the bytes of their pickle; refused without.

    Raises:
      CongraspError: it is no NPZ file, or damaged, or larger than that; this function unpickles nothing.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(read_file(path, largest, remedy))) as archive:
            members = archive.infolist()
            _check_members(members, largest, most)
            names = [member.filename.removesuffix(".npy") for member in members]
            return {name: _array(archive.read(f"{name}.npy"), name, pickled) for name in names}
    except OSError as error:
        raise CongraspError(f"{path} cannot be read: {error.strerror or error}.", remedy) from None
    except _UNREADABLE as error:
        why = " ".join(str(error).split())[:200]
    except (zipfile.BadZipFile, EOFError, zlib.error):
        why = "it is no NPZ file, or was cut"
    raise CongraspError(f"{path} cannot be read: it is not {kind} ({why}).", remedy)


def _check_members(members: list[zipfile.ZipInfo], largest: int, most: int) -> None:
    """A ValueError where the members are none of an NPZ file, or too many or too large once they are inflated."""
    if len(members) > most:
        raise ValueError(f"it has more than {most} arrays")
    if sum(member.file_size for member in members) > largest:
        raise ValueError(f"its arrays have more than {largest >> 20} MB")
    for member in members:
        if not member.filename.endswith(".npy") or member.compress_type not in _METHODS:
            raise ValueError("it holds something else than arrays")
    if len({member.filename for member in members}) < len(members):
        raise ValueError("it holds an array twice")


def _array(data: bytes, name: str, pickled: bool) -> Any:
    """One array of its bytes in NumPy's format."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = header(stream)
    rest = memoryview(data)[stream.tell() :]
    if dtype.hasobject and pickled:
        return bytes(rest)
    if dtype.kind not in _KINDS:
        raise ValueError(f"'{name[:60]}' is of the type {str(dtype)[:40]}")
    if math.prod(shape) * dtype.itemsize != len(rest) or (not dtype.itemsize and math.prod(shape) > 1):
        raise ValueError(f"'{name[:60]}' has {len(rest)} bytes, which is not {dtype} times {shape}")
    return np.frombuffer(rest, dtype, count=math.prod(shape)).reshape(shape, order="F" if fortran else "C").copy("K")
