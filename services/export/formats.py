"""The formats of motions: their names, and the files that hold them."""

import importlib
import pathlib
import tempfile
from collections.abc import Sequence

from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.io.files import check_free
from congrasp.common.io.inputs import file_name
from congrasp.common.io.spelling import check_spelling
from congrasp.common.runtime import platforms

FORMATS = {"glb": ".glb", "usd": ".usda", "bvh": ".bvh", "ros2": "", "lerobot": ""}
"""Name and suffix of each format; `services.export.<name>` writes it. Those without a suffix are
folders.
"""
DATASETS = ("lerobot",)
"""Formats that hold several motions, and videos."""


def export_motions(
    motions: Sequence[Episode],
    kind: str,
    path: pathlib.Path,
    *,
    camera: bool = False,
    force: bool = False,
) -> None:
    """Writes motions in a format.

    Args:
      motions: one, or several if the format supports them; those of recordings normalised
        (`Episode.normalised`).
      kind: one of `FORMATS`.
      path: the file or folder to write.
      camera: also writes videos; only `DATASETS` have them.
      force: replaces an existing file; a folder is never replaced.

    Raises:
      CongraspError: `path` exists already, has another suffix or cannot be written, a motion has
        invalid poses, or the format cannot hold what was given.
    """
    _check_content(len(motions), kind, camera)
    _check_suffix(path, kind)
    if path.is_dir():
        raise CongraspError(
            f"The folder {path} exists already.", "Remove it or pass another with --out."
        )
    check_free(path, force=force)
    for motion in motions:
        motion.check_quaternions("The motion")
    module = importlib.import_module(f"congrasp.services.export.{kind}")
    options = {"camera": True} if camera else {}
    with os_errors_as(f"{path} cannot be written", "Pass another with --out."):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as temporary:
            folder = pathlib.Path(temporary)
            module.write(folder / path.name, motions, **options)
            _move_files(folder, path, force=force)


def _check_content(count: int, kind: str, camera: bool) -> None:
    """Raises a CongraspError for several motions, or videos, in a format that cannot hold them."""
    if kind in DATASETS:
        return
    if count > 1:
        raise CongraspError(
            f"A {kind} file contains a single motion, but there are {count}.",
            "Export them with separate commands.",
        )
    if camera:
        raise CongraspError(
            f"A {kind} file cannot contain a video.",
            f"Remove --camera, or pass --to {DATASETS[0]}.",
        )


def _check_suffix(path: pathlib.Path, kind: str) -> None:
    """Raises a CongraspError for a path without the suffix of its format."""
    suffix = FORMATS[kind]
    if not suffix or path.suffix.lower() == suffix:
        return
    stem = path
    if path.suffix and suffix.startswith(path.suffix):
        stem = path.with_suffix("")
    name = f"{stem}{suffix}"
    if path.is_dir():
        name = str(path / f"grasp{suffix}")
    raise CongraspError(
        f"The name of a {kind} file ends in {suffix}, and {path} does not.", f"Use --out {name}"
    )


def _move_files(folder: pathlib.Path, path: pathlib.Path, *, force: bool) -> None:
    """Moves all written files of a folder to that of `path`.

    Raises:
      CongraspError: one of them exists already, or cannot have its name.
    """
    targets = {file: path.with_name(file.name) for file in folder.iterdir()}
    for target in targets.values():
        check_spelling(target)
        check_free(target, force=force)
    for file, target in targets.items():
        platforms.replace(file, target)


def default_name(motion: Episode, kind: str) -> pathlib.Path:
    """Default path of a motion: the object's name in the working directory.

    Raises:
      CongraspError: the object's name cannot name a file.
    """
    name = file_name(motion.object, "the object of a motion")
    suffix = FORMATS[kind] or f"-{kind}"
    return pathlib.Path(f"{name}{suffix}")
