"""Wrist paths from external motions: CSV, NPZ, and a joint of a BVH skeleton.

Results are in metres, in a world frame with the z axis up, for the wrist frame of the `human` hand:
fingers towards -y, thumb side +x, back of the hand +z.
"""

import csv
import itertools
import pathlib
import re
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.io.inputs import check_arrays, read_file, read_npz, runs_back
from congrasp.services.assets.objects.options import METRES

_LARGEST, _DEEPEST = 32 << 20, 200
"""Bytes of a BVH or CSV file, and joints of a BVH chain."""
_UNIT_LENGTH = 0.01  # tolerance of a quaternion's length: positions in its place differ more
HUGE = 1e9
"""Bound on angles, positions and quaternion components."""
_UNIT = re.compile(r" ?[\[(]([^][()]*)[])]")
# Letter and unit at the end of a column's name
_LETTERED = re.compile(r"([wxyz]) *(?:\[([^][]*)\]|_(m|mm|cm|in))?$")
_SEPARATOR = re.compile(r"[\W_]+")
_NO_PLACE = re.compile(
    # A position between two frames, in one of them, as p_RS_R of EuRoC
    r"(?!p [a-z]?([a-z])[a-z]? \1$)"
    r"(?:.* )?(?:[vawfnre]|(?:vel|speed|acc|linear|linv|ang|gyro|force|torq|rot|euler|normal|"
    r"omega|twist|wrench).*)"
)
# First word without a body
_KIND = re.compile(r"|[ptcqo]|pos.*|trans.*|loc.*|cent.*|quat.*|rot.*|ori.*|att.*")
_TIME = re.compile(
    r"(?:.*[.%])?(?:t|time|(?:time[_ ]?)?stamp|secs?|seconds?)"
    r"(?: ?\[.*|[_ ](?:[mnuµ]?s|secs?|seconds?))?"
)
_SECONDS = re.compile(r"(.*?)(?:(?<=[_ ])s|secs?|seconds?)")
_NANOSECONDS = re.compile(r"(.*?)(?:(?<=[_ ])ns|n(?:ano)?(?:secs?|seconds?))")
_SECOND = 1e9  # ns
_NUMBERED = re.compile(r"\bq\w*[\s.]?\d\b")
_FROM_Y_UP, _CM = Rotation.from_euler("X", 90, degrees=True), 0.01  # frame and unit of BVH files
_AXES = {
    f"{sign}{axis}": s * row
    for axis, row in zip("xyz", np.eye(3), strict=True)
    for sign, s in (("+", 1), ("-", -1))
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
    path: pathlib.Path, *, joint: str = "RightHand", fingers: str = "-y", back: str = "+z"
) -> WristPath:
    """A wrist's path.

    Args:
      path: `.csv`, a line a frame: x, y, z (m) and a quaternion w, x, y, z; `.npz` with `position`
        (T, 3) and `quaternion` (T, 4), or a grasp motion; or `.bvh`.
      joint: name of the wrist joint in a BVH file.
      fingers: axis of the file's wrist frame along which the fingers point, such as +x.
      back: axis of that frame towards the back of the hand.

    Raises:
      CongraspError: the file cannot be read or has no such joint, or the axes are unknown or not
        orthogonal.
    """
    kind = path.suffix.lower()
    if not path.is_file():
        raise CongraspError(f"There is no file {path}.", "Name a CSV, NPZ or BVH file.")
    if kind == ".bvh":
        position, rotation, seconds = read_bvh(path, joint)
        position, rotation = _FROM_Y_UP.apply(position * _CM), _FROM_Y_UP * rotation
    elif kind in (".csv", ".npz"):
        position, quaternion = _npz(path) if kind == ".npz" else read_csv(path, _LARGEST)
        seconds = 0.01
        rotation = Rotation.from_quat(quaternion, scalar_first=True)
    else:
        raise CongraspError(f"{path} is neither CSV, NPZ nor BVH.", "Convert it to one of them.")
    for name in (fingers, back):
        if name not in _AXES:
            raise CongraspError(f"'{name}' is no axis.", f"Choose one of: {', '.join(_AXES)}.")
    if _AXES[fingers] @ _AXES[back]:
        raise CongraspError(
            f"Fingers along {fingers} and the back of the hand along {back} do not fit."
        )
    y, z = -_AXES[fingers], _AXES[back]
    own = Rotation.from_matrix(np.stack([np.cross(y, z), y, z], -1))
    return WristPath(position, rotation * own, seconds)


def read_bvh(path: pathlib.Path, joint: str) -> tuple[np.ndarray, Rotation, float]:
    """A joint's positions (T, 3) and orientations in a BVH file's own unit and axes, and seconds
    between frames.

    Raises:
      CongraspError: the file is damaged, or has no such joint; the message names the existing ones.
    """
    try:
        return _bvh(read_file(path, _LARGEST, "Cut it into shorter ones.").decode(), path, joint)
    except (ValueError, LookupError, StopIteration) as error:
        raise CongraspError(
            f"{path} cannot be read as BVH: {str(error)[:200] or 'it was cut'}.", "Export it again."
        ) from None


def _bvh(text: str, path: pathlib.Path, joint: str) -> tuple[np.ndarray, Rotation, float]:
    """Does the work of `read_bvh` for a file's text; ValueError, LookupError or StopIteration if it
    is damaged.
    """
    head, _, tail = text.partition("MOTION")
    chain, width, names = _chain(head, joint)
    if chain is None:
        raise CongraspError(
            f"{path} has no joint {ascii(joint)[:60]}.",
            f"Its joints are: {', '.join(names)[:2000]}.",
        )
    _, count, *_, seconds, rest = tail.split(maxsplit=5)
    rows = np.array(rest.split(), float).reshape(int(count), width)
    if not (np.isfinite(rows).all() and 0.0 < float(seconds) <= 1.0):
        raise ValueError(
            "it holds numbers that are not finite, or a frame takes more than a second"
        )
    position, rotation = np.zeros((len(rows), 3)), Rotation.identity(len(rows))
    for offset, channels, first in chain:
        values = rows[:, first : first + len(channels)]
        moved = np.tile(offset, (len(rows), 1))
        turn = Rotation.identity(len(rows))
        for channel, column in zip(channels, values.T, strict=True):
            axis, kind = channel[0].upper(), channel[1:].lower()
            if kind == "position":
                # A position takes the place of the offset, as most programs read it.
                moved[:, "XYZ".index(axis)] = column
            elif kind != "rotation":
                raise ValueError(f"it has the channel {channel[:30]}")
            else:
                turn = turn * Rotation.from_euler(axis, column[:, None], degrees=True)
        position = position + rotation.apply(moved)
        rotation = rotation * turn
    return position, rotation, float(seconds)


_Link = tuple[np.ndarray, list[str], int]


def _chain(text: str, joint: str) -> tuple[list[_Link] | None, int, list[str]]:
    """Offset (3,), channels and first column of each joint down to the named one; number of
    columns; all joints.
    """
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
            name = ""
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
        elif token == "}":
            stack.pop()
        if name == joint and token in ("OFFSET", "CHANNELS"):
            found = list(stack)
    return found, column, names


def read_csv(path: pathlib.Path, largest: int) -> tuple[np.ndarray, np.ndarray]:  # noqa: C901
    """Positions (T, 3) and quaternions (T, 4) of a CSV file's lines.

    A header, also in a comment, may name them in any order and among other columns, such as t, qx,
    qy, qz, qw, vx, vy, vz, px, py, pz, and positions in mm or cm: "x [mm]".

    Raises:
      CongraspError: the file has more than `largest` bytes or cannot be read, a line is not seven
        finite numbers, a header names no position or quaternion, or several, quaternions are not of
        length one, or its time runs back.
    """
    columns, width, metres, named, titled, mark = list(range(7)), 7, 1.0, False, False, ""
    clock, numbers, stamps = list[int](), list[int](), list[list[float | None]]()
    remedy = "Write x, y, z, qw, qx, qy, qz in every line."
    try:
        lines = read_file(path, largest, remedy).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise CongraspError(f"{path} is not text.", remedy) from None
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        comment = line.lstrip().startswith("#")
        text = line.strip(" #") if comment else line if named else line.partition("#")[0]
        advice = remedy
        try:
            if not (rows or named):
                if "length units" in text.lower():
                    raise ValueError(
                        "is of Motive, whose y axis may point up: export z up, in m, a header of "
                        "one line"
                    )
                header = _UNIT.sub(
                    lambda unit: f"[{unit[1].strip()}]", re.sub("(?<=[a-z])(?=[A-Z])", "_", text)
                )
                names = _cells(header.lower(), _mark(text))
                if comment or all(_number(name) is None for name in names):
                    advice = "Name them x, y, z, qw, qx, qy, qz."
                    if found := _columns(names, titled=titled):
                        (columns, width, metres), named, mark = found, True, _mark(text)
                        clock = _clock(names)
                    titled = titled or (any(names) and not comment)
                    continue
            if comment or not text.strip(" ,;\t"):
                continue
            if not rows:
                mark = mark if mark and mark in text else _mark(text)
            cells = _cells(text, mark)
            values = [_number(cells[column]) for column in columns if column < len(cells)]
            row = [value for value in values if value is not None and abs(value) < HUGE]
            if len(cells) < width or any(cells[width:]) or len(row) < 7:
                raise ValueError(f"is not {width} finite numbers")
        except (ValueError, csv.Error) as error:
            what = f"cannot be read: {error}" if isinstance(error, csv.Error) else error
            raise CongraspError(f"line {number} of {path} {what}.", advice) from None
        rows.append(row)
        numbers.append(number)
        stamps.append([_number(cells[place]) for place in clock])
    if not rows:
        raise CongraspError(f"{path} has no numbers.", remedy)
    _check_clock(path, numbers, stamps)
    table = np.array(rows)
    if np.abs(np.linalg.norm(table[:, 3:], axis=-1) - 1).max() > _UNIT_LENGTH:
        raise CongraspError(f"{path} holds quaternions that are not of length one.", remedy)
    return metres * table[:, :3], table[:, 3:]


def _clock(names: list[str]) -> list[int]:
    """Places of a header's first clock: of seconds and nanoseconds of one name, or of one column;
    none without.
    """
    first = next((place for place, name in enumerate(names) if _TIME.fullmatch(name)), None)
    if first is None:
        return []
    for own, other in itertools.permutations((_SECONDS, _NANOSECONDS)):
        if found := own.fullmatch(names[first]):
            for place, name in enumerate(names):
                if (partner := other.fullmatch(name)) and partner[1] == found[1]:
                    return [first, place] if own is _SECONDS else [place, first]
    return [first]


def _check_clock(path: pathlib.Path, numbers: list[int], stamps: list[list[float | None]]) -> None:
    """Raises a `CongraspError` for the first of these lines whose time runs back by more than
    jitter.
    """
    clock = np.array(stamps, float)
    if not clock.size:
        return
    finite = np.isfinite(clock).all(-1)
    lines, clock = np.array(numbers)[finite], clock[finite]
    # Not a whole time next to one in seconds
    whole = clock.shape[1] == 2 and clock[:, 1].max(initial=0.0) < _SECOND
    late = runs_back(clock[:, 0] + clock[:, 1] / _SECOND if whole else clock[:, 0])
    if late.any():
        what = f"line {lines[late.argmax()]} of {path} is earlier than one before."
        raise CongraspError(what, "Sort the lines by time, and cut the file to one motion.")


def _mark(line: str) -> str:
    """The separator of a line's cells; empty for blanks."""
    return next((mark for mark in ";\t," if mark in line), "")


def _cells(line: str, mark: str) -> list[str]:
    """The cells of a line; with semicolons between them, decimal commas become points."""
    cells = (
        next(csv.reader([line], delimiter=mark, skipinitialspace=True), [])
        if mark
        else line.split()
    )
    return [cell.strip(" '\"").replace(",", "." if mark == ";" else ",") for cell in cells]


def _columns(names: list[str], *, titled: bool) -> tuple[list[int], int, float] | None:
    """Places of x, y, z and the quaternion w, x, y, z in a header, the number of its columns, and
    metres per unit.

    Columns of one name before their letters belong together: with w they are a quaternion, whose
    position shares most leading words with it. None for other text.

    Raises:
      ValueError: it names no position or no quaternion, or several, or a name twice below a title.
    """
    while names and not names[-1]:
        names = names[:-1]
    groups: dict[str, list[dict[str, tuple[int, str]]]] = {}
    for place, name in enumerate(names):
        if lettered := _LETTERED.search(name):
            letter, bracketed, suffix = lettered.groups()
            body = " ".join(_SEPARATOR.split(name[: lettered.start()])).strip()
            same = groups.setdefault(body, [{}])
            if letter in same[-1] or (
                letter == "w" and not body and len(same) == 1 and len(same[0]) == 3
            ):
                same.append({})  # of columns x, y, z, w, x, y, z
            same[-1][letter] = (place, bracketed or suffix or "m")
    whole = [(name, group) for name, same in groups.items() for group in same]
    turns = [(name, group) for name, group in whole if group.keys() == set("wxyz")]
    places = [(name, group) for name, group in whole if group.keys() == set("xyz")]
    if not (places or turns or len(_NUMBERED.findall(",".join(names))) > 3):
        return None
    if titled and any(len(same) > 1 for same in groups.values()):
        raise ValueError("names columns twice below another line: it needs a header of one line")
    # As m s^-1
    rates = [
        group for _, group in places if any(set(unit) & set("/^") for _, unit in group.values())
    ]
    places = [one for one in places if not (_NO_PLACE.fullmatch(one[0]) or one[1] in rates)]
    if len(turns) == 1:
        turned = turns[0][0]
        shared = [_shared(name.split(), turned.split()) for name, _ in places]
        most = max(shared, default=0)
        places = [one for one, words in zip(places, shared, strict=True) if words == most]
        bodies = [name.partition(" ")[0] for name in (*dict(places[:1]), turned)]
        if not most and len(places) == 1 and not any(map(_KIND.fullmatch, bodies)):
            raise ValueError(
                f"names the position of '{bodies[0]}', but the quaternion of '{bodies[1]}'"
            )
    for what, some in (("position", places), ("quaternion", turns)):
        if len(some) != 1:
            several = f"several {what}s: {', '.join(name or 'x, y, z' for name, _ in some)}"
            raise ValueError(f"names {several[:300] if some else f'no {what}'}")
    (_, position), (_, turn) = places[0], turns[0]
    units = {position[letter][1] for letter in "xyz"}
    if not (len(units) == 1 and units <= METRES.keys()):
        raise ValueError(
            f"names positions in {' and '.join(sorted(units))}, not all in one of "
            f"{', '.join(METRES)}"
        )
    columns = [position[letter][0] for letter in "xyz"] + [turn[letter][0] for letter in "wxyz"]
    return columns, len(names), METRES[units.pop()]


def _shared(first: list[str], second: list[str]) -> int:
    """Number of leading words that two names have in common."""
    return len(
        list(itertools.takewhile(lambda pair: pair[0] == pair[1], zip(first, second, strict=False)))
    )


def _number(word: str) -> float | None:
    """The number in a word, also one that is not finite."""
    try:
        return float(word)
    except ValueError:
        return None


def _npz(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 3) and unit quaternions (T, 4) of an NPZ file."""
    try:
        data = read_npz(path, remedy := "It needs 'position' and 'quaternion'.")
        prefix = "wrist_" if "wrist_position" in data else ""
        meanings = {f"{prefix}position": "(T, 3) m", f"{prefix}quaternion": "(T, 4) w x y z"}
        check_arrays(data, meanings, indices=(), largest=HUGE)
    except (KeyError, ValueError) as error:
        raise CongraspError(f"{path} cannot be read: {error}.", remedy) from None
    position, quaternion = (data[name].astype(float) for name in meanings)
    if np.abs(np.linalg.norm(quaternion, axis=-1) - 1).max() > _UNIT_LENGTH:
        raise CongraspError(
            f"{path} holds quaternions that are not of length one.",
            "Write w, x, y, z, of length one.",
        )
    return position, quaternion
