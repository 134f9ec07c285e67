"""Validation of external input: names used as files, files of bounded size, and arrays against
their descriptions.

The declared size of an array in an NPZ file is checked before memory is allocated.
"""

import hashlib
import io
import json
import math
import os
import pathlib
import stat
import unicodedata
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, BinaryIO

import numpy as np

from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.io.spelling import folded

LONGEST_NAME = 100
"""Longest name of a file or folder, in characters."""
_LONGEST_BYTES = 200  # of a name in UTF-8; file systems take 255, with suffixes
MAX_BYTES = 512 << 20
"""Default limit of the total size of a file's arrays, in bytes."""
MAX_ARRAYS = 1000
"""Default limit of the number of arrays."""
_KINDS = "biufUS"
_JITTER = 0.1  # of a clock's median step, by which it may fall
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_UNREADABLE = (
    ValueError,
    LookupError,
    RuntimeError,
    OverflowError,
    SyntaxError,
    TypeError,
    MemoryError,
)


def file_name(text: object, what: str) -> str:
    """Returns the text if it is a safe name for a file or folder.

    Args:
      text: a name from a file, a message or a user.
      what: the thing it names, for the error.

    Raises:
      CongraspError: it is empty or too long, begins with a dot, or holds a slash or another special
        character.
    """
    if isinstance(text, str) and text and (text[0].isalnum() or text[0] == "_"):
        fits = len(text) <= LONGEST_NAME and len(text.encode(errors="replace")) <= _LONGEST_BYTES
        if fits and all(_is_letter(c) or c in "_ .+()-" for c in text):
            return text
    raise CongraspError(
        f"'{ascii(text)[1:61].rstrip(chr(39))}' cannot name {what}.",
        f"Use letters, digits, dots, hyphens and underscores, {LONGEST_NAME} at most.",
    )


def safe_name(text: str) -> str:
    """Returns a text as a `file_name`: letters of any script stay, other characters become
    underscores.

    A name that is too long is cut, and ends with eight hex digits of the whole. A text without
    letters becomes "object".
    """
    text = unicodedata.normalize("NFC", text)
    safe = "".join(c if _is_letter(c) or c in "._-" else "_" for c in text)
    while safe and not safe[0].isalnum():  # a mark may follow those that are left out
        safe = safe[1:]
    if len(safe) > LONGEST_NAME or len(safe.encode()) > _LONGEST_BYTES:
        digits = hashlib.sha256(text.encode(errors="replace")).hexdigest()[:8]
        safe = (
            safe[: LONGEST_NAME - 20].encode()[: _LONGEST_BYTES - 20].decode(errors="ignore")
            + f"-{digits}"
        )
    return safe or "object"


def numbers_in(text: str) -> np.ndarray:
    """(N,) the numbers of a user's text, separated by spaces or commas; none if a word is no finite
    number.
    """
    try:
        found = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        return np.zeros(0)
    return found if np.isfinite(found).all() else np.zeros(0)


def runs_back(times: np.ndarray) -> np.ndarray:
    """(T,) bool: where a clock (T,), in any unit, is earlier than before, by more than a tenth of
    its median step.
    """
    if len(times) < 2:
        return np.zeros(len(times), bool)
    return np.maximum.accumulate(times) - times > _JITTER * np.median(np.abs(np.diff(times)))


def distinct_names(names: Iterable[str], key: Callable[[str], str] = folded) -> list[str]:
    """Returns the names, with a number at each whose `key` repeats one's, such as mug-2.

    By default no two of them are one name on any file system.
    """
    names = list(names)
    taken, given = {key(name) for name in names}, list[str]()
    used = set[str]()
    for name in names:
        free, number = name, 2
        while key(free) in used or (free != name and key(free) in taken):
            free, number = f"{name}-{number}", number + 1
        used.add(key(free))
        given.append(free)
    return given


def _is_letter(c: str) -> bool:
    """True for a letter or digit of any script, or a mark that belongs to one."""
    return c.isalnum() or unicodedata.category(c).startswith("M")


def read_file(path: pathlib.Path, largest: int, remedy: str = "") -> bytes:
    """Returns the content of a regular file.

    Args:
      path: the file.
      largest: size limit in bytes.
      remedy: remedy for the error message.

    Raises:
      CongraspError: it cannot be read, is larger, or is not a regular file (a pipe would block).
    """
    with os_errors_as(f"{path} cannot be read", remedy), open_file(path, remedy) as file:
        size = os.fstat(file.fileno()).st_size
        if size > largest:
            raise CongraspError(f"{path} has {size} bytes; the limit is {largest}.", remedy)
        return file.read(size)


def open_file(path: pathlib.Path, remedy: str = "") -> BinaryIO:
    """Opens a regular file for reading without blocking.

    Raises:
      CongraspError: it is not a regular file.
      OSError: it cannot be opened.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    raise CongraspError(f"{path} is not a regular file.", remedy)


def read_json(path: pathlib.Path, largest: int, remedy: str = "") -> Any:
    """Parses a JSON file; raises like `read_file`, and a CongraspError if it is not JSON or nested
    too deep.
    """
    return parse_json(read_file(path, largest, remedy), str(path), remedy)


def parse_json(text: bytes, what: str, remedy: str = "") -> Any:
    """Parses JSON text; raises a CongraspError if it is not JSON or nested too deep."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        raise CongraspError(f"{what} is not JSON.", remedy) from None


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
            return {name: _array(archive.read(f"{name}.npy"), name, pickled) for name in names}
    except OSError as error:
        raise CongraspError(f"{path} cannot be read: {error.strerror or error}.", remedy) from None
    except _UNREADABLE as error:
        why = " ".join(str(error).split())[:200]
    except (zipfile.BadZipFile, EOFError, zlib.error):
        why = "it is not an NPZ file, or was cut"
    raise CongraspError(f"{path} cannot be read: it is not {kind} ({why}).", remedy)


def _check_members(members: list[zipfile.ZipInfo], largest: int, most: int) -> None:
    """Raises a ValueError if the members are not those of an NPZ file, are too many, or inflate to
    too many bytes.
    """
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
    header = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, fortran, dtype = header(stream)
    rest = memoryview(data)[stream.tell() :]
    if dtype.hasobject and pickled:
        return bytes(rest)
    if dtype.kind not in _KINDS:
        raise ValueError(f"'{name[:60]}' has the type {str(dtype)[:40]}")
    if math.prod(shape) * dtype.itemsize != len(rest) or (
        not dtype.itemsize and math.prod(shape) > 1
    ):
        raise ValueError(f"'{name[:60]}' has {len(rest)} bytes, which is not {dtype} times {shape}")
    return (
        np.frombuffer(rest, dtype, count=math.prod(shape))
        .reshape(shape, order="F" if fortran else "C")
        .copy("K")
    )


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
            raise ValueError(
                f"{name} has shape {array.shape}, but ({words}) requires {tuple(wanted)}"
            )
        kinds = (
            "U"
            if ") text" in meaning
            else "b"
            if "bool" in meaning
            else "iu"
            if name in indices
            else "biuf"
        )
        if array.dtype.kind not in kinds:
            raise ValueError(f"{name} has the type {array.dtype}")
        if kinds == "biuf" and not (
            np.isfinite(array).all() and np.abs(array.astype(float)).max() < largest
        ):
            raise ValueError(f"{name} holds numbers that are not finite or too large")
    return known
