"""Grasp motions for other programs, in the formats of this folder's modules."""

import importlib
import pathlib
import tempfile
from collections.abc import Sequence

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import check_free
from congrasp.services.export.motion_file import GraspMotion, load_motion, motion_of_episode
from congrasp.services.record.reader import pick_episode

FORMATS = {
    "glb": ".glb",
    "usd": ".usda",
    "bvh": ".bvh",
    "ros2": "",
    "lerobot": "",
}
"""Name and suffix of each format; `services.export.<name>` writes it. Those without a suffix are folders."""
DATASETS = ("lerobot",)
"""Formats that hold several motions, and videos."""
_QUATERNIONS = ("wrist_quaternion", "link_quaternion", "object_quaternion")
_UNIT = 1e-3


def pick_motion(path: pathlib.Path, index: int = -1, *, success: bool = False) -> GraspMotion:
    """The motion of an NPZ file, or an episode recorded at `path` (see `pick_episode`).

    Raises:
      CongraspError: `path` is missing or holds no motion, or an NPZ file's index is neither -1 nor 0.
    """
    if not path.exists():
        raise CongraspError(f"There is no {path}.", "Pass a motion (.npz), a recording (.mcap) or a run's folder.")
    if path.suffix == ".npz":
        if index not in (-1, 0):
            raise CongraspError(f"{path} is one motion and has no number {index}.", "Remove --index.")
        return load_motion(path)
    if path.is_file() and path.suffix != ".mcap":
        raise CongraspError(f"{path} holds no motion.", "Pass a grasp.npz, a recording (.mcap) or a run's folder.")
    return motion_of_episode(pick_episode(path, index, success=success))


def export_motions(
    motions: Sequence[GraspMotion], kind: str, path: pathlib.Path, *, camera: bool = False, force: bool = False
) -> None:
    """Writes motions in a format.

    Args:
      motions: one, or several if the format supports them.
      kind: one of `FORMATS`.
      path: the file or folder to write.
      camera: also records videos, if the format has them.
      force: replaces an existing file; a folder is never replaced.

    Raises:
      CongraspError: `path` exists already, has another suffix or cannot be written, a motion has invalid poses, or the
        format cannot hold what was given.
    """
    if len(motions) > 1 and kind not in DATASETS:
        raise CongraspError(f"A {kind} file holds one motion, but {len(motions)} were given.", "Pass one at a time.")
    if camera and kind not in DATASETS:
        raise CongraspError(f"A {kind} file holds no video.", f"Remove --camera, or pass --to {DATASETS[0]}.")
    if (suffix := FORMATS[kind]) and path.suffix.lower() != suffix:
        named = path.with_suffix("") if path.suffix and suffix.startswith(path.suffix) else path
        name = path / f"grasp{suffix}" if path.is_dir() else f"{named}{suffix}"
        raise CongraspError(f"The name of a {kind} file ends in {suffix}, and {path} does not.", f"Use --out {name}")
    if path.is_dir():
        raise CongraspError(f"The folder {path} exists already.", "Remove it or pass another with --out.")
    check_free(path, force=force)
    for motion in motions:
        _check(motion)
    module = importlib.import_module(f"congrasp.services.export.{kind}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as workplace:
            module.write(pathlib.Path(workplace, path.name), motions, **({"camera": True} if camera else {}))
            written = [(file, path.with_name(file.name)) for file in pathlib.Path(workplace).iterdir()]
            for _, target in written:
                check_free(target, force=force)
            for file, target in written:
                file.replace(target)
    except OSError as error:
        raise CongraspError(
            f"{path} cannot be written: {error.strerror or error}.", "Pass another with --out."
        ) from None


def default_name(motion: GraspMotion, kind: str) -> pathlib.Path:
    """Default path of a motion: the object's name in the working directory."""
    return pathlib.Path(f"{motion.object}{FORMATS[kind] or f'-{kind}'}")


def _check(motion: GraspMotion) -> None:
    """Raises a CongraspError for quaternions that are not normalised; files and recordings are not checked for that."""
    for owner in (motion, motion.arm):
        for name in _QUATERNIONS:
            values = getattr(owner, name, None)
            if values is not None and not (np.abs(np.linalg.norm(values, axis=-1) - 1) <= _UNIT).all():
                raise CongraspError(
                    f"The motion's {name} has quaternions that are not normalised.", "Run 'congrasp grasp' again."
                )
