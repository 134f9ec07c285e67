"""Reading of strangers' robot descriptions: in a confined process, with faults and remedies."""

import contextlib
import pathlib
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.common.runtime.confinement import Limits
from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.confined import EnvironmentFailure, call_confined

MEMORY = 3 << 30
"""Limit of the address space for reading a file, bytes."""
SECONDS = 30
"""Limit of the processor time for reading a file, s."""
MAX_FILE = 64 << 20
"""Limit of a file, bytes."""
_MAX_WALL_CLOCK_RATIO = 20
"""Wall-clock over processor time at which a child on a busy machine is ended as one that waits."""
_MAX_REASON_LENGTH = 400
_LISTED_FILES = 5
"""Missing files that a note names."""
_REMEDY = "MuJoCo must be able to load it."


class FaultyFile(ValueError):
    """A fault of a file, with its remedy."""


@contextlib.contextmanager
def confined(
    function: Callable[..., Any], path: pathlib.Path, options: dict[str, Any]
) -> Iterator[tuple[Any, pathlib.Path]]:
    """Calls a function of a module with a robot description, in a confined process.

    Args:
      function: called as function(folder, path, **options); writes arrays into the folder, and
        returns what JSON takes.
      path: the description.
      options: further arguments, as JSON takes them.

    Yields:
      The function's answer, and the folder.

    Raises:
      CongraspError: of the function; or the file is missing, takes more than `MEMORY` or `SECONDS`,
        or the process cannot run here.
    """
    if not path.is_file():
        raise CongraspError(f"There is no file {path}.", "Check the path.")
    if path.stat().st_size > MAX_FILE:
        raise CongraspError(
            f"{path} is larger than {MAX_FILE >> 20} MB.", "Pass the URDF or MJCF file of the hand."
        )
    patience = _MAX_WALL_CLOCK_RATIO * SECONDS
    with tempfile.TemporaryDirectory(prefix="congrasp-") as name:
        folder = pathlib.Path(name)
        try:
            answer = call_confined(
                function,
                folder,
                {"path": str(path), **options},
                Limits(memory=MEMORY, processor_s=SECONDS, patience_s=patience),
            )
        except TimeoutError:
            raise CongraspError(
                f"Reading {path} did not end within {patience:g} s.",
                "Try again on a less busy machine, with the file on a local disk.",
            ) from None
        except EnvironmentFailure as error:
            raise CongraspError(
                f"{path} cannot be read here: the process that reads it {error}.",
                "Remove that cause and try again.",
            ) from None
        except ChildProcessError as error:
            limits = f"the limits are {SECONDS} s and {MEMORY >> 30} GB"
            raise CongraspError(
                f"{path} cannot be read: reading it {error}; {limits}.", _REMEDY
            ) from None
        yield answer, folder


def reading_error(path: pathlib.Path, error: Exception) -> CongraspError:
    """Returns the error of a file that cannot be read, with a remedy where one is known.

    Args:
      path: the file.
      error: a `FaultyFile`, or an error of MuJoCo, which begins with its kind, and names the
        element in the second line.
    """
    lines = [line.strip().rstrip(".") for line in str(error).splitlines() if line.strip()]
    reason = re.sub(r"^(?:(?:XML )?Error: )+", "", ", ".join(lines)) or "MuJoCo gives no reason"
    if isinstance(error, FaultyFile):
        remedy = ""
    elif re.search("unknown exception|allocate memory|no reason", reason):  # exceptions of C++
        reason = (
            f"MuJoCo gives no reason; its meshes, pictures or height fields may need more than "
            f"{MEMORY >> 30} GB"
        )
        remedy = " Cut the hand out of the file, or name meshes of fewer triangles."
    else:
        remedy = f" {_remedy_of(reason)}"
    return CongraspError(f"{path} cannot be read: {reason[:_MAX_REASON_LENGTH]}.{remedy}")


def _remedy_of(reason: str) -> str:
    """Remedy for an error of MuJoCo."""
    version = mujoco.__version__
    if re.search("plugin (?:.+ not found|instance)|'plugin' nor", reason):
        return (
            f"Correct the plugin, or delete it and what uses it: MuJoCo {version} has only its own."
        )
    if "unknown default class" in reason:
        return "If another file includes this one, import that."
    if "unrecognized attribute" in reason or "unrecognized element" in reason:
        return f"MuJoCo {version} has none of that name: delete it."
    return _REMEDY


def listed(what: str, names: Sequence[str]) -> list[str]:
    """Returns a note on parts of a robot, if there are any of these names."""
    return [f"{what}: {', '.join(names)}"] if names else []


def missing_files(reason: str, files: list[str]) -> str:
    """Returns a note on files that are left out for a reason."""
    names = ", ".join(files[:_LISTED_FILES])
    if len(files) > _LISTED_FILES:
        names += f" and {len(files) - _LISTED_FILES} more"
    return f"{reason}, results without them are approximate: {names}"
