"""Checks of a command's files before its work: inputs that are missing, outputs that cannot be
written.
"""

import difflib
import inspect
import pathlib
import re
from collections.abc import Sequence
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import check_output

_INPUT_SUFFIXES = {
    ".obj",
    ".stl",
    ".ply",
    ".glb",
    ".npz",
    ".csv",
    ".bvh",
    ".mcap",
    ".safetensors",
    ".urdf",
    ".xml",
}
"""Suffixes of files that commands read."""
_OUTPUT_OPTIONS = ("--out", "--json", "--png", "--video", "--pictures", "--references")
"""Options for files and folders that a command writes, or creates if they are absent."""
_OUTPUT_PARAMETERS = ("out", "json", "png", "pictures", "video")
"""Parameters of commands with a file or a folder that they write."""
_SELECTION = re.compile(r":\w+$")
"""Suffix of an argument that selects a part of a file."""


def check_inputs(arguments: Sequence[str]) -> None:
    """Raises a CongraspError for a missing input file, before the slow imports.

    Args:
      arguments: words after the command's name; a word that does not begin with a dash belongs to
        the last option.
    """
    option = ""
    for argument in arguments:
        if argument.startswith("-"):
            option = argument
            continue
        _check_not_empty(argument, option)
        path = pathlib.Path(_SELECTION.sub("", argument))
        is_input = path.suffix.lower() in _INPUT_SUFFIXES and option not in _OUTPUT_OPTIONS
        if is_input and not _exists(path):
            raise _missing_input(path, option)


def _check_not_empty(argument: str, option: str) -> None:
    """Raises a CongraspError for an empty path, as of a shell variable that is not set."""
    is_path = not option or option in _OUTPUT_OPTIONS
    if is_path and not argument:
        raise CongraspError(f"{option or 'An argument'} is empty.", "Name a file or a folder.")


def _exists(path: pathlib.Path) -> bool:
    """Returns True if a path exists; raises an OSError for one that cannot be used."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def _missing_input(path: pathlib.Path, option: str) -> CongraspError:
    """Returns the error about a missing file, with the most similar name in its folder."""
    siblings = []
    if path.parent.is_dir():
        siblings = [sibling.name for sibling in path.parent.iterdir() if sibling.exists()]
    similar = difflib.get_close_matches(path.name, siblings, 1)
    remedy = "Check the path."
    if similar:
        remedy = f"Did you mean {path.parent / similar[0]}?"
    subject = f"{option}: there" if option else "There"
    return CongraspError(f"{subject} is no file {path}.", remedy)


def check_outputs(call: Any) -> None:
    """Raises a CongraspError for an output that cannot be written, or a picture of another format,
    before the work.

    A command that requires --out or computes its default checks it itself.

    Args:
      call: the command with its arguments bound, a `functools.partial`.
    """
    for name, path in call.keywords.items():
        if name not in _OUTPUT_PARAMETERS or not isinstance(path, pathlib.Path):
            continue
        default = inspect.signature(call.args[0]).parameters[name].default
        if default is inspect.Parameter.empty:
            default = None
        if default or name != "out":
            check_output(f"--{name}", path, is_folder=_is_folder(name, default))
        _check_picture(name, path, default)


def _is_folder(name: str, default: pathlib.Path | None) -> bool:
    """Returns True if an output is a folder: its default has no suffix."""
    if default:
        return not default.suffix
    return name == "pictures"


def _check_picture(name: str, path: pathlib.Path, default: pathlib.Path | None) -> None:
    """Raises a CongraspError for a picture whose name ends in the suffix of another format."""
    is_png = name == "png" or (default and default.suffix == ".png")
    if is_png and path.suffix.lower() not in ("", ".png"):
        raise CongraspError(
            f"--{name} is {path}, but the picture is a PNG.", "End its name in .png."
        )
