"""File names that a file system does not distinguish: upper and lower case, and forms of Unicode.

On such a system (macOS, Windows, SMB, FAT, a folder of ext4 with `casefold`) the name `Mug` opens
the file `mug`, and writing one destroys the other.
"""

import os
import pathlib
import unicodedata

from congrasp.common.errors import CongraspError


def folded(name: str) -> str:
    """Returns the form of a name that is equal for all names a file system may confuse with it."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFKD", name).casefold())


def check_spelling(path: pathlib.Path) -> None:
    """Raises a CongraspError if a path leads to a file whose name is written in another way.

    A name that no file has yet, and a folder that cannot be listed, pass.
    """
    if not os.path.lexists(path):
        return
    try:
        names = os.listdir(path.parent)
    except OSError:
        return
    if path.name in names:
        return
    alike = [name for name in names if folded(name) == folded(path.name)]
    if alike:
        raise _confused(path.name, alike[0], path.parent)


def _confused(name: str, other: str, folder: pathlib.Path) -> CongraspError:
    """Error of two names that are one file."""
    return CongraspError(
        f"'{name}' and '{other}' are one name in {folder}, whose file system does not distinguish "
        f"upper and lower case.",
        "Rename one of them, or choose another folder.",
    )
