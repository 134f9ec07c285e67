"""Errors that a user can act on: one line that names the input and the remedy."""

import contextlib
import importlib.util
import re
from collections.abc import Iterator

_LONGEST = 2000  # characters: a line may quote input from elsewhere
# Controls, line separators, lone surrogates, and marks that change the direction of the text around
# them.
_UNPRINTABLE = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)


def printable(text: str) -> str:
    """Returns a text as one line for a terminal: blanks for line ends, and escapes such as \\x1b
    for other controls.
    """
    return _UNPRINTABLE.sub(
        lambda found: " " if found[0] in "\t\n\r\u2028\u2029" else ascii(found[0])[1:-1], text
    )


class CongraspError(Exception):
    """Bad input or an environment error, described in one line.

    Attributes:
      fault: the sentence about what is wrong, without the remedy.
      exit_code: exit code of the command line for this error.
      code: kind of the error on the wire, alongside the message; empty where a program cannot
        handle the kind.
    """

    exit_code = 2
    code = ""

    def __init__(self, what: str, remedy: str = ""):
        self.fault = printable(what)
        text = printable(f"{what} {remedy}".strip())
        super().__init__(
            text if len(text) <= _LONGEST else f"{text[: _LONGEST - 400]} … {text[-300:]}"
        )


PORT_ERRORS = OSError, OverflowError
"""Errors of a port that is taken or out of range."""


@contextlib.contextmanager
def os_errors_as(
    what: str, remedy: str = "", kinds: type[Exception] | tuple[type[Exception], ...] = OSError
) -> Iterator[None]:
    """Raises an error of the system, such as a full disk, as a CongraspError with its reason."""
    try:
        yield
    except kinds as error:
        reason = str(getattr(error, "strerror", None) or error).rstrip(".")
        raise CongraspError(f"{what}: {reason}.", remedy) from None


_EXTRAS = {
    **dict.fromkeys(("foxglove", "jinja2", "matplotlib"), "viz"),
    **dict.fromkeys(("onnx", "pxr", "pyarrow", "pygltflib", "rosbags"), "export"),
    **dict.fromkeys(("daqp", "mink", "mujoco_menagerie", "qpsolvers"), "arm"),
    "gymnasium": "gym",
    "sapien": "physx",
    "wandb": "wandb",
    "warp": "cuda",
}


class MissingPackageError(CongraspError):
    """A package of one of the extras is not installed."""

    def __init__(self, what: str, package: str):
        """Creates the error.

        Args:
          what: the feature that needs the package.
          package: its import name.
        """
        extra = _EXTRAS.get(package, "train")
        super().__init__(
            f"{what} needs the package '{package}'.", f"Run: pip install 'congrasp[{extra}]'"
        )


def need_package(what: str, package: str) -> None:
    """Raises a `MissingPackageError` if a package that `what` needs is not installed; call it
    before the work.
    """
    if importlib.util.find_spec(package) is None:
        raise MissingPackageError(what, package)


class TooWideError(CongraspError):
    """The object is wider than the hand opens, wherever it can be approached."""

    def __init__(self, name: str, width: float, opening: float):
        """Creates the error.

        Args:
          name: name of the object.
          width: its smallest local width, m.
          opening: widest opening of the hand, m.
        """
        super().__init__(
            f"'{name}' is too wide: {100 * width:.1f} cm where the hand would close, but the hand "
            f"opens to "
            f"{100 * opening:.1f} cm.",
            "Scale the object, approach a narrower part, or use a larger hand.",
        )


class PhysicsError(CongraspError):
    """The simulation produced values that are not finite."""

    exit_code = 3


class TransportError(CongraspError):
    """A peer refused, or did not answer within its deadline."""

    exit_code = 4


class RefusedError(TransportError):
    """A peer, or a policy in this process, cannot serve the request."""


class OverloadedError(RefusedError):
    """Too many requests are waiting; raised at once, so that the caller can use the rest of its
    deadline.
    """

    code = "overloaded"


class LateError(RefusedError):
    """The request's deadline passed while it was queued."""

    code = "late"


class StartingError(RefusedError):
    """The server compiles its policy, and answers soon."""

    code = "starting"


class UnknownConstraintError(RefusedError):
    """The constraint does not exist, or the policy does not support it."""

    exit_code = CongraspError.exit_code
    code = "unknown_constraint"


class ContradictionError(RefusedError):
    """Two constraints exclude each other, and neither overrides the other."""

    exit_code = CongraspError.exit_code
    code = "contradiction"


class LayoutError(RefusedError):
    """A query has a layout other than the policy's."""

    code = "layout"


_BY_CODE = {
    error.code: error
    for error in (
        OverloadedError,
        LateError,
        StartingError,
        UnknownConstraintError,
        ContradictionError,
        LayoutError,
    )
}


def error_of(code: str, message: str) -> RefusedError:
    """Returns the exception for a peer's error: of the class of `code`, or else a
    `RefusedError`.
    """
    return _BY_CODE.get(code, RefusedError)(message)
