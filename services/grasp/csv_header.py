"""Meaning of the columns that the header of a CSV file names.

Columns of one name before their letters belong together: "px, py, pz" are a position, "qx, qy, qz,
qw" a quaternion.
"""

import itertools
import re
from typing import NamedTuple

from congrasp.services.assets.objects.units import METRES

_UNIT = re.compile(r" ?[\[(]([^][()]*)[])]")
_LETTERED = re.compile(r"([wxyz]) *(?:\[([^][]*)\]|_(m|mm|cm|in))?$")
"""Letter and unit at the end of a column's name."""
_SEPARATOR = re.compile(r"[\W_]+")
_NO_PLACE = re.compile(
    # A position between two frames, in one of them, as p_RS_R of EuRoC
    r"(?!p [a-z]?([a-z])[a-z]? \1$)"
    r"(?:.* )?(?:[vawfnre]|(?:vel|speed|acc|linear|linv|ang|gyro|force|torq|rot|euler|normal|"
    r"omega|twist|wrench).*)"
)
_KIND = re.compile(r"|[ptcqo]|pos.*|trans.*|loc.*|cent.*|quat.*|rot.*|ori.*|att.*")
"""First word of a name without a body."""
_TIME = re.compile(
    r"(?:.*[.%])?(?:t|time|(?:time[_ ]?)?stamp|secs?|seconds?)"
    r"(?: ?\[.*|[_ ](?:[mnuµ]?s|secs?|seconds?))?"
)
_SECONDS = re.compile(r"(.*?)(?:(?<=[_ ])s|secs?|seconds?)")
_NANOSECONDS = re.compile(r"(.*?)(?:(?<=[_ ])ns|n(?:ano)?(?:secs?|seconds?))")
_NUMBERED = re.compile(r"\bq\w*[\s.]?\d\b")
_MAX_QUOTED = 300
"""Largest number of characters of names in a message."""


class Columns(NamedTuple):
    """Columns of a pose."""

    pose: list[int]
    """Those of x, y, z and the quaternion w, x, y, z."""
    width: int
    """Number of columns of the file."""
    metres: float
    """Metres per unit of the position."""


class _Column(NamedTuple):
    """A column whose name ends in one of the letters w, x, y, z."""

    position: int
    unit: str


class _Group(NamedTuple):
    """Columns whose names differ in their last letter only."""

    name: str
    columns: dict[str, _Column]
    """By their letters."""


def header_names(text: str) -> str:
    """A header in lower case, with words of camel case apart and units in square brackets."""
    apart = re.sub("(?<=[a-z])(?=[A-Z])", "_", text)
    return _UNIT.sub(lambda unit: f"[{unit[1].strip()}]", apart).lower()


def number_in(word: str) -> float | None:
    """The number in a word, also one that is not finite; None for other text."""
    try:
        return float(word)
    except ValueError:
        return None


def clock_columns(names: list[str]) -> list[int]:
    """Columns of a header's first clock: of seconds and nanoseconds of one name, or of one column;
    none without a clock.
    """
    first = next((index for index, name in enumerate(names) if _TIME.fullmatch(name)), None)
    if first is None:
        return []
    nanoseconds = _partner(names, names[first], _SECONDS, _NANOSECONDS)
    if nanoseconds is not None:
        return [first, nanoseconds]
    seconds = _partner(names, names[first], _NANOSECONDS, _SECONDS)
    if seconds is not None:
        return [seconds, first]
    return [first]


def pose_columns(names: list[str], *, titled: bool) -> Columns | None:
    """Columns of position and quaternion in a header; None for other text.

    Of several positions, that counts which shares most leading words with the quaternion.

    Args:
      names: names of the columns, from `header_names`.
      titled: another line of words precedes the header.

    Raises:
      ValueError: it names no position or no quaternion, or several, or a name twice below a title.
    """
    while names and not names[-1]:
        names = names[:-1]
    groups = _groups(names)
    quaternions = [group for group in groups if group.columns.keys() == set("wxyz")]
    positions = [group for group in groups if group.columns.keys() == set("xyz")]
    is_header = len(_NUMBERED.findall(",".join(names))) > 3
    if not (positions or quaternions or is_header):
        return None
    if titled and len({group.name for group in groups}) < len(groups):
        raise ValueError("names columns twice below another line: it needs a header of one line")
    positions = [group for group in positions if _is_position(group)]
    if len(quaternions) == 1:
        positions = _of_body(positions, quaternions[0])
    _check_single("position", positions)
    _check_single("quaternion", quaternions)
    position = positions[0].columns
    quaternion = quaternions[0].columns
    indices = [position[letter].position for letter in "xyz"]
    indices += [quaternion[letter].position for letter in "wxyz"]
    return Columns(indices, len(names), METRES[_unit_of(positions[0])])


def _partner(
    names: list[str], name: str, kind: re.Pattern[str], other: re.Pattern[str]
) -> int | None:
    """Column of the other kind whose name begins like a name of this kind; None without one."""
    match = kind.fullmatch(name)
    if match is None:
        return None
    for index, candidate in enumerate(names):
        partner = other.fullmatch(candidate)
        if partner and partner[1] == match[1]:
            return index
    return None


def _groups(names: list[str]) -> list[_Group]:
    """Groups of columns; a letter that comes again begins another group of its name."""
    by_name: dict[str, list[_Group]] = {}
    for index, name in enumerate(names):
        lettered = _LETTERED.search(name)
        if lettered is None:
            continue
        letter, bracketed, suffix = lettered.groups()
        body = " ".join(_SEPARATOR.split(name[: lettered.start()])).strip()
        same = by_name.setdefault(body, [_Group(body, {})])
        # Columns x, y, z, w, x, y, z are a position and a quaternion.
        begins_quaternion = (
            letter == "w" and not body and len(same) == 1 and len(same[0].columns) == 3
        )
        if letter in same[-1].columns or begins_quaternion:
            same.append(_Group(body, {}))
        same[-1].columns[letter] = _Column(index, bracketed or suffix or "m")
    groups = []
    for same in by_name.values():
        groups += same
    return groups


def _is_position(group: _Group) -> bool:
    """False for a velocity, a force or another vector, by its name or by a unit such as m s^-1."""
    if _NO_PLACE.fullmatch(group.name):
        return False
    return not any(set(column.unit) & set("/^") for column in group.columns.values())


def _of_body(positions: list[_Group], quaternion: _Group) -> list[_Group]:
    """Positions that share most leading words with a quaternion.

    Raises:
      ValueError: the only position is one of another body.
    """
    shared = [_shared_words(group.name, quaternion.name) for group in positions]
    most = max(shared, default=0)
    nearest = [group for group, words in zip(positions, shared, strict=True) if words == most]
    if most or len(nearest) != 1:
        return nearest
    body = nearest[0].name.partition(" ")[0]
    other = quaternion.name.partition(" ")[0]
    if not _KIND.fullmatch(body) and not _KIND.fullmatch(other):
        raise ValueError(f"names the position of '{body}', but the quaternion of '{other}'")
    return nearest


def _check_single(kind: str, groups: list[_Group]) -> None:
    """Raises a ValueError unless there is one group of a kind."""
    if not groups:
        raise ValueError(f"names no {kind}")
    if len(groups) > 1:
        names = ", ".join(group.name or "x, y, z" for group in groups)
        raise ValueError(f"names several {kind}s: {names}"[: _MAX_QUOTED + len("names ")])


def _unit_of(position: _Group) -> str:
    """The unit of a position.

    Raises:
      ValueError: its columns have several units, or an unknown one.
    """
    units = {column.unit for column in position.columns.values()}
    if len(units) > 1 or not units <= METRES.keys():
        raise ValueError(
            f"names positions in {' and '.join(sorted(units))}, not all in one of "
            f"{', '.join(METRES)}"
        )
    return units.pop()


def _shared_words(first: str, second: str) -> int:
    """Number of leading words that two names have in common."""
    pairs = zip(first.split(), second.split(), strict=False)
    return len(list(itertools.takewhile(lambda pair: pair[0] == pair[1], pairs)))
