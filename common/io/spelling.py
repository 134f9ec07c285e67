"""File names that a file system does not distinguish: upper and lower case, and forms of Unicode.

On such a system (macOS, Windows, SMB, FAT, a folder of ext4 with `casefold`) the name `Mug` opens
the file `mug`, and writing one destroys the other.
"""

import functools
import os
import pathlib
import secrets
import unicodedata
from collections.abc import Iterable

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


def check_distinct(folder: pathlib.Path, names: Iterable[str]) -> None:
    """Raises a CongraspError if two names would be one file in a folder.

    Args:
      folder: the folder, which need not exist yet.
      names: names of files or folders to be written there.
    """
    first: dict[str, str] = {}
    for name in names:
        other = first.setdefault(folded(name), name)
        if other != name and ignores_case(folder):
            raise _confused(name, other, folder)


def ignores_case(folder: pathlib.Path) -> bool:
    """True if a folder does not distinguish upper and lower case.

    It is tried with a temporary file in the folder, or in the nearest existing one above it. A
    folder without write permission counts as one that distinguishes them.
    """
    places = [folder, *folder.absolute().parents]
    existing = next((place for place in places if place.is_dir()), None)
    return existing is not None and _ignores_case(existing)


@functools.cache
def _ignores_case(folder: pathlib.Path) -> bool:
    """See `ignores_case`; the folder exists."""
    name = f".congrasp-case-{secrets.token_hex(8)}"
    probe = folder / name
    try:
        os.close(os.open(probe, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
    except OSError:
        return False
    try:
        return os.path.lexists(folder / name.upper())
    finally:
        probe.unlink(missing_ok=True)


def _confused(name: str, other: str, folder: pathlib.Path) -> CongraspError:
    """Error of two names that are one file."""
    return CongraspError(
        f"'{name}' and '{other}' are one name in {folder}, whose file system does not distinguish "
        f"upper and lower case.",
        "Rename one of them, or choose another folder.",
    )
