"""Files and folders that a run's configuration names, identified by their content.

A path means something else on another machine, and its content may change between two starts. The
configuration therefore holds absolute paths and a digest of each content. Actors and resumed
learners compare it with what they find.
"""

import dataclasses
import hashlib
import os
import pathlib
from collections.abc import Collection, Sequence
from typing import Any

from congrasp.common.config import NamedInput, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.files import hand_text
from congrasp.common.hands.mano import VARIABLE as MANO_VARIABLE
from congrasp.common.io.inputs import open_file
from congrasp.common.objects.store import SUFFIX as OBJECT_SUFFIX
from congrasp.common.policy.pretrained import named_policy
from congrasp.common.task.sampling.set_file import SUFFIX as SET_SUFFIX

OBJECTS = "objects"
CONSTRAINTS = "constraints"
TEACHER = "teacher"
HAND = "hand"
INITIAL = "initial"
KINDS = {
    OBJECTS: "the objects in",
    CONSTRAINTS: "the constraint sets in",
    TEACHER: "the teacher",
    HAND: "the hand file",
    INITIAL: "the initial policy",
}
"""Kinds of inputs, and the words that precede their paths."""
OF_ACTORS = (OBJECTS, CONSTRAINTS, HAND)
"""Kinds that actors read."""
OF_LEARNERS = (OBJECTS, CONSTRAINTS, HAND, TEACHER)
"""Kinds that a resumed run needs unchanged; the initial policy is copied to the run's folder."""
COPY = "Copy it from the learner's machine to {path} here."
"""Remedy for another machine."""
_DIGITS = 16
_CHUNK = 1 << 20


def identified(config: RunConfig, initial: pathlib.Path | None = None) -> RunConfig:
    """Returns the configuration with absolute paths and the content of all that it names.

    Args:
      config: a run whose paths are those of this process.
      initial: file of the initial policy, if there is one.

    Raises:
      CongraspError: a file or folder is missing or cannot be read.
    """
    config = with_absolute_paths(config)
    inputs = [named_input(kind, path) for kind, path in paths_of(config).items()]
    if initial is not None:
        inputs.append(named_input(INITIAL, initial))
    return dataclasses.replace(config, inputs=tuple(inputs))


def with_absolute_paths(config: RunConfig) -> RunConfig:
    """Returns the configuration with absolute paths of objects, constraint sets and teacher."""
    objects = dataclasses.replace(
        config.objects,
        folder=_absolute(config.objects.folder),
        constraints=_absolute(config.objects.constraints),
    )
    teacher = config.distill.teacher
    if teacher and pathlib.Path(teacher).exists():
        teacher = _absolute(teacher)
    distill = dataclasses.replace(config.distill, teacher=teacher)
    return dataclasses.replace(config, objects=objects, distill=distill)


def with_paths_of(config: RunConfig, other: RunConfig) -> RunConfig:
    """Returns the configuration with the paths of another one for the objects and sets that both
    name, for comparing the rest.
    """
    paths: dict[str, Any] = {}
    for name in ("folder", "constraints"):
        path = getattr(other.objects, name)
        if path and getattr(config.objects, name):
            paths[name] = path
    return dataclasses.replace(config, objects=dataclasses.replace(config.objects, **paths))


def paths_of(config: RunConfig) -> dict[str, pathlib.Path]:
    """Returns the files and folders that a configuration names, by their kinds.

    A hand's file is a part of the configuration's text, except for MANO's.
    """
    paths: dict[str, pathlib.Path] = {}
    if config.objects.folder:
        paths[OBJECTS] = pathlib.Path(config.objects.folder)
    if config.objects.constraints:
        paths[CONSTRAINTS] = pathlib.Path(config.objects.constraints)
    if config.distill.teacher:
        paths[TEACHER] = named_policy(config.distill.teacher)
    if config.task.hand.partition(":")[0] == "mano":
        paths[HAND] = mano_file()
    return paths


def named_input(kind: str, path: pathlib.Path) -> NamedInput:
    """Returns the record of a file or folder; raises a CongraspError if it cannot be read."""
    return NamedInput(kind, _absolute(str(path)), content_digest(kind, path))


def content_digest(kind: str, path: pathlib.Path) -> str:
    """Returns sixteen hex digits that identify the content of a file or folder.

    Of a folder, only the files of its kind count, with their names.

    Raises:
      CongraspError: it is missing or cannot be read.
    """
    if kind == HAND:
        return hashlib.sha256(hand_text(get_hand("mano")).encode()).hexdigest()[:_DIGITS]
    content = hashlib.sha256()
    for file in _files(kind, path):
        if file != path:
            content.update(f"{file.name}\n".encode())
        content.update(_sha256(file))
    return content.hexdigest()[:_DIGITS]


def check_inputs(inputs: Sequence[NamedInput], kinds: Collection[str], remedy: str) -> None:
    """Compares the content of files and folders with that named by a run's configuration.

    Args:
      inputs: those of the configuration.
      kinds: kinds to compare.
      remedy: remedy for the error message; `{path}` is the path.

    Raises:
      CongraspError: one of them is missing here, or has another content.
    """
    for each in inputs:
        if each.kind in kinds:
            check_input(each, pathlib.Path(each.path), remedy)


def check_input(expected: NamedInput, path: pathlib.Path, remedy: str) -> None:
    """Compares a file or folder with the record of a run's configuration; see `check_inputs`."""
    what = f"The run's configuration names {KINDS.get(expected.kind, 'a file')} {expected.path}"
    advice = remedy.format(path=expected.path)
    where = "" if str(path) == expected.path else f" at {path}"
    try:
        digest = content_digest(expected.kind, path)
    except CongraspError as error:
        reason = str(error)
        if expected.kind != HAND and not path.exists():
            reason = f"This machine has nothing{where or ' there'}."
        raise CongraspError(f"{what}. {reason}", advice) from None
    if digest != expected.digest:
        raise CongraspError(
            f"{what} with the content {expected.digest}, but the content here{where} is {digest}.",
            advice,
        )


def mano_file() -> pathlib.Path:
    """Path of the user's MANO file."""
    return pathlib.Path(os.environ.get(MANO_VARIABLE, ""))


def _files(kind: str, path: pathlib.Path) -> list[pathlib.Path]:
    """The file, or those of a folder that belong to its kind, by their names."""
    if not path.exists():
        raise CongraspError(f"There is no file or folder {path}.")
    if not path.is_dir():
        return [path]
    suffix = SET_SUFFIX if kind == CONSTRAINTS else OBJECT_SUFFIX
    files = sorted(path.glob(f"*{suffix}"))
    return [file for file in files if not file.name.startswith(".")]


def _sha256(path: pathlib.Path) -> bytes:
    """SHA-256 of a file; raises a CongraspError if it cannot be read."""
    content = hashlib.sha256()
    try:
        with open_file(path) as file:
            while chunk := file.read(_CHUNK):
                content.update(chunk)
    except OSError as error:
        raise CongraspError(f"{path} cannot be read: {error.strerror}.") from None
    return content.digest()


def _absolute(path: str) -> str:
    """An absolute path; empty for an empty one."""
    return os.path.abspath(path) if path else ""
