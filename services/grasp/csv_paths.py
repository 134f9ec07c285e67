"""Wrist paths in CSV files, with the header of a known recorder or without one."""

import csv
import pathlib
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.arrays import runs_back
from congrasp.common.io.inputs import read_file
from congrasp.services.grasp.csv_recorders import HEADER, PLAIN, Columns, columns_of

NORM_TOLERANCE = 0.01
"""Tolerance of a quaternion's norm, which tells quaternions from other numbers in their columns."""
MAX_MAGNITUDE = 1e9
"""Magnitude from which on positions (m), angles (rad) and quaternion components are rejected."""
_WRITE_ROWS = "Write x, y, z, qw, qx, qy, qz in every line."
_NAME_COLUMNS = f"Name the columns {HEADER} (positions in m), or as a recorder in docs/grasp.md."
_MAX_QUOTED = 40
"""Characters of a cell that a message quotes."""


class _Refusal(Exception):
    """Fault of a line, and its remedy.

    The fault is a predicate: `read_csv` writes "line N of FILE" before it.
    """

    def __init__(self, fault: str, remedy: str = _WRITE_ROWS):
        super().__init__(fault)
        self.remedy = remedy


class _Line(NamedTuple):
    """A line with numbers."""

    number: int
    """Number of the line in the file, from 1 on."""
    pose: list[float]
    """Position in m, and quaternion w, x, y, z."""
    time: float | None
    """Time in the unit of the file; None if the line has no time."""


class _Comment(NamedTuple):
    """A comment before the first numbers, which may be the header of an unknown recorder."""

    cells: list[str]
    separator: str


class _Reader:
    """Reads the lines of a file in order.

    Lines before the first numbers may be comments or a header. The header of a known recorder
    determines the columns; without one, they are `PLAIN`.
    """

    def __init__(self) -> None:
        """Starts before the first line of a file."""
        self.lines: list[_Line] = []
        self._columns: Columns | None = None
        """Columns of the numbers; None before the header, or before the first numbers if there is
        none.
        """
        self._separator = ""
        """Separator of the header's cells, then of the first numbers' cells; empty for blanks."""
        self._last_comment = _Comment([], "")

    def read(self, number: int, line: str) -> None:
        """Reads a line.

        Raises:
          _Refusal: it cannot be understood.
        """
        is_comment = line.lstrip().startswith("#")
        text = self._text_of(line, is_comment)
        if not text.strip(" ,;\t"):
            return
        if self._columns is not None:
            if not is_comment:
                self.lines.append(self._numbers(number, text, self._columns))
            return
        separator = _separator_of(text)
        cells = _cells_of(text, separator)
        while cells and not cells[-1]:
            cells.pop()
        header = _header_of(cells)
        if header is not None:
            self._columns = header
            self._separator = separator
            return
        if is_comment:
            self._last_comment = _Comment(cells, separator)
            return
        self._check_first_numbers(cells, separator)
        self._columns = PLAIN
        self.lines.append(self._numbers(number, text, PLAIN))

    def _text_of(self, line: str, is_comment: bool) -> str:
        """Returns the text of a comment, or of another line without a comment at its end.

        In a file with columns other than `PLAIN`, `#` may be part of a text column. A comment is
        then a whole line.
        """
        if is_comment:
            return line.strip(" \t#")
        if self._columns in (None, PLAIN):
            return line.partition("#")[0]
        return line

    def _check_first_numbers(self, cells: list[str], separator: str) -> None:
        """Checks the first line that is neither a comment nor a known header.

        Raises:
          _Refusal: it has no number, or the comment before it looks like an unknown header: it has
            as many cells as this line, the same separator, and no number.
        """
        if not _has_number(cells):
            raise _Refusal("is a header of no known recorder", _NAME_COLUMNS)
        comment = self._last_comment
        is_like_numbers = len(comment.cells) == len(cells) and comment.separator == separator
        if is_like_numbers and not _has_number(comment.cells):
            raise _Refusal("follows a header of no known recorder", _NAME_COLUMNS)

    def _numbers(self, number: int, text: str, columns: Columns) -> _Line:
        """Returns the numbers of a line.

        Raises:
          _Refusal: it has too few or too many cells, or one of the pose is not a finite number.
        """
        is_first = not self.lines
        has_header_separator = bool(self._separator) and self._separator in text
        if is_first and not has_header_separator:
            self._separator = _separator_of(text)
        cells = _cells_of(text, self._separator)
        if len(cells) < columns.width or any(cells[columns.width :]):
            raise _Refusal(f"has {len(cells)} cells instead of {columns.width}")
        pose = [_pose_number(cells, column) for column in columns.pose]
        time = None if columns.time is None else _number(cells[columns.time])
        return _Line(number, pose, time)


def read_csv(path: pathlib.Path, max_bytes: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the positions (T, 3) in m and quaternions (T, 4) of the T lines of a CSV file.

    A header, also in a comment, names the columns as one of `csv_recorders.RECORDERS` does, in any
    order and among others. Without one, a line is x, y, z and the quaternion w, x, y, z.

    Raises:
      CongraspError: the file has more than `max_bytes` bytes or cannot be read, a line has too few
        or too many cells or a pose that is not seven finite numbers, the header is unknown or
        ambiguous, the norm of a quaternion is not 1, or the time runs back.
    """
    try:
        text = read_file(path, max_bytes, _WRITE_ROWS).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise CongraspError(f"{path} is not text.", _WRITE_ROWS) from None
    reader = _Reader()
    for number, line in enumerate(text.splitlines(), 1):
        try:
            reader.read(number, line)
        except _Refusal as refusal:
            raise CongraspError(f"line {number} of {path} {refusal}.", refusal.remedy) from None
    if not reader.lines:
        raise CongraspError(f"{path} has no numbers.", _WRITE_ROWS)
    _check_clock(path, reader.lines)
    table = np.array([line.pose for line in reader.lines])
    if np.abs(np.linalg.norm(table[:, 3:], axis=-1) - 1).max() > NORM_TOLERANCE:
        raise CongraspError(f"{path} has quaternions whose length is not one.", _WRITE_ROWS)
    return table[:, :3], table[:, 3:]


def _separator_of(line: str) -> str:
    """Returns the separator of a line's cells; empty for blanks."""
    return next((separator for separator in ";\t," if separator in line), "")


def _cells_of(line: str, separator: str) -> list[str]:
    """Returns the cells of a line; with semicolons between them, decimal commas become points.

    Raises:
      _Refusal: a cell is too long.
    """
    if not separator:
        return line.split()
    try:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error as error:
        raise _Refusal(f"cannot be read: {error}") from None
    cells = [cell.strip(" '\"") for cell in cells]
    if separator == ";":
        return [cell.replace(",", ".") for cell in cells]
    return cells


def _header_of(cells: list[str]) -> Columns | None:
    """Returns the columns that a line names; None if it is not the header of a known recorder.

    Raises:
      _Refusal: it is the header of several recorders, or of one whose files cannot be read.
    """
    if "length units" in [cell.lower() for cell in cells]:
        raise _Refusal(
            "is of Motive, whose y axis may point up: export z up, in m, a header of one line"
        )
    try:
        return columns_of(cells)
    except ValueError as error:
        raise _Refusal(str(error), _NAME_COLUMNS) from None


def _has_number(cells: list[str]) -> bool:
    """True if a cell is a number, also one that is not finite."""
    return any(_number(cell) is not None for cell in cells)


def _pose_number(cells: list[str], column: int) -> float:
    """Returns the number in the column with this index, from 0 on.

    Raises:
      _Refusal: it is not a number, or is too large.
    """
    value = _number(cells[column])
    if value is not None and abs(value) < MAX_MAGNITUDE:
        return value
    cell = ascii(cells[column][:_MAX_QUOTED])
    raise _Refusal(f"has {cell} in column {column + 1}, which is not a finite number")


def _number(text: str) -> float | None:
    """Returns the number in a cell, also one that is not finite; None for other text."""
    try:
        return float(text)
    except ValueError:
        return None


def _check_clock(path: pathlib.Path, lines: list[_Line]) -> None:
    """Raises a CongraspError for the first line whose time is more than jitter before an earlier
    line's.
    """
    times = np.array([line.time for line in lines], float)
    is_finite = np.isfinite(times)
    numbers = np.array([line.number for line in lines])[is_finite]
    late = runs_back(times[is_finite])
    if late.any():
        fault = f"line {numbers[late.argmax()]} of {path} is earlier than a line above it."
        raise CongraspError(fault, "Sort the lines by time, and keep only one motion in the file.")
