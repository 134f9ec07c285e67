"""Validation of external input: names used as files, and files of bounded size."""

import json
import os
import pathlib
import re
import stat
from typing import Any, BinaryIO

from congrasp.common.errors import CongraspError

LONGEST_NAME = 100
"""Longest name of a file or folder, in characters."""
_NAME = re.compile(rf"\w[\w .+()-]{{0,{LONGEST_NAME - 1}}}")


def file_name(text: object, what: str) -> str:
    """Returns the text if it is a safe name for a file or folder.

    Args:
      text: a name from a file, a message or a user.
      what: the thing it names, for the error.

    Raises:
      CongraspError: it is empty or too long, begins with a dot, or holds a slash or another special character.
    """
    if isinstance(text, str) and _NAME.fullmatch(text):
        return text
    raise CongraspError(
        f"'{ascii(text)[1:61].rstrip(chr(39))}' cannot name {what}.",
        f"Use letters, digits, dots, hyphens and underscores, {LONGEST_NAME} at most.",
    )


def read_file(path: pathlib.Path, largest: int, remedy: str = "") -> bytes:
    """Returns the content of a regular file.

    Args:
      path: the file.
      largest: size limit in bytes.
      remedy: remedy for the error message.

    Raises:
      CongraspError: it cannot be read, is larger, or is not a regular file (a pipe would block).
    """
    try:
        with open_file(path, remedy) as file:
            size = os.fstat(file.fileno()).st_size
            if size > largest:
                raise CongraspError(f"{path} has {size} bytes; the limit is {largest}.", remedy)
            return file.read(size)
    except OSError as error:
        raise CongraspError(f"{path} cannot be read: {error.strerror}.", remedy) from None


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
    """Parses a JSON file; raises like `read_file`, and a CongraspError if it is not JSON or nested too deep."""
    return parse_json(read_file(path, largest, remedy), str(path), remedy)


def parse_json(text: bytes, what: str, remedy: str = "") -> Any:
    """Parses JSON text; raises a CongraspError if it is not JSON or nested too deep."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        raise CongraspError(f"{what} is not JSON.", remedy) from None
