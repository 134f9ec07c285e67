"""Errors that end a command with one line: of congrasp, the system, memory, and libraries."""

import errno
import re
from typing import NamedTuple

from congrasp.common.errors import CongraspError, MissingPackageError
from congrasp.services.cli.variables import variable_error

USAGE_ERROR = 2
"""Exit code for bad input."""
_DEVICE_ERROR = 1
"""Exit code if memory does not suffice: a run restarts its processes, because another program may
have held the memory."""
_FULL_DISK_NUMBERS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Numbers of the system for a full disk, quota or file."""
_PATH_ERRORS = (
    FileNotFoundError,
    NotADirectoryError,
    IsADirectoryError,
    PermissionError,
    FileExistsError,
)
_PATH_NUMBERS = (errno.EROFS, errno.ENAMETOOLONG, errno.ELOOP)
"""Numbers of further errors of a path, which have no class in Python."""
_MEMORY_REMEDY = (
    "Choose fewer --environments or a smaller --batch; on a GPU, XLA_PYTHON_CLIENT_MEM_FRACTION is "
    "JAX's share of it."
)
_NO_MEMORY = re.compile(
    r"(?:out[ _]of[ _]memory|failed to allocate (?:request for )?\d)[^[\n]*|RESOURCE_EXHAUSTED",
    re.IGNORECASE,
)
"""Messages of libraries about a device without enough memory."""
_NO_LIBRARY = re.compile(
    r"cannot open shared object|undefined symbol|version `\S+' not found|invalid ELF header"
    r"|wrong ELF class|cannot allocate memory in static TLS block|failed to map segment"
    r"|Library not loaded|DLL load failed"
)
"""Errors of the system's loader, which arrive as ImportError, or as OSError without a number."""


class Failure(NamedTuple):
    """An error that ends a command."""

    text: str
    """Cause and remedy, on one line."""
    exit_code: int


def failure_of(error: Exception) -> Failure | None:
    """Returns the line and the exit code of an error; None if the error is a bug."""
    if isinstance(error, CongraspError):
        return Failure(str(error), error.exit_code)
    if isinstance(error, ImportError | OSError) and _NO_LIBRARY.search(str(error)):
        return _usage_failure(_unloadable_text(error))
    if isinstance(error, OSError):
        return _usage_failure(_system_text(error))
    # Bases of the libraries' own types, which are not imported for this
    if isinstance(error, RuntimeError | ValueError | AssertionError):
        return _library_failure(error)
    if isinstance(error, ModuleNotFoundError):
        return _usage_failure(_missing_package_text(error))
    return None


def _usage_failure(text: str | None) -> Failure | None:
    """Returns a failure by the user's input; None without a text."""
    return None if text is None else Failure(text, USAGE_ERROR)


def _system_text(error: OSError) -> str | None:
    """Returns the line about a full or failed disk, or an unusable path; None for other errors."""
    if error.errno in _FULL_DISK_NUMBERS:
        file = error.filename or "A file"
        return f"{file} could not be written: {error.strerror}. Free space and start again."
    is_path_error = isinstance(error, _PATH_ERRORS) or error.errno in _PATH_NUMBERS
    if error.filename and is_path_error:
        cause = f"{error.filename} cannot be used: {error.strerror}."
        return str(CongraspError(cause, "Check the path and its permissions."))
    if error.errno == errno.ENOENT and "temporary directory" in str(error):
        return "There is no folder for temporary files that can be written. Set TMPDIR to one."
    if error.errno == errno.ENOENT and not error.filename:
        return "The working folder does not exist any more. Change to another."
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return f"{error.strerror}. Raise the limit ('ulimit -n 1024'), and start again."
    if error.errno == errno.EIO:
        return "A file could not be read or written, because its disk failed. Try another path."
    return None


def _unloadable_text(error: ImportError | OSError) -> str:
    """Returns the line about a library that the system cannot load."""
    reason = str(error).strip().splitlines()[0].rstrip(".")
    return str(
        CongraspError(
            f"A library cannot be loaded ({reason}).",
            "Install it with the system's packages, or install congrasp in a new environment.",
        )
    )


def _library_failure(error: Exception) -> Failure | None:
    """Returns the failure of a library by memory or an environment variable; None for others."""
    causes = [match[0].strip(". ") for match in _NO_MEMORY.finditer(str(error))]
    if causes:
        longest = max(causes, key=len)
        text = f"The device's memory does not suffice: {longest}. {_MEMORY_REMEDY}"
        return Failure(text, _DEVICE_ERROR)
    unusable = variable_error(error)
    if unusable is None:
        return None
    return Failure(str(unusable), USAGE_ERROR)


def _missing_package_text(error: ModuleNotFoundError) -> str | None:
    """Returns the line about a package that is not installed; None for a module of congrasp."""
    package = (error.name or "").partition(".")[0]
    if package == "congrasp":
        return None
    return str(MissingPackageError("This", package))
