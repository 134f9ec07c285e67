"""Grasp motions for other programs; each file is read back by another reader and compared before it is kept."""

import importlib
import pathlib
import shutil
import tempfile
from collections.abc import Sequence

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import check_free
from congrasp.services.export.frames import TOLERANCE_MM, error_mm
from congrasp.services.export.motion_file import GraspMotion, load_motion, motion_of_episode
from congrasp.services.record.reader import pick_episode

FORMATS = {
    "glb": ".glb",
    "usd": ".usda",
    "bvh": ".bvh",
    "ros2": "",
    "lerobot": "",
}
"""Name and suffix of each format; `services.export.<name>` writes and reads it. Those without a suffix are folders."""
SEVERAL = ("lerobot",)
"""Formats that hold more than one motion."""
FILMED = ("lerobot",)
"""Formats that hold a camera's video."""
_NUMBERS = (
    "time",
    "joint_position",
    "wrist_quaternion",
    "link_position",
    "link_quaternion",
    "object_position",
    "object_quaternion",
    "object_vertices",
)
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
) -> float:
    """Writes motions in a format, reads the file back and compares.

    Args:
      motions: one, or several if the format supports them.
      kind: one of `FORMATS`.
      path: the file or folder to write.
      camera: also records videos, if the format has them.
      force: replaces an existing file; a folder is never replaced.

    Returns:
      The largest error in mm (see `services.export.frames.error_mm`).

    Raises:
      CongraspError: the error is above `TOLERANCE_MM`, and nothing was written; or `path` exists already, or cannot be
        written.
    """
    if len(motions) > 1 and kind not in SEVERAL:
        raise CongraspError(f"A {kind} file holds one motion, but {len(motions)} were given.", "Pass one at a time.")
    if camera and kind not in FILMED:
        raise CongraspError(f"A {kind} file holds no video.", f"Remove --camera, or pass --to {FILMED[0]}.")
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
        workplace = pathlib.Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as error:
        raise CongraspError(f"{path} cannot be written: {error.strerror}.", "Pass another with --out.") from None
    try:
        draft = workplace / path.name
        module.write(draft, motions, **({"camera": True} if camera else {}))
        tracks = module.read(draft)
        if len(tracks) != len(motions):
            raise CongraspError(f"The {kind} file holds {len(tracks)} motions, not {len(motions)}.")
        worst = max(error_mm(motion, track) for motion, track in zip(motions, tracks, strict=True))
        if not worst <= TOLERANCE_MM:
            raise CongraspError(
                f"The {kind} file is off by {worst:.3g} mm, above the limit of {TOLERANCE_MM} mm.",
                "Nothing was written. Check that the motion's file is intact.",
            )
        made = sorted(workplace.iterdir())
        for file in made:
            check_free(path.with_name(file.name), force=force)
        for file in made:
            file.replace(path.with_name(file.name))
    finally:
        shutil.rmtree(workplace, ignore_errors=True)
    return worst


def default_name(motion: GraspMotion, kind: str) -> pathlib.Path:
    """Default path of a motion: the object's name in the working directory."""
    return pathlib.Path(f"{motion.object}{FORMATS[kind] or f'-{kind}'}")


def _check(motion: GraspMotion) -> None:
    """Raises a CongraspError for numbers that are not finite, or quaternions that are not normalised."""
    remedy = "Run 'congrasp grasp' again."
    for name in _NUMBERS:
        values = np.asarray(getattr(motion, name))
        if not np.isfinite(values).all():
            raise CongraspError(f"The motion's {name} has values that are not finite numbers.", remedy)
        if name.endswith("quaternion") and np.abs(np.linalg.norm(values, axis=-1) - 1).max() > _UNIT:
            raise CongraspError(f"The motion's {name} has quaternions that are not normalised.", remedy)
