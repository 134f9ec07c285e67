"""Wrist paths from external motions: CSV, NPZ, and a joint of a BVH skeleton.

Results are in metres, in a world frame with the z axis up, for the wrist frame of the `human` hand: fingers towards
-y, thumb side +x, back of the hand +z.
"""

import pathlib
import re
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_file, read_npz

_LARGEST, _DEEPEST = 32 << 20, 200
"""Bytes of a BVH or CSV file, and joints of a BVH chain."""
HUGE = 1e9
"""Bound on angles, positions and quaternion components."""
_ORDERS = {"xyzwxyz": (0, 1, 2, 3, 4, 5, 6), "xyzxyzw": (0, 1, 2, 6, 3, 4, 5)}
"""Last letters of a CSV header's names, and the places of x, y, z and the quaternion w, x, y, z among them."""
_NO_NAME = re.compile(r"\[[^][]*\]|\([^()]*\)|[\"']")  # units and quotes around the names of a header
_NUMBERED = re.compile(r"\bq\w*[\s.]?\d\b")
_FROM_Y_UP, _CM = Rotation.from_euler("X", 90, degrees=True), 0.01  # frame and unit of BVH files
_AXES = {
    f"{sign}{axis}": s * row for axis, row in zip("xyz", np.eye(3), strict=True) for sign, s in (("+", 1), ("-", -1))
}


class WristPath(NamedTuple):
    """T frames of a wrist."""

    position: np.ndarray
    """(T, 3) m."""
    rotation: Rotation
    """T orientations of the wrist frame."""
    seconds: float
    """Time between two frames, s; 0.01 for CSV and NPZ files."""


def read_wrist_path(
    path: pathlib.Path,
    *,
    joint: str = "RightHand",
    fingers: str = "-y",
    back: str = "+z",
) -> WristPath:
    """A wrist's path.

    Args:
      path: `.csv`, a line a frame: x, y, z (m) and a quaternion w, x, y, z; `.npz` with `position` (T, 3) and
        `quaternion` (T, 4), or a grasp motion; or `.bvh`.
      joint: name of the wrist joint in a BVH file.
      fingers: axis of the file's wrist frame along which the fingers point, such as +x.
      back: axis of that frame towards the back of the hand.

    Raises:
      CongraspError: the file cannot be read or has no such joint, or the axes are unknown or not orthogonal.
    """
    kind = path.suffix.lower()
    if not path.is_file():
        raise CongraspError(f"There is no file {path}.", "Name a CSV, NPZ or BVH file.")
    if kind == ".bvh":
        position, rotation, seconds = read_bvh(path, joint)
        position, rotation = _FROM_Y_UP.apply(position * _CM), _FROM_Y_UP * rotation
    elif kind in (".csv", ".npz"):
        position, quaternion = _npz(path) if kind == ".npz" else read_csv(path, _LARGEST)
        _check(path, position, quaternion)
        seconds = 0.01
        rotation = Rotation.from_quat(quaternion, scalar_first=True)
    else:
        raise CongraspError(f"{path} is neither CSV, NPZ nor BVH.", "Convert it to one of them.")
    for name in (fingers, back):
        if name not in _AXES:
            raise CongraspError(f"'{name}' is no axis.", f"Choose one of: {', '.join(_AXES)}.")
    if _AXES[fingers] @ _AXES[back]:
        raise CongraspError(f"Fingers along {fingers} and the back of the hand along {back} do not fit.")
    y, z = -_AXES[fingers], _AXES[back]
    own = Rotation.from_matrix(np.stack([np.cross(y, z), y, z], -1))
    return WristPath(position, rotation * own, seconds)


def read_bvh(path: pathlib.Path, joint: str) -> tuple[np.ndarray, Rotation, float]:
    """A joint's positions (T, 3) and orientations in a BVH file's own unit and axes, and seconds between frames.

    Raises:
      CongraspError: the file is damaged, or has no such joint; the message names the existing ones.
    """
    try:
        return _bvh(read_file(path, _LARGEST, "Cut it into shorter ones.").decode(), path, joint)
    except (ValueError, LookupError, StopIteration) as error:
        raise CongraspError(f"{path} cannot be read as BVH: {str(error)[:200]}.", "Export it again.") from None


def _bvh(text: str, path: pathlib.Path, joint: str) -> tuple[np.ndarray, Rotation, float]:
    """Does the work of `read_bvh` for a file's text; ValueError, LookupError or StopIteration if it is damaged."""
    head, _, tail = text.partition("MOTION")
    chain, width, names = _chain(head, joint)
    if chain is None:
        raise CongraspError(f"{path} has no joint {ascii(joint)[:60]}.", f"Its joints are: {', '.join(names)[:2000]}.")
    _, count, *_, seconds, rest = tail.split(maxsplit=5)
    rows = np.array(rest.split(), float).reshape(int(count), width)
    if not (np.isfinite(rows).all() and 0.0 < float(seconds) <= 1.0):
        raise ValueError("it holds numbers that are not finite, or a frame takes more than a second")
    position, rotation = np.zeros((len(rows), 3)), Rotation.identity(len(rows))
    for offset, channels, first in chain:
        values = rows[:, first : first + len(channels)]
        moved = np.tile(offset, (len(rows), 1))
        turn = Rotation.identity(len(rows))
        for channel, column in zip(channels, values.T, strict=True):
            axis = channel[0].upper()
            if channel.endswith("position"):
                # A position takes the place of the offset, as most programs read it.
                moved[:, "XYZ".index(axis)] = column
            else:
                turn = turn * Rotation.from_euler(axis, column[:, None], degrees=True)
        position = position + rotation.apply(moved)
        rotation = rotation * turn
    return position, rotation, float(seconds)


_Link = tuple[np.ndarray, list[str], int]


def _chain(text: str, joint: str) -> tuple[list[_Link] | None, int, list[str]]:
    """Offset (3,), channels and first column of each joint down to the named one; number of columns; all joints."""
    tokens = iter(text.split())
    stack: list[_Link] = []
    found: list[_Link] | None = None
    names: list[str] = []
    column, name = 0, ""
    for token in tokens:
        if token in ("ROOT", "JOINT"):
            name = next(tokens)
            names.append(name)
        elif token == "End":
            name = next(tokens)
        elif token == "{":
            stack.append((np.zeros(3), [], column))
            if len(stack) > _DEEPEST:
                raise ValueError(f"its joints are nested deeper than {_DEEPEST}")
        elif token == "OFFSET":
            stack[-1] = (np.array([float(next(tokens)) for _ in range(3)]), *stack[-1][1:])
        elif token == "CHANNELS":
            channels = [next(tokens) for _ in range(int(next(tokens)))]
            stack[-1] = (stack[-1][0], channels, column)
            column += len(channels)
            if name == joint:
                found = list(stack)
        elif token == "}":
            stack.pop()
    return found, column, names


def read_csv(path: pathlib.Path, largest: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 3) and quaternions (T, 4) of a CSV file's lines.

    A header, also in a comment, whose names end in these letters may put w last, as ROS does, and have other columns:
    t, x, y, z, qx, qy, qz, qw.

    Raises:
      CongraspError: the file has more than `largest` bytes or cannot be read, a line is not seven finite numbers, or a
        header names a quaternion in another place, or several.
    """
    columns, width = list(range(7)), 7
    remedy = "Write x, y, z, qw, qx, qy, qz in every line."
    try:
        lines = read_file(path, largest, remedy).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise CongraspError(f"{path} is not text.", remedy) from None
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        text, _, comment = line.partition("#")
        words = re.sub(r"[,;\"]", " ", text).split()
        if not words or (not rows and not any(map(_is_number, words))):
            try:
                columns, width = (not rows and _columns(text.strip() or comment)) or (columns, width)
            except ValueError as error:
                raise CongraspError(
                    f"line {number} of {path} {error}.", f"{remedy} A header may put qw last."
                ) from None
            continue
        if len(words) != width or not all(_is_number(words[column]) for column in columns):
            raise CongraspError(f"line {number} of {path} is not {width} finite numbers.", remedy)
        rows.append([float(words[column]) for column in columns])
    if not rows:
        raise CongraspError(f"{path} has no numbers.", remedy)
    table = np.array(rows)
    return table[:, :3], table[:, 3:]


def _columns(header: str) -> tuple[list[int], int] | None:
    """Places of x, y, z and the quaternion w, x, y, z in a header, and the number of its columns; None for other text.

    Raises:
      ValueError: it names several quaternions, or one in another place.
    """
    text = _NO_NAME.sub("", header).lower().strip(" #").rstrip(",; ")
    names = [name.strip() for name in re.split(r"[,;\t]" if re.search(r"[,;\t]", text) else r"\s+", text)]
    ends = "".join(name[-1:] or " " for name in names)
    orders = [
        [match.start() + place for place in places]
        for order, places in _ORDERS.items()
        for match in re.finditer(f"(?={order})", ends)
    ]
    found = [columns for columns in orders if len({names[column][:-1] for column in columns[3:]}) == 1]
    if len(found) == 1:
        return found[0], len(names)
    if set("wxyz") <= set(ends) or len(_NUMBERED.findall(text)) > 3:
        raise ValueError(f"names {'several quaternions' if found else 'no position and quaternion in a known order'}")
    return None


def _is_number(word: str) -> bool:
    """True if a word is a plausible number."""
    try:
        return abs(float(word)) < HUGE
    except ValueError:
        return False


def _npz(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions and quaternions of an NPZ file."""
    try:
        data = read_npz(path, remedy := "It needs 'position' and 'quaternion'.")
        keys = ("wrist_position", "wrist_quaternion") if "wrist_position" in data else ("position", "quaternion")
        position, quaternion = (data[key].astype(float) for key in keys)
    except (KeyError, ValueError) as error:
        raise CongraspError(f"{path} cannot be read: {error}.", remedy) from None
    return position, quaternion


def _check(path: pathlib.Path, position: np.ndarray, quaternion: np.ndarray) -> None:
    """Raises a CongraspError if a shape is wrong, a number is not finite, or a quaternion is not normalised."""
    if position.ndim != 2 or position.shape[1:] != (3,) or quaternion.shape != (len(position), 4) or not len(position):
        raise CongraspError(
            f"{path} has positions {position.shape} and quaternions {quaternion.shape}.",
            "A frame is x, y, z and a quaternion w, x, y, z.",
        )
    both = np.concatenate([position, quaternion], 1)
    if not np.isfinite(both).all() or np.abs(np.linalg.norm(quaternion, axis=-1) - 1).max() > 0.05:
        raise CongraspError(f"{path} holds numbers that are not finite, or quaternions that are not of length one.")
