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
from congrasp.services.export.frames import TO_Y_UP, Body, bodies, identifiers

_CM = 100.0  # per metre
_ORDER = "ZYX"
_POSITION = ("Xposition", "Yposition", "Zposition")
_ROTATION = tuple(f"{axis}rotation" for axis in _ORDER)
_ROOT = "world"


def write(path: pathlib.Path, motions: Sequence[Episode]) -> None:
    """Writes one motion, and the description of its numbers next to it."""
    (motion,) = motions
    motion_bodies = bodies(motion)
    names = identifiers([_ROOT, *(body.name for body in motion_bodies)])[1:]
    hierarchy = _Hierarchy(motion, motion_bodies, names)
    lines = ["HIERARCHY", *hierarchy.lines]
    lines += ["MOTION", f"Frames: {len(motion.time)}", f"Frame Time: {motion.control_dt:.9g}"]
    lines += map(_row, np.concatenate(hierarchy.columns, 1))
    path.write_text("\n".join([*lines, ""]), encoding="ascii")
    about = facts(
        motion,
        frame=f"y up; the joint '{_ROOT}' turns what is below it z up",
        unit="cm and degrees",
        quaternion=f"none: angles, intrinsic {_ORDER}",
    )
    about["frames"] = {name: body.name for name, body in zip(names, motion_bodies, strict=True)}
    path.with_name(f"{path.name}.json").write_text(json.dumps(about, indent=1), encoding="utf-8")


class _Hierarchy:
    """Joints of the file.

    Attributes:
      lines: the joints and their channels.
      columns: values (T, n) of the channels, in their order.
    """

    def __init__(self, motion: Episode, motion_bodies: Sequence[Body], names: Sequence[str]):
        """Adds a joint for each body of a motion, with these names, below the root.

        The root turns the world y-up; everything below keeps z-up coordinates.
        """
        self._motion = motion
        self._bodies = motion_bodies
        self._names = names
        self.lines = [
            f"ROOT {_ROOT}",
            "{",
            "  OFFSET 0 0 0",
            f"  CHANNELS 3 {' '.join(_ROTATION)}",
        ]
        self.columns = [np.tile(_angles(TO_Y_UP), (len(motion.time), 1))]
        for index, body in enumerate(motion_bodies):
            if body.parent < 0:
                self._add(index, "  ")
        self.lines.append("}")

    def _add(self, index: int, indent: str) -> None:
        """Adds the joint of a body, and those below it."""
        body = self._bodies[index]
        moves = len(body.translation) > 1
        channels = _ROTATION
        offset = _CM * body.translation[0]
        if moves:
            channels = (*_POSITION, *_ROTATION)
            # Programs differ in whether a joint's positions replace its offset or add to it:
            # without an offset they agree.
            offset = np.zeros(3)
            self.columns.append(_CM * body.translation)
        self.columns.append(_angles(body.rotation))
        self.lines += [
            f"{indent}JOINT {self._names[index]}",
            f"{indent}{{",
            f"{indent}  OFFSET {_row(offset)}",
            f"{indent}  CHANNELS {len(channels)} {' '.join(channels)}",
        ]
        children = [child for child, other in enumerate(self._bodies) if other.parent == index]
        for child in children:
            self._add(child, indent + "  ")
        if not children:
            self.lines += [
                f"{indent}  End Site",
                f"{indent}  {{",
                f"{indent}    OFFSET {_row(_CM * _end(self._motion, index))}",
                f"{indent}  }}",
            ]
        self.lines.append(f"{indent}}}")


def _angles(rotation: Rotation) -> np.ndarray:
    """Angles (T, 3) of T rotations, or (3,) of one, in degrees, without jumps of a full turn."""
    angles = rotation.as_euler(_ORDER, degrees=True)
    if angles.ndim == 1:
        return angles
    return np.unwrap(angles, period=360, axis=0)


def _row(values: np.ndarray) -> str:
    """Formats numbers (n,) as a line."""
    return " ".join(f"{value:.7f}" for value in values)


def _end(motion: Episode, index: int) -> np.ndarray:
    """End (3,) of a body without children, in its frame, m: the far end of a link's last capsule,
    or a centimetre along z without capsules.
    """
    capsules = np.flatnonzero(motion.capsule_link == index)
    if len(capsules) == 0:
        return np.array([0.0, 0.0, 0.01])
    return motion.capsule_ends[capsules[-1], 1]
