"""Errors that a user can act on: one line that names the input and the remedy."""

import re

_LONGEST = 2000  # characters: a line may quote what somebody else wrote
_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")


class CongraspError(Exception):
    """Bad input or a broken surrounding, said in one line.

    Attributes:
      exit_code: what the command line returns to the shell for this error.
      code: names the kind on the wire, beside the sentence; empty where a program cannot do anything about the kind.
    """

    exit_code = 2
    code = ""

    def __init__(self, what: str, remedy: str = ""):
        text = _UNPRINTABLE.sub(" ", f"{what} {remedy}".strip())
        super().__init__(text if len(text) <= _LONGEST else f"{text[: _LONGEST - 400]} … {text[-300:]}")


_EXTRAS = {
    **dict.fromkeys(("foxglove", "imageio_ffmpeg", "jinja2", "matplotlib"), "viz"),
    **dict.fromkeys(("bvhio", "mcap_ros2", "onnx", "onnxruntime", "pxr", "pyarrow", "pygltflib", "rosbags"), "export"),
    **dict.fromkeys(("daqp", "mink", "mujoco_menagerie", "qpsolvers"), "arm"),
    "gymnasium": "gym",
    "wandb": "wandb",
    "warp": "cuda",
}


class MissingPackageError(CongraspError):
    """A package is absent that comes with one of the extras."""

    def __init__(self, what: str, package: str):
        """Args: what needs it, and its import name."""
        extra = _EXTRAS.get(package, "train")
        super().__init__(f"{what} needs the package '{package}'.", f"Run: pip install 'congrasp[{extra}]'")


class TooWideError(CongraspError):
    """The object is wider, wherever it can be approached, than the hand opens."""

    def __init__(self, name: str, width: float, opening: float):
        """Args: the object's name, its smallest local width and the hand's widest opening, m."""
        super().__init__(
            f"'{name}' is too wide: {100 * width:.1f} cm where the hand would close, which opens to "
            f"{100 * opening:.1f} cm.",
            "Scale the object, approach a narrower part, or take a larger hand.",
        )


class PhysicsError(CongraspError):
    """The simulation produced values that are not finite."""

    exit_code = 3


class TransportError(CongraspError):
    """A peer did not answer within its deadline, or refused."""

    exit_code = 4


class RefusedError(TransportError):
    """Whoever was asked, a peer or a policy in this process, cannot do what the request says."""


class OverloadedError(RefusedError):
    """Too many wait already; known at once, so that the caller can do something else within its deadline."""

    code = "overloaded"


class LateError(RefusedError):
    """The request's deadline passed while it waited."""

    code = "late"


class UnknownConstraintError(RefusedError):
    """There is no such constraint, or the policy does not know it."""

    exit_code = CongraspError.exit_code
    code = "unknown_constraint"


class ContradictionError(RefusedError):
    """Two constraints exclude each other, and neither overrides the other."""

    exit_code = CongraspError.exit_code
    code = "contradiction"


class LayoutError(RefusedError):
    """A packed query follows another layout than the policy's."""

    code = "layout"


_BY_CODE = {
    error.code: error for error in (OverloadedError, LateError, UnknownConstraintError, ContradictionError, LayoutError)
}


def error_of(code: str, message: str) -> RefusedError:
    """What a caller raises for an error of the one it asked: the class that the code names, else `RefusedError`."""
    return _BY_CODE.get(code, RefusedError)(message)
