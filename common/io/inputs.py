"""What comes from outside: names that become files, and files of bounded size."""

import json
import os
import pathlib
import re
import stat
from typing import Any, BinaryIO

from congrasp.common.errors import CongraspError

LONGEST_NAME = 100
"""Characters of a name that becomes a file or a folder."""
_NAME = re.compile(rf"\w[\w .+()-]{{0,{LONGEST_NAME - 1}}}")


def file_name(text: object, what: str) -> str:
    """The text itself, if it can be a file or a folder inside of another one and nowhere else.

    Args:
      text: what a file, a message or a user gives as a name.
      what: what it names, for the error.

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
    """All of a regular file.

    Args:
      path: the file.
      largest: bytes that it may have.
      remedy: what to do, for an error's text.

    Raises:
      CongraspError: it is larger, or no regular file (a pipe would never end).
      OSError: it cannot be read.
    """
    with open_file(path, remedy) as file:
        size = os.fstat(file.fileno()).st_size
        if size > largest:
            raise CongraspError(f"{path} has {size} bytes, more than the {largest} that are read.", remedy)
        return file.read(size)


def open_file(path: pathlib.Path, remedy: str = "") -> BinaryIO:
    """Opens a regular file for reading, without waiting; raises as `read_file` does."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    raise CongraspError(f"{path} is no regular file.", remedy)


def read_json(path: pathlib.Path, largest: int, remedy: str = "") -> Any:
    """What a JSON file holds; raises as `read_file` does, and a CongraspError if it is no JSON or nested too deep."""
    return parse_json(read_file(path, largest, remedy), str(path), remedy)


def parse_json(text: bytes, what: str, remedy: str = "") -> Any:
    """What JSON text holds; a CongraspError if it is no JSON or nested too deep."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        raise CongraspError(f"{what} is not JSON.", remedy) from None
