"""Reads NPZ files within limits: the declared size of an array is checked before memory is allocated."""

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
"""Default limit of the total size of a file's arrays, in bytes."""
MAX_ARRAYS = 1000
"""Default limit of the number of arrays."""
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
    """Reads the arrays of a file by name: numbers, booleans and texts.

    Args:
      path: the file.
      remedy: remedy for the error message.
      kind: expected kind of file, for the error message.
      largest: limit of the arrays' total size, bytes.
      most: limit of the number of arrays.
      pickled: returns arrays of objects as the bytes of their pickle; otherwise they are errors. Nothing is unpickled.

    Raises:
      CongraspError: the file is not an NPZ file, is damaged, or exceeds a limit.
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
        why = "it is not an NPZ file, or was cut"
    raise CongraspError(f"{path} cannot be read: it is not {kind} ({why}).", remedy)


def _check_members(members: list[zipfile.ZipInfo], largest: int, most: int) -> None:
    """Raises a ValueError if the members are not those of an NPZ file, are too many, or inflate to too many bytes."""
    if len(members) > most:
        raise ValueError(f"it has more than {most} arrays")
    if sum(member.file_size for member in members) > largest:
        raise ValueError(f"its arrays exceed {largest >> 20} MB")
    for member in members:
        if not member.filename.endswith(".npy") or member.compress_type not in _METHODS:
            raise ValueError("it holds something else than arrays")
    if len({member.filename for member in members}) < len(members):
        raise ValueError("it holds an array twice")


def _array(data: bytes, name: str, pickled: bool) -> Any:
    """Parses one array in NumPy's format."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = header(stream)
    rest = memoryview(data)[stream.tell() :]
    if dtype.hasobject and pickled:
        return bytes(rest)
    if dtype.kind not in _KINDS:
        raise ValueError(f"'{name[:60]}' has the type {str(dtype)[:40]}")
    if math.prod(shape) * dtype.itemsize != len(rest) or (not dtype.itemsize and math.prod(shape) > 1):
        raise ValueError(f"'{name[:60]}' has {len(rest)} bytes, which is not {dtype} times {shape}")
    return np.frombuffer(rest, dtype, count=math.prod(shape)).reshape(shape, order="F" if fortran else "C").copy("K")
