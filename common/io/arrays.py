"""Arrays from users' files: NPZ files under limits, and checks against descriptions of arrays.

The declared size of an array in an NPZ file is checked before memory is allocated.
"""

import io
import math
import pathlib
import zipfile
import zlib
from collections.abc import Collection, Mapping
from typing import Any, Literal

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_file

MAX_BYTES = 512 << 20
"""Default limit of the total size of a file's arrays, in bytes."""
MAX_ARRAYS = 1000
"""Default limit of the number of arrays."""
_NPZ_KINDS = "biufUS"
"""Codes of NumPy's kinds of dtypes that an NPZ file may hold."""
_TEXT_KINDS = "U"
_BOOL_KINDS = "b"
_INDEX_KINDS = "iu"
_NUMBER_KINDS = "biuf"
_CLOCK_TOLERANCE = 0.1  # of a clock's median step, by which it may fall
_COMPRESSION_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_PARSE_ERRORS = (
    ValueError,
    LookupError,
    RuntimeError,
    OverflowError,
    SyntaxError,
    TypeError,
    MemoryError,
)


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
      pickled: returns arrays of objects as the bytes of their pickle; otherwise they are errors.
        Nothing is unpickled.

    Raises:
      CongraspError: the file is not an NPZ file, is damaged, or exceeds a limit.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(read_file(path, largest, remedy))) as archive:
            members = archive.infolist()
            _check_members(members, largest, most)
            names = [member.filename.removesuffix(".npy") for member in members]
            return {name: _parse_npy(archive.read(f"{name}.npy"), name, pickled) for name in names}
    except OSError as error:
        raise CongraspError(f"{path} cannot be read: {error.strerror or error}.", remedy) from None
    except _PARSE_ERRORS as error:
        reason = " ".join(str(error).split())[:200]
    except (zipfile.BadZipFile, EOFError, zlib.error):
        reason = "it is not an NPZ file, or was cut"
    raise CongraspError(f"{path} cannot be read: it is not {kind} ({reason}).", remedy)


def _check_members(members: list[zipfile.ZipInfo], largest: int, most: int) -> None:
    """Raises a ValueError if the members are not those of an NPZ file, are too many, or inflate to
    too many bytes.
    """
    if len(members) > most:
        raise ValueError(f"it has more than {most} arrays")
    if sum(member.file_size for member in members) > largest:
        raise ValueError(f"its arrays exceed {largest >> 20} MB")
    for member in members:
        is_array = member.filename.endswith(".npy")
        if not is_array or member.compress_type not in _COMPRESSION_METHODS:
            raise ValueError("it contains members that are not arrays")
    if len({member.filename for member in members}) < len(members):
        raise ValueError("it holds an array twice")


def _parse_npy(data: bytes, name: str, pickled: bool) -> Any:
    """Parses one array in NumPy's NPY format.

    Returns:
      A copy of the array; the bytes of its pickle for an array of objects, if `pickled`.

    Raises:
      ValueError: the type is not allowed, or the length differs from that of type times shape.
    """
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    else:
        shape, is_fortran, dtype = np.lib.format.read_array_header_2_0(stream)
    content = memoryview(data)[stream.tell() :]
    if dtype.hasobject and pickled:
        return bytes(content)
    if dtype.kind not in _NPZ_KINDS:
        raise ValueError(f"'{name[:60]}' has the type {str(dtype)[:40]}")
    count = math.prod(shape)
    is_unbounded = dtype.itemsize == 0 and count > 1
    if count * dtype.itemsize != len(content) or is_unbounded:
        raise ValueError(
            f"'{name[:60]}' has {len(content)} bytes, which is not {dtype} times {shape}"
        )
    array = np.frombuffer(content, dtype, count=count)
    order: Literal["F", "C"] = "F" if is_fortran else "C"
    return array.reshape(shape, order=order).copy("K")


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
      meanings: descriptions of the required arrays: a shape of letters and numbers, then words,
        such as `(T, 3) m, world`. The word "text" after the shape, or "bool" anywhere, marks an
        array without numbers.
      indices: names of integer arrays.
      largest: exclusive bound of the absolute values.
      sizes: known sizes by letter; any other letter takes the size of the first array that has it.

    Returns:
      Sizes by letter.

    Raises:
      ValueError: an array is empty, has the wrong shape or type, or holds numbers that are not
        finite or too large.
      KeyError: an array is missing.
    """
    sizes_by_letter = dict(sizes or {})
    for name, meaning in meanings.items():
        array = arrays[name]
        if not array.size:
            raise ValueError(f"{name} is empty")
        _check_shape(name, array, meaning[1 : meaning.index(")")], sizes_by_letter)
        kinds = _allowed_kinds(meaning, is_index=name in indices)
        if array.dtype.kind not in kinds:
            raise ValueError(f"{name} has the type {array.dtype}")
        if kinds == _NUMBER_KINDS and not _is_bounded(array, largest):
            raise ValueError(f"{name} holds numbers that are not finite or too large")
    return sizes_by_letter


def _check_shape(name: str, array: np.ndarray, rule: str, sizes: dict[str, int]) -> None:
    """Checks an array's shape, and adds the sizes of letters that occur for the first time.

    Args:
      name: name of the array, for the error.
      array: the array.
      rule: letters and numbers of its axes, separated by commas, such as `T, 3`.
      sizes: sizes by letter; changed in place.

    Raises:
      ValueError: the shape violates the rule.
    """
    letters = rule.replace(",", " ").split()
    if len(letters) == array.ndim:
        for letter, size in zip(letters, array.shape, strict=True):
            sizes.setdefault(letter, int(letter) if letter.isdigit() else size)
    required = tuple(sizes.get(letter) for letter in letters)
    if required != array.shape:
        raise ValueError(f"{name} has shape {array.shape}, but ({rule}) requires {required}")


def _allowed_kinds(meaning: str, *, is_index: bool) -> str:
    """Returns the codes of NumPy's kinds of dtypes that a description of an array admits."""
    if ") text" in meaning:
        return _TEXT_KINDS
    if "bool" in meaning:
        return _BOOL_KINDS
    if is_index:
        return _INDEX_KINDS
    return _NUMBER_KINDS


def _is_bounded(array: np.ndarray, largest: float) -> bool:
    """True if all numbers are finite and their absolute values below `largest`."""
    if not np.isfinite(array).all():
        return False
    return bool(np.abs(array.astype(float)).max() < largest)


def numbers_in(text: str) -> np.ndarray:
    """Parses a user's numbers, separated by spaces or commas.

    Returns:
      (N,) the numbers; none if a word is not a finite number.
    """
    words = text.replace(",", " ").split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        return np.zeros(0)
    return numbers if np.isfinite(numbers).all() else np.zeros(0)


def runs_back(times: np.ndarray) -> np.ndarray:
    """Marks the times (T,), in any unit, at which a clock is behind an earlier time by more than a
    tenth of its median step.

    Returns:
      (T,) bool.
    """
    if len(times) < 2:
        return np.zeros(len(times), bool)
    median_step = np.median(np.abs(np.diff(times)))
    setback = np.maximum.accumulate(times) - times
    return setback > _CLOCK_TOLERANCE * median_step
