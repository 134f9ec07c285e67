"""Biovision hierarchy: centimetres and y-up, as motion-capture programs expect.

The format has no comments, so the meaning of the numbers is written to `<name>.json` next to it.
"""

import json
import pathlib
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.services.export.facts import facts
from congrasp.services.export.frames import TO_Y_UP, bodies, identifiers

_CM = 100.0
_ORDER = "ZYX"
_POSITION = ("Xposition", "Yposition", "Zposition")
_ROTATION = tuple(f"{axis}rotation" for axis in _ORDER)
_ROOT = "world"


def write(path: pathlib.Path, motions: Sequence[Episode]) -> None:
    """Writes one motion, and the description of its numbers next to it."""
    (motion,) = motions
    motion_bodies = bodies(motion)
    names = identifiers([_ROOT, *(body.name for body in motion_bodies)])[1:]
    count = len(motion.time)
    # A root turns the world y-up; everything below keeps z-up coordinates.
    lines = [
        "HIERARCHY",
        f"ROOT {_ROOT}",
        "{",
        "  OFFSET 0 0 0",
        f"  CHANNELS 3 {' '.join(_ROTATION)}",
    ]
    columns = [np.tile(_angles(TO_Y_UP), (count, 1))]

    def add(index: int, indent: str) -> None:
        """Adds a joint and those below it."""
        body = motion_bodies[index]
        moves = len(body.translation) > 1
        channels = (*_POSITION, *_ROTATION) if moves else _ROTATION
        # Programs differ in whether a joint's positions replace its offset or add to it: with no
        # offset they agree.
        offset = np.zeros(3) if moves else _CM * body.translation[0]
        lines.extend([f"{indent}JOINT {names[index]}", f"{indent}{{"])
        lines.append(f"{indent}  OFFSET {_row(offset)}")
        lines.append(f"{indent}  CHANNELS {len(channels)} {' '.join(channels)}")
        if moves:
            columns.append(_CM * body.translation)
        columns.append(_angles(body.rotation))
        children = [child for child, other in enumerate(motion_bodies) if other.parent == index]
        for child in children:
            add(child, indent + "  ")
        if not children:
            lines.extend([f"{indent}  End Site", f"{indent}  {{"])
            lines.extend([f"{indent}    OFFSET {_row(_CM * _end(motion, index))}", f"{indent}  }}"])
        lines.append(f"{indent}}}")

    for index, body in enumerate(motion_bodies):
        if body.parent < 0:
            add(index, "  ")
    lines += ["}", "MOTION", f"Frames: {count}", f"Frame Time: {motion.control_dt:.9g}"]
    lines += map(_row, np.concatenate(columns, 1))
    path.write_text("\n".join([*lines, ""]), encoding="ascii")
    about = facts(
        motion,
        frame=f"y up; the joint '{_ROOT}' turns what is below it z up",
        unit="cm and degrees",
        quaternion=f"none: angles, intrinsic {_ORDER}",
    )
    about["frames"] = {name: body.name for name, body in zip(names, motion_bodies, strict=True)}
    path.with_name(f"{path.name}.json").write_text(json.dumps(about, indent=1), encoding="utf-8")


def _angles(rotation: Rotation) -> np.ndarray:
    """(T, 3) degrees without jumps of a turn."""
    angles = rotation.as_euler(_ORDER, degrees=True)
    return np.unwrap(angles, period=360, axis=0) if angles.ndim > 1 else angles


def _row(values: np.ndarray) -> str:
    """Numbers of a line."""
    return " ".join(f"{value:.7f}" for value in values)


def _end(motion: Episode, index: int) -> np.ndarray:
    """Drawn end of a last link, in its frame, m: the far end of its last capsule."""
    capsules = np.flatnonzero(motion.capsule_link == index)
    return motion.capsule_ends[capsules[-1], 1] if len(capsules) else np.array([0.0, 0.0, 0.01])
