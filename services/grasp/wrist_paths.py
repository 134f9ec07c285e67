"""Wrist paths from external motions: CSV, NPZ, and a joint of a BVH skeleton.

Results are in metres, in a world frame with the z axis up, for the wrist frame of the `human` hand: fingers towards
-y, thumb side +x, back of the hand +z.
"""

import csv
import pathlib
import re
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import read_file, read_npz
from congrasp.services.assets.objects.options import METRES

_LARGEST, _DEEPEST = 32 << 20, 200
"""Bytes of a BVH or CSV file, and joints of a BVH chain."""
_UNIT_LENGTH = 0.01  # tolerance of a quaternion's length: positions in its place differ more
HUGE = 1e9
"""Bound on angles, positions and quaternion components."""
_UNIT = re.compile(r"\s*[\[(]\s*([^])]*?)\s*[])]")
_LETTERED = re.compile(r"(.*?)[\W_]*([wxyz])(?:\[(.*)\]|_(m|mm|cm|in))?")  # name, letter and unit of a column
_PLACE = re.compile(r"(?:.*[\W_])?[ptc]?|.*(?:pose?|position|trans|translation|location)")
_NO_PLACE = re.compile(r"(?:.*[\W_])?[vawfnre]|.*(?:vel|speed|acc|linear|ang|gyro|force|tor|rot|euler|normal).*")
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

    A header, also in a comment or of two lines, may name them in any order and among other columns, such as t, qx, qy,
    qz, qw, vx, vy, vz, px, py, pz, and positions in mm or cm: "x [mm]".

    Raises:
      CongraspError: the file has more than `largest` bytes or cannot be read, a line is not seven finite numbers, a
        header names no position or quaternion, or several, or quaternions are not of length one.
    """
    columns, width, metres, named, above = list(range(7)), 7, 1.0, False, list[str]()
    remedy = "Write x, y, z, qw, qx, qy, qz in every line."
    try:
        lines = read_file(path, largest, remedy).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise CongraspError(f"{path} is not text.", remedy) from None
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        text, _, comment = line.partition("#")
        words = _cells(text) if named else re.sub(r"[,;\"]", " ", text).split()
        numbers = sum(map(_is_number, words))
        if not any(words) or (not rows and (not numbers if named else 2 * numbers < len(words))):
            names = _cells(_UNIT.sub(r"[\1]", text.strip() or comment).lower().strip(" #"))
            try:
                found = None if rows or named else _columns(names, above)
            except ValueError as error:
                raise CongraspError(f"line {number} of {path} {error}.", "Name them x, y, z, qw, qx, qy, qz.") from None
            if found:
                (columns, width, metres), named = found, True
            above = names
            continue
        if len(words) < width or any(words[width:]) or not all(_is_number(words[column]) for column in columns):
            raise CongraspError(f"line {number} of {path} is not {width} finite numbers.", remedy)
        rows.append([float(words[column]) for column in columns])
    if not rows:
        raise CongraspError(f"{path} has no numbers.", remedy)
    table = np.array(rows)
    if np.abs(np.linalg.norm(table[:, 3:], axis=-1) - 1).max() > _UNIT_LENGTH:
        raise CongraspError(f"{path} holds quaternions that are not of length one.", remedy)
    return metres * table[:, :3], table[:, 3:]


def _cells(line: str) -> list[str]:
    """The cells of a line between semicolons, tabs, commas or blanks; decimal commas become points."""
    mark = next((mark for mark in ";\t," if mark in line), None)
    cells = line.split() if mark is None else next(csv.reader([line], delimiter=mark, skipinitialspace=True), [])
    return [cell.strip(" '").replace(",", "." if mark == ";" else ",") for cell in cells]


def _columns(names: list[str], above: list[str]) -> tuple[list[int], int, float] | None:
    """Places of x, y, z and the quaternion w, x, y, z in a header, the number of its columns, and metres per unit.

    Columns of one name before their letters belong together, or of one name in the line above: with w they are a
    quaternion. None for other text.

    Raises:
      ValueError: it names no position or no quaternion, or several.
    """
    while names and not names[-1]:
        names = names[:-1]
    if len(above) >= len(names) and not any(above[len(names) :]):
        names = [f"{over} {name}" if len(name) == 1 else name for over, name in zip(above, names, strict=False)]
    groups: dict[str, list[dict[str, tuple[int, str]]]] = {}
    for place, lettered in enumerate(map(_LETTERED.fullmatch, names)):
        if lettered:
            name, letter, bracketed, suffix = lettered.groups()
            same = groups.setdefault(name, [{}])
            if letter in same[-1] or (letter == "w" and not name and len(same) == 1 and len(same[0]) == 3):
                same.append({})  # of columns x, y, z, w, x, y, z
            same[-1][letter] = (place, bracketed or suffix or "m")
    whole = [(name, group) for name, same in groups.items() for group in same]
    turns = [(name, group) for name, group in whole if group.keys() == set("wxyz")]
    vectors = [(name, group) for name, group in whole if group.keys() == set("xyz")]
    if not (vectors or turns or len(_NUMBERED.findall(",".join(names))) > 3):
        return None
    places = [one for one in vectors if _PLACE.fullmatch(one[0])]
    places = places or [one for one in vectors if not _NO_PLACE.fullmatch(one[0])]
    for what, some in (("position", places), ("quaternion", turns)):
        if len(some) != 1:
            several = f"several {what}s: {', '.join(name or 'x, y, z' for name, _ in some)}"
            raise ValueError(f"names {several if some else f'no {what}'}")
    (_, position), (_, turn) = places[0], turns[0]
    units = {position[letter][1] for letter in "xyz"}
    if not (len(units) == 1 and units <= METRES.keys()):
        raise ValueError(f"names positions in {' and '.join(sorted(units))}, not all in one of {', '.join(METRES)}")
    columns = [position[letter][0] for letter in "xyz"] + [turn[letter][0] for letter in "wxyz"]
    return columns, len(names), METRES[units.pop()]


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
    if not np.isfinite(both).all() or np.abs(np.linalg.norm(quaternion, axis=-1) - 1).max() > _UNIT_LENGTH:
        raise CongraspError(f"{path} holds numbers that are not finite, or quaternions that are not of length one.")
