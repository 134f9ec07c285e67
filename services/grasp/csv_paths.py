"""Wrist paths in CSV files, with the header of a known recorder or without one."""

import csv
import pathlib
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.arrays import runs_back
from congrasp.common.io.inputs import read_file
from congrasp.services.grasp.csv_recorders import HEADER, PLAIN, Columns, columns_of

UNIT_LENGTH = 0.01
"""Tolerance of a quaternion's length: positions in its place differ more."""
HUGE = 1e9
"""Bound on angles, positions and quaternion components."""
_WRITE_ROWS = "Write x, y, z, qw, qx, qy, qz in every line."
_NAME_COLUMNS = f"Name the columns {HEADER} (positions in m), or as a recorder in docs/grasp.md."


class _Refusal(Exception):
    """Fault of a line as text, and its remedy."""

    def __init__(self, fault: str, remedy: str = _WRITE_ROWS):
        super().__init__(fault)
        self.remedy = remedy


class _Line(NamedTuple):
    """A line with numbers."""

    number: int
    """In the file, from 1 on."""
    pose: list[float]
    """Position in m, and quaternion w, x, y, z."""
    time: float | None
    """In the unit of the file; None without a number."""


class _Reader:
    """Reads lines from first to last; a header determines the meaning of the lines after it."""

    def __init__(self) -> None:
        """Expects a header, or the columns of a file without one."""
        self.lines: list[_Line] = []
        self._columns: Columns | None = None
        self._separator = ""
        """Separator of the header, then of the numbers."""
        self._comment_cells: list[str] = []
        """Cells of the comment before the numbers, which may be a header that is not known."""

    def read(self, number: int, line: str) -> None:
        """Reads a line.

        Raises:
          _Refusal: it cannot be understood.
        """
        is_comment = line.lstrip().startswith("#")
        text = self._text_of(line, is_comment)
        if not text.strip(" ,;\t"):
            return
        if self._columns is None and self._read_header(text, is_comment):
            return
        if is_comment:
            return
        self.lines.append(self._numbers(number, text))

    def _text_of(self, line: str, is_comment: bool) -> str:
        """A line's text: that of a comment, or what precedes one; under a header all is text."""
        if is_comment:
            return line.strip(" #")
        if self._columns in (None, PLAIN):
            return line.partition("#")[0]
        return line

    def _read_header(self, text: str, is_comment: bool) -> bool:
        """Reads a line before the first numbers; returns False for numbers."""
        if "length units" in text.lower():
            raise _Refusal(
                "is of Motive, whose y axis may point up: export z up, in m, a header of one line"
            )
        separator = separator_of(text)
        names = cells_of(text, separator)
        while names and not names[-1]:
            names.pop()
        try:
            columns = columns_of(names)
        except ValueError as error:
            raise _Refusal(str(error), _NAME_COLUMNS) from None
        if columns is not None:
            self._columns = columns
            self._separator = separator
            return True
        if is_comment:
            self._comment_cells = names
            return True
        if all(_number(name) is None for name in names):
            raise _Refusal("is a header of no known recorder", _NAME_COLUMNS)
        if len(names) == len(self._comment_cells):
            raise _Refusal("follows a header of no known recorder", _NAME_COLUMNS)
        self._columns = PLAIN
        return False

    def _numbers(self, number: int, text: str) -> _Line:
        """The numbers of a line."""
        columns = self._columns or PLAIN
        if not self.lines and not (self._separator and self._separator in text):
            self._separator = separator_of(text)
        cells = cells_of(text, self._separator)
        pose = []
        for column in columns.pose:
            value = _number(cells[column]) if column < len(cells) else None
            if value is not None and abs(value) < HUGE:
                pose.append(value)
        width = columns.width
        if len(cells) < width or any(cells[width:]) or len(pose) < len(columns.pose):
            raise _Refusal(f"is not {width} finite numbers")
        time = None if columns.time is None else _number(cells[columns.time])
        return _Line(number, pose, time)


def read_csv(path: pathlib.Path, max_bytes: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 3) in m and quaternions (T, 4) of a CSV file's lines.

    A header, also in a comment, names the columns as one of `csv_recorders.RECORDERS` does, in any
    order and among others. Without one, a line is x, y, z and the quaternion w, x, y, z.

    Raises:
      CongraspError: the file has more than `max_bytes` bytes or cannot be read, a line is not seven
        finite numbers, the header is unknown or ambiguous, quaternions are not of length one, or
        its time runs back.
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
    if np.abs(np.linalg.norm(table[:, 3:], axis=-1) - 1).max() > UNIT_LENGTH:
        raise CongraspError(f"{path} has quaternions whose length is not one.", _WRITE_ROWS)
    return table[:, :3], table[:, 3:]


def separator_of(line: str) -> str:
    """The separator of a line's cells; empty for blanks."""
    return next((separator for separator in ";\t," if separator in line), "")


def cells_of(line: str, separator: str) -> list[str]:
    """The cells of a line; with semicolons between them, decimal commas become points.

    Raises:
      _Refusal: a cell is too long.
    """
    if not separator:
        return line.split()
    try:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error as error:
        raise _Refusal(f"cannot be read: {error}") from None
    decimal_comma = "." if separator == ";" else ","
    return [cell.strip(" '\"").replace(",", decimal_comma) for cell in cells]


def _number(word: str) -> float | None:
    """The number in a word, also one that is not finite; None for other text."""
    try:
        return float(word)
    except ValueError:
        return None


def _check_clock(path: pathlib.Path, lines: list[_Line]) -> None:
    """Raises a `CongraspError` for the first of these lines whose time runs back by more than
    jitter.
    """
    times = np.array([line.time for line in lines], float)
    is_finite = np.isfinite(times)
    numbers = np.array([line.number for line in lines])[is_finite]
    late = runs_back(times[is_finite])
    if late.any():
        fault = f"line {numbers[late.argmax()]} of {path} is earlier than a line above it."
        raise CongraspError(fault, "Sort the lines by time, and keep only one motion in the file.")
