"""Formats of other programs, and motions written in them."""

import importlib
import pathlib
import tempfile
from collections.abc import Sequence
from typing import Any

from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.io.files import check_free
from congrasp.common.io.spelling import check_spelling
from congrasp.services.export.motion import GraspMotion
from congrasp.services.export.motion_file import check_quaternions

FORMATS = {"glb": ".glb", "usd": ".usda", "bvh": ".bvh", "ros2": "", "lerobot": ""}
"""Name and suffix of each format; `services.export.<name>` writes it. Those without a suffix are
folders.
"""
DATASETS = ("lerobot",)
"""Formats that hold several motions, and videos."""


def default_name(motion: GraspMotion, kind: str) -> pathlib.Path:
    """Default path of a motion: the object's name in the working directory."""
    ending = FORMATS[kind] or f"-{kind}"
    return pathlib.Path(f"{motion.object}{ending}")


def export_motions(
    motions: Sequence[GraspMotion],
    kind: str,
    path: pathlib.Path,
    *,
    camera: bool = False,
    force: bool = False,
) -> None:
    """Writes motions in a format.

    Args:
      motions: one, or several if the format supports them.
      kind: one of `FORMATS`.
      path: the file or folder to write.
      camera: also records videos, if the format has them.
      force: replaces an existing file; a folder is never replaced.

    Raises:
      CongraspError: `path` exists already, has another suffix or cannot be written, a motion has
        invalid poses, or the format cannot hold what was given.
    """
    _check_content(kind, len(motions), camera)
    _check_suffix(kind, path)
    if path.is_dir():
        raise CongraspError(
            f"The folder {path} exists already.", "Remove it or pass another with --out."
        )
    check_free(path, force=force)
    for motion in motions:
        check_quaternions(motion, "The motion")
    options: dict[str, Any] = {"camera": True} if camera else {}
    module = importlib.import_module(f"congrasp.services.export.{kind}")
    with os_errors_as(f"{path} cannot be written", "Pass another with --out."):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as workplace:
            module.write(pathlib.Path(workplace, path.name), motions, **options)
            _move_content(pathlib.Path(workplace), path.parent, force=force)


def _check_content(kind: str, count: int, camera: bool) -> None:
    """Raises a CongraspError for a number of motions, or a video, that a format cannot hold."""
    if kind in DATASETS:
        return
    if count > 1:
        raise CongraspError(
            f"A {kind} file holds one motion, but {count} were given.", "Pass one at a time."
        )
    if camera:
        raise CongraspError(
            f"A {kind} file holds no video.", f"Remove --camera, or pass --to {DATASETS[0]}."
        )


def _check_suffix(kind: str, path: pathlib.Path) -> None:
    """Raises a CongraspError, which names a path that fits, for a file with another suffix than
    its format's.
    """
    suffix = FORMATS[kind]
    if not suffix or path.suffix.lower() == suffix:
        return
    if path.is_dir():
        name = path / f"grasp{suffix}"
    elif path.suffix and suffix.startswith(path.suffix):
        name = path.with_suffix(suffix)
    else:
        name = pathlib.Path(f"{path}{suffix}")
    raise CongraspError(
        f"The name of a {kind} file ends in {suffix}, and {path} does not.", f"Use --out {name}"
    )


def _move_content(source: pathlib.Path, target: pathlib.Path, *, force: bool) -> None:
    """Moves everything in a folder to another, unless one of the files exists there already."""
    files = list(source.iterdir())
    for file in files:
        check_spelling(target / file.name)
        check_free(target / file.name, force=force)
    for file in files:
        file.replace(target / file.name)
