"""What comes from outside: names that become files, and files of bounded size."""

import os
import pathlib
import re
import stat

from common.errors import CongraspError

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
    with open(path, "rb", opener=_without_waiting) as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise CongraspError(f"{path} is no regular file.", remedy)
        if found.st_size > largest:
            raise CongraspError(f"{path} has {found.st_size} bytes, more than the {largest} that are read.", remedy)
        return file.read(found.st_size)


def _without_waiting(path: str, flags: int) -> int:
    """Opens a file; a pipe without a writer does not block."""
    return os.open(path, flags | os.O_NONBLOCK)
