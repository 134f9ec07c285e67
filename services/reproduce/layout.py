"""Cells as lines of text, for the page and for LaTeX."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from congrasp.services.evaluate.paper import TABLES
from congrasp.services.evaluate.scores import UNITS
from congrasp.services.reproduce.comparison import SUCCESS, Cell

COLUMNS = (
    ("constraint", ""),
    ("hand", ""),
    ("method", ""),
    ("objects", ""),
    ("episodes", ""),
    ("success, %", "verdict"),
    ("paper", "paper"),
    ("difference", ""),
    ("error", "errors"),
    ("paper", "errors paper"),
    ("difference", "errors"),
)
"""Names of columns, and of their styles."""
NONE = "\N{EN DASH}"
"""Placeholder for a missing figure."""
_OBJECTS, _ERRORS = slice(3, 4), slice(8, 11)
"""Columns that some tables omit."""


class Line(NamedTuple):
    """Figures of one line of the paper."""

    cells: tuple[str, ...]
    """Cells by the table's columns."""
    verdict: str
    """Verdict on success: better, worse or empty."""


class Table(NamedTuple):
    """One of the paper's tables."""

    title: str
    columns: list[tuple[str, str]]
    """Columns of `COLUMNS` that are not empty."""
    lines: list[Line]


def tables(cells: Sequence[Cell]) -> list[Table]:
    """Returns all of the paper's tables, with all of their lines."""
    found = []
    for name, title in TABLES.items():
        lines = _lines([cell for cell in cells if cell.table == name])
        without = [columns for columns in (_OBJECTS, _ERRORS) if not _has(lines, columns)]
        shown = [i for i in range(len(COLUMNS)) if not any(i in range(len(COLUMNS))[columns] for columns in without)]
        lines = [Line(tuple(line.cells[i] for i in shown), line.verdict) for line in lines]
        found.append(Table(title, [COLUMNS[i] for i in shown], lines))
    return found


def not_comparable(cells: Sequence[Cell]) -> list[tuple[str, str, str]]:
    """Lines without a comparable figure: description, reason, and the nearest measured success."""
    return [
        (
            f"{TABLES[cell.table]}: {cell.constraint}, {cell.hand}, {cell.method}"
            + (f", {cell.group} objects" if cell.group else ""),
            cell.reason,
            NONE if cell.nearest is None else f"{100 * cell.nearest:.1f} % ({100 * cell.paper:.1f} % in the paper)",
        )
        for cell in cells
        if cell.ours is None and cell.quantity == SUCCESS
    ]


def _has(lines: Sequence[Line], columns: slice) -> bool:
    """True if any of these columns is not empty."""
    return any(cell != NONE for line in lines for cell in line.cells[columns])


def _lines(cells: Sequence[Cell]) -> list[Line]:
    """One line for each constraint, hand, method, size and data set."""
    found: dict[tuple[str, ...], list[Cell]] = {}
    for cell in cells:
        found.setdefault((cell.constraint, cell.hand, cell.method, cell.group, cell.data), []).append(cell)
    lines = []
    for (constraint, hand, method, group, data), own in found.items():
        success, *errors = own
        objects = ", ".join(part for part in (group or ("all" if success.table == "objects" else ""), data) if part)
        rate = (_percent(success), f"{100 * success.paper:.1f}", _difference(success))
        error = tuple(_joined(errors, show) for show in (_error, lambda cell: f"{cell.paper:.3f}", _difference))
        episodes = str(success.episodes or NONE)
        lines.append(Line((constraint, hand, method, objects or NONE, episodes, *rate, *error), success.verdict))
    return lines


def _joined(errors: Sequence[Cell], show: Callable[[Cell], str]) -> str:
    """Joins all errors of a line with their units."""
    if all(show(cell) == NONE for cell in errors):
        return NONE
    return " / ".join(f"{show(cell)} {UNITS[cell.quantity]}".strip() for cell in errors)


def _percent(cell: Cell) -> str:
    """Formats a rate, such as "98.4 (94.5-99.6)"."""
    if cell.ours is None or cell.low is None or cell.high is None:
        return NONE
    return f"{100 * cell.ours:.1f} ({100 * cell.low:.1f}-{100 * cell.high:.1f})"


def _error(cell: Cell) -> str:
    """Formats an error, such as "0.137 ± 0.004"."""
    if cell.ours is None:
        return NONE
    return f"{cell.ours:.3f}" + ("" if cell.high is None else f" ± {cell.high - cell.ours:.3f}")


def _difference(cell: Cell) -> str:
    """Formats a signed difference in percentage points, or in the error's unit."""
    if cell.difference is None:
        return NONE
    return f"{100 * cell.difference:+.1f}" if cell.quantity == SUCCESS else f"{cell.difference:+.3f}"
