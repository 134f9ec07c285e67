"""Objects on disk: one safetensors file each, and folders of them."""

import hashlib
import os
import pathlib

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import file_name, read_file
from congrasp.common.objects.object_checks import faults
from congrasp.common.objects.object_message import FORMAT, object_from_message, object_to_message
from congrasp.common.objects.spec import GraspObject
from congrasp.common.wire.codec import decode, encode

SUFFIX = ".safetensors"
MAX_BYTES = 64 << 20
"""Largest size of an object file in bytes."""


def digest(obj: GraspObject) -> str:
    """Returns sixteen hex digits that identify the object's content."""
    return hashlib.sha256(encode(object_to_message(obj))).hexdigest()[:16]


def save(obj: GraspObject, path: str | os.PathLike[str]) -> None:
    """Writes an object atomically.

    Raises:
      CongraspError: the file cannot be written.
    """
    write_atomically(pathlib.Path(path), encode(object_to_message(obj)))


def load(path: str | os.PathLike[str]) -> GraspObject:
    """Reads an object. Its arrays are read-only.

    Raises:
      CongraspError: the file is missing, of another kind, damaged, or has implausible values
        (`objects.object_checks.faults`).
    """
    path = pathlib.Path(path)
    remedy = "Run 'congrasp objects import' or 'congrasp objects generate' again."
    if not path.exists():
        raise CongraspError(
            f"There is no object file {path}.",
            "'congrasp objects list' shows the content of a folder.",
        )
    data = read_file(path, MAX_BYTES, remedy)
    try:
        message = decode(data)
    except CongraspError as error:
        raise CongraspError(f"{path} cannot be read as an object: {error}", remedy) from None
    if message.meta.get("kind") != "object" or message.meta.get("format") != FORMAT:
        raise CongraspError(f"{path} is not an object of this version of congrasp.", remedy)
    try:
        obj = object_from_message(message)
    except (KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
        raise CongraspError(f"{path} lacks an array or a field: {error}.", remedy) from None
    for fault in faults(obj):
        raise CongraspError(f"{path}: {fault}.", remedy)
    return obj


class Catalogue:
    """A folder of object files, `<name>.safetensors`."""

    def __init__(self, folder: str | os.PathLike[str]):
        self.folder = pathlib.Path(folder)

    def list(self) -> list[str]:
        """Names of the objects, sorted.

        Raises:
          CongraspError: the folder does not exist.
        """
        if not self.folder.is_dir():
            raise CongraspError(
                f"There is no folder {self.folder}.",
                "Make one with 'congrasp objects generate' or 'objects import'.",
            )
        return sorted(
            path.stem for path in self.folder.glob(f"*{SUFFIX}") if not path.name.startswith(".")
        )

    def get(self, name: str) -> GraspObject:
        """Returns the object of this name.

        Raises:
          CongraspError: there is no such object, or its file is damaged.
        """
        return load(self.path(name))

    def add(self, obj: GraspObject) -> pathlib.Path:
        """Stores an object under its name, replacing one of the same name; returns the file."""
        path = self.path(obj.name)
        save(obj, path)
        return path

    def path(self, name: str) -> pathlib.Path:
        """Returns the file of a name.

        Raises:
          CongraspError: the name cannot be a file name.
        """
        return self.folder / f"{file_name(name, 'an object')}{SUFFIX}"
