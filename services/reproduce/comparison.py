"""Every figure of the paper with our measurement, or the reason why there is no comparable one."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

from congrasp.services.evaluate.paper import PaperLine, paper_lines
from congrasp.services.evaluate.scores import Row
from congrasp.services.reproduce.evaluation import Result
from congrasp.services.reproduce.plan import RequiredPolicy

SUCCESS = "success"
CAPTURED_DATA = {"captured": "GRAB and OakInk", "cross": "DexYCB"}
CONDITIONS = (
    "MuJoCo replaces the paper's simulator; contacts, friction, servos and the hands' models differ.",
    "The human hand replaces MANO. It has 20 anatomical joints; the paper's has MANO's.",
    "Procedural objects that are never used in training replace the objects of the paper's table of hands, and "
    "Objaverse in its table of large-scale objects. Sizes there are terciles of our objects; the paper gives no "
    "bounds.",
    "References of the table of hands are grasps of this project's reference policies, generated as in the paper.",
    "Success is the paper's: the object has not fallen a quarter of a second after the table is removed. The "
    "paper does not report whether it is held for two seconds, nor whether fingers penetrate anything.",
)
"""Differences that apply to every table."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """A figure of the paper, and ours if it is comparable."""

    table: str
    """`services.evaluate.paper.TABLES`."""
    constraint: str
    hand: str
    method: str
    group: str
    """Size of the objects; empty for all."""
    quantity: str
    """`success`, or the name of an error."""
    paper: float
    data: str = ""
    """Our captured data set; empty for procedural constraints."""
    episodes: int = 0
    ours: float | None = None
    low: float | None = None
    high: float | None = None
    """95 % interval: of a rate with objects as clusters, 1.96 standard errors around a mean error."""
    difference: float | None = None
    """Our figure minus the paper's."""
    nearest: float | None = None
    """Nearest figure that is not comparable: same hand, method and constraint with procedural references."""
    reason: str = ""
    """Reason if there is no comparable figure."""

    @property
    def verdict(self) -> str:
        """ "better" or "worse" if the whole interval is, else empty."""
        if self.low is None or self.high is None or self.low <= self.paper <= self.high:
            return ""
        return "better" if (self.low > self.paper) == (self.quantity == SUCCESS) else "worse"


def compare(results: Sequence[Result], absent: Mapping[RequiredPolicy, str], hands: Sequence[str]) -> list[Cell]:
    """Returns a cell for every figure of the paper and every comparable result.

    Args:
      results: results of all parts.
      absent: reasons for missing policies.
      hands: requested hands.
    """
    cells: list[Cell] = []
    for line in paper_lines():
        matching = [found for result in results if result.source == line.source for found in _rows(result, line)]
        near = [row for result in results if result.source == "hands" for _, row in _rows(result, line)]
        reason = "" if matching else _reason(line, results, absent, hands)
        for quantity, paper in {SUCCESS: line.figures.success, **line.figures.errors}.items():
            cell = Cell(line.table, line.constraint, line.hand, line.method, line.group, quantity, paper)
            if not matching:
                nearest = _figure(near[0], quantity) if near else None
                cells.append(dataclasses.replace(cell, nearest=nearest, reason=reason))
            cells += [_filled(cell, data, row) for data, row in matching]
    return cells


def unmatched(results: Sequence[Result]) -> list[tuple[Result, Row]]:
    """Returns our rows without a counterpart in the paper."""
    lines = paper_lines()
    return [
        (result, row)
        for result in results
        for row in result.rows
        if not any(line.source == result.source and _is_of(row, line) for line in lines)
    ]


def _rows(result: Result, line: PaperLine) -> Iterator[tuple[str, Row]]:
    """Yields a result's rows of a line's hand, method, constraint and group, with the data set."""
    for row in result.rows:
        if _is_of(row, line):
            yield result.part.data.resolve().name if result.part.data else "", row


def _is_of(row: Row, line: PaperLine) -> bool:
    """True if a row has a line's hand, method, constraint and group."""
    same = (row.hand, row.method, row.constraint) == (line.hand, line.method, line.constraint)
    return same and row.group.split(" ")[0] == line.group


def _figure(row: Row, quantity: str) -> float | None:
    """Success or error of a row."""
    return row.success if quantity == SUCCESS else row.errors[quantity]


def _filled(cell: Cell, data: str, row: Row) -> Cell:
    """Returns the cell with our figure; without a successful episode there is no error to compare."""
    cell = dataclasses.replace(cell, data=data, episodes=row.episodes)
    if (ours := _figure(row, cell.quantity)) is None:
        return dataclasses.replace(cell, reason="no episode succeeded")
    low, high = (row.success_low, row.success_high) if cell.quantity == SUCCESS else (None, None)
    if (margin := row.margins.get(cell.quantity)) is not None:
        low, high = ours - margin, ours + margin
    return dataclasses.replace(cell, ours=ours, low=low, high=high, difference=ours - cell.paper)


def _reason(
    line: PaperLine, results: Sequence[Result], absent: Mapping[RequiredPolicy, str], hands: Sequence[str]
) -> str:
    """Reason why no result is comparable with a line."""
    if line.hand not in hands:
        return f"the hand '{line.hand}' was not requested"
    if reason := absent.get(RequiredPolicy(line.hand, line.method)):
        return f"no policy of the method '{line.method}': {reason}"
    if line.source in CAPTURED_DATA and not any(result.source == line.source for result in results):
        return (
            f"needs captured constraints of {CAPTURED_DATA[line.source]}, which may not be redistributed; "
            "--captured uses your copy"
        )
    return "not evaluated"
