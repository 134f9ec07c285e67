"""Wrist paths in CSV files, with or without a header that names the columns."""

import csv
import pathlib
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import CongraspError
from congrasp.common.io.arrays import runs_back
from congrasp.common.io.inputs import read_file
from congrasp.services.grasp.csv_header import (
    Columns,
    clock_columns,
    header_names,
    number_in,
    pose_columns,
)

UNIT_LENGTH = 0.01
"""Tolerance of a quaternion's length: positions in its place differ more."""
HUGE = 1e9
"""Bound on angles, positions and quaternion components."""
_NANOSECONDS_PER_SECOND = 1e9
_WRITE_ROWS = "Write x, y, z, qw, qx, qy, qz in every line."
_NAME_COLUMNS = "Name them x, y, z, qw, qx, qy, qz."
_PLAIN = Columns(pose=list(range(7)), width=7, metres=1.0)
"""Columns of a file without a header."""


class _Refusal(Exception):
    """Fault of a line as text, and its remedy."""

    def __init__(self, fault: str, remedy: str):
        super().__init__(fault)
        self.remedy = remedy


class _Line(NamedTuple):
    """A line with numbers."""

    number: int
    """In the file, from 1 on."""
    pose: list[float]
    """Position in the file's unit, and quaternion w, x, y, z."""
    stamp: list[float | None]
    """Time, in the columns of the clock."""


class _Reader:
    """Reads lines from first to last; a header determines the meaning of the lines after it."""

    def __init__(self) -> None:
        """Expects the columns of a file without a header."""
        self.columns = _PLAIN
        self.lines: list[_Line] = []
        self._clock: list[int] = []
        self._is_named = False
        """A header names the columns."""
        self._has_title = False
        """A line of words precedes."""
        self._separator = ""

    def read(self, number: int, line: str) -> None:
        """Reads a line.

        Raises:
          _Refusal: it cannot be understood.
        """
        is_comment = line.lstrip().startswith("#")
        text = self._text_of(line, is_comment)
        if not self.lines and not self._is_named and self._read_header(text, is_comment):
            return
        if is_comment or not text.strip(" ,;\t"):
            return
        self.lines.append(self._numbers(number, text))

    def _text_of(self, line: str, is_comment: bool) -> str:
        """A line's text: that of a comment, or what precedes one; under a header all is text."""
        if is_comment:
            return line.strip(" #")
        if self._is_named:
            return line
        return line.partition("#")[0]

    def _read_header(self, text: str, is_comment: bool) -> bool:
        """Reads a line before the first numbers; returns False for numbers."""
        if "length units" in text.lower():
            fault = (
                "is of Motive, whose y axis may point up: export z up, in m, a header of one line"
            )
            raise _Refusal(fault, _WRITE_ROWS)
        separator = separator_of(text)
        try:
            names = cells_of(header_names(text), separator)
        except csv.Error as error:
            raise _Refusal(f"cannot be read: {error}", _WRITE_ROWS) from None
        if not is_comment and any(number_in(name) is not None for name in names):
            return False
        try:
            columns = pose_columns(names, titled=self._has_title)
        except ValueError as error:
            raise _Refusal(str(error), _NAME_COLUMNS) from None
        if columns is not None:
            self.columns = columns
            self._is_named = True
            self._separator = separator
            self._clock = clock_columns(names)
        if any(names) and not is_comment:
            self._has_title = True
        return True

    def _numbers(self, number: int, text: str) -> _Line:
        """The numbers of a line."""
        if not self.lines and not (self._separator and self._separator in text):
            self._separator = separator_of(text)
        try:
            cells = cells_of(text, self._separator)
        except csv.Error as error:
            raise _Refusal(f"cannot be read: {error}", _WRITE_ROWS) from None
        pose = []
        for column in self.columns.pose:
            value = number_in(cells[column]) if column < len(cells) else None
            if value is not None and abs(value) < HUGE:
                pose.append(value)
        width = self.columns.width
        if len(cells) < width or any(cells[width:]) or len(pose) < len(self.columns.pose):
            raise _Refusal(f"is not {width} finite numbers", _WRITE_ROWS)
        stamp = []
        for column in self._clock:
            stamp.append(number_in(cells[column]))
        return _Line(number, pose, stamp)


def read_csv(path: pathlib.Path, max_bytes: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 3) in m and quaternions (T, 4) of a CSV file's lines.

    A header, also in a comment, may name them in any order and among other columns, such as t, qx,
    qy, qz, qw, vx, vy, vz, px, py, pz, and positions in mm or cm: "x [mm]".

    Raises:
      CongraspError: the file has more than `max_bytes` bytes or cannot be read, a line is not seven
        finite numbers, a header names no position or quaternion, or several, quaternions are not of
        length one, or its time runs back.
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
    return reader.columns.metres * table[:, :3], table[:, 3:]


def separator_of(line: str) -> str:
    """The separator of a line's cells; empty for blanks."""
    return next((separator for separator in ";\t," if separator in line), "")


def cells_of(line: str, separator: str) -> list[str]:
    """The cells of a line; with semicolons between them, decimal commas become points."""
    if separator:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    else:
        cells = line.split()
    decimal_comma = "." if separator == ";" else ","
    return [cell.strip(" '\"").replace(",", decimal_comma) for cell in cells]


def _check_clock(path: pathlib.Path, lines: list[_Line]) -> None:
    """Raises a `CongraspError` for the first of these lines whose time runs back by more than
    jitter.
    """
    clock = np.array([line.stamp for line in lines], float)
    if not clock.size:
        return
    finite = np.isfinite(clock).all(-1)
    numbers = np.array([line.number for line in lines])[finite]
    clock = clock[finite]
    seconds = clock[:, 0]
    # A second column with as many nanoseconds is a whole time, not the rest of a second.
    if clock.shape[1] == 2 and clock[:, 1].max(initial=0.0) < _NANOSECONDS_PER_SECOND:
        seconds = seconds + clock[:, 1] / _NANOSECONDS_PER_SECOND
    late = runs_back(seconds)
    if late.any():
        fault = f"line {numbers[late.argmax()]} of {path} is earlier than a line above it."
        raise CongraspError(fault, "Sort the lines by time, and keep only one motion in the file.")
