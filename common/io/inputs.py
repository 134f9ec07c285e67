"""Input from users and peers: names used as files, and files of bounded size."""

import hashlib
import json
import os
import pathlib
import re
import stat
import unicodedata
from collections.abc import Callable, Iterable
from typing import Any, BinaryIO

from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.io.spelling import folded
from congrasp.common.runtime.platforms import BYTES, NO_WAIT

LONGEST_NAME = 100
"""Longest name of a file or folder, in characters."""
_MAX_NAME_BYTES = 200  # in UTF-8; file systems take 255, with suffixes
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?|.*\.", re.IGNORECASE)
"""Names of devices on Windows, and those whose last dot it drops."""
_DIGEST_CHARACTERS = 20  # left at the end of a cut name for the digits of its digest


def file_name(text: object, what: str) -> str:
    """Returns the text if it is a safe name for a file or folder.

    Args:
      text: a name from a file, a message or a user.
      what: the thing it names, for the error.

    Raises:
      CongraspError: it is empty or too long, begins or ends with a dot, holds a slash or another
        special character, or is the name of a device on Windows, such as `aux`.
    """
    if isinstance(text, str) and text and (text[0].isalnum() or text[0] == "_"):
        encoded = text.encode(errors="replace")
        fits = len(text) <= LONGEST_NAME and len(encoded) <= _MAX_NAME_BYTES
        is_plain = all(_is_letter(c) or c in "_ .+()-" for c in text)
        if fits and is_plain and _RESERVED.fullmatch(text):
            raise CongraspError(
                f"'{text}' cannot name {what} on Windows.",
                "Choose another name, without a dot at its end.",
            )
        if fits and is_plain:
            return text
    raise CongraspError(
        f"'{ascii(text)[1:61].rstrip(chr(39))}' cannot name {what}.",
        f"Use letters, digits, dots, hyphens and underscores, {LONGEST_NAME} at most.",
    )


def safe_name(text: str) -> str:
    """Returns a text as a `file_name`: letters of any script stay, other characters become
    underscores.

    A name that is too long is cut, and ends with eight hex digits of the whole. A text without
    letters becomes "object". One that Windows reserves gets an underscore at its end.
    """
    text = unicodedata.normalize("NFC", text)
    safe = "".join(c if _is_letter(c) or c in "._-" else "_" for c in text)
    while safe and not safe[0].isalnum():  # a mark may follow those that are left out
        safe = safe[1:]
    if len(safe) > LONGEST_NAME or len(safe.encode()) > _MAX_NAME_BYTES:
        digits = hashlib.sha256(text.encode(errors="replace")).hexdigest()[:8]
        beginning = safe[: LONGEST_NAME - _DIGEST_CHARACTERS].encode()
        beginning = beginning[: _MAX_NAME_BYTES - _DIGEST_CHARACTERS]
        safe = f"{beginning.decode(errors='ignore')}-{digits}"
    if _RESERVED.fullmatch(safe):
        stem, dot, ending = safe.partition(".")
        safe = f"{stem}_{dot}{ending}".rstrip(".")
    return safe or "object"


def distinct_names(names: Iterable[str], key: Callable[[str], str] = folded) -> list[str]:
    """Returns the names; each whose `key` repeats an earlier one's gets a number, such as mug-2.

    By default no two of the results are the same name on any file system.
    """
    names = list(names)
    reserved = {key(name) for name in names}
    used = set[str]()
    distinct = list[str]()
    for name in names:
        candidate = name
        number = 2
        while key(candidate) in used or (candidate != name and key(candidate) in reserved):
            candidate = f"{name}-{number}"
            number += 1
        used.add(key(candidate))
        distinct.append(candidate)
    return distinct


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
    descriptor = os.open(path, os.O_RDONLY | NO_WAIT | BYTES)
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
