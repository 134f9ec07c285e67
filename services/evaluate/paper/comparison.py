"""Every figure of the paper with our measurement, or the reason why there is no comparable one."""

import collections
import dataclasses
from collections.abc import Iterator, Mapping, Sequence

from congrasp.services.evaluate.lineup import PolicyKey
from congrasp.services.evaluate.paper.evaluation import PartResult
from congrasp.services.evaluate.paper.figures import PaperLine, paper_lines
from congrasp.services.evaluate.scores import Row
from congrasp.services.evaluate.text_table import verdict

SUCCESS = "success"
CAPTURED_DATA = {"captured": "GRAB and OakInk", "cross": "DexYCB"}
"""Captured data sets of the paper, by the source of its figures."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """A figure of the paper, and ours if it is comparable."""

    table: str
    """`services.evaluate.paper.figures.TABLES`."""
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
    """95 % interval: of a rate with objects as clusters, 1.96 standard errors around a mean
    error.
    """
    difference: float | None = None
    """Our figure minus the paper's."""
    nearest: float | None = None
    """Nearest figure that is not comparable: same hand, method and constraint with procedural
    references.
    """
    reason: str = ""
    """Reason if there is no comparable figure."""

    @property
    def verdict(self) -> str:
        """ "better" or "worse" if the whole interval is, else empty."""
        if self.low is None or self.high is None:
            return ""
        if self.quantity == SUCCESS:
            return verdict(self.low, self.high, self.paper)
        return verdict(-self.high, -self.low, -self.paper)  # a smaller error is better


def compare(
    results: Sequence[PartResult], absent: Mapping[PolicyKey, str], hands: Sequence[str]
) -> list[Cell]:
    """Returns a cell for every figure of the paper and every comparable result.

    Args:
      results: results of all parts.
      absent: reasons for missing policies.
      hands: requested hands.
    """
    cells: list[Cell] = []
    for line in paper_lines():
        comparable = list(_matching_rows(results, line, line.source))
        procedural = list(_matching_rows(results, line, "hands"))
        for quantity, paper in {SUCCESS: line.figures.success, **line.figures.errors}.items():
            cell = Cell(
                line.table, line.constraint, line.hand, line.method, line.group, quantity, paper
            )
            for data_name, row in comparable:
                cells.append(_with_our_figure(cell, data_name, row))
            if comparable:
                continue
            reason = _missing_reason(line, results, absent, hands)
            nearest = None
            if procedural:
                _, nearest_row = procedural[0]
                nearest = _figure(nearest_row, quantity)
            cells.append(dataclasses.replace(cell, nearest=nearest, reason=reason))
    return cells


def rows_without_counterpart(results: Sequence[PartResult]) -> list[tuple[PartResult, Row]]:
    """Returns our rows without a counterpart in the paper."""
    rows_without_line = []
    for result in results:
        lines = [line for line in paper_lines() if line.source == result.source]
        for row in result.rows:
            if not any(_is_of(row, line) for line in lines):
                rows_without_line.append((result, row))
    return rows_without_line


def _matching_rows(
    results: Sequence[PartResult], line: PaperLine, source: str
) -> Iterator[tuple[str, Row]]:
    """Yields rows of a source with a line's hand, method, constraint and group, each with the name
    of its data set.
    """
    for result in results:
        if result.source != source:
            continue
        for row in result.rows:
            if _is_of(row, line):
                yield result.part.data_name, row


def _is_of(row: Row, line: PaperLine) -> bool:
    """True if a row has a line's hand, method, constraint and group."""
    size, _, _ = row.group.partition(" ")
    ours = (row.hand, row.method, row.constraint, size)
    return ours == (line.hand, line.method, line.constraint, line.group)


def _figure(row: Row, quantity: str) -> float | None:
    """Success or error of a row."""
    return row.success if quantity == SUCCESS else row.errors[quantity]


def _with_our_figure(cell: Cell, data_name: str, row: Row) -> Cell:
    """Returns the cell with our figure; without a successful episode there is no error to
    compare.
    """
    cell = dataclasses.replace(cell, data=data_name, episodes=row.episodes)
    ours = _figure(row, cell.quantity)
    if ours is None:
        return dataclasses.replace(cell, reason="no episode succeeded")
    low = None
    high = None
    margin = row.margins.get(cell.quantity)
    if margin is not None:
        low = ours - margin
        high = ours + margin
    elif cell.quantity == SUCCESS:
        low = row.success_low
        high = row.success_high
    return dataclasses.replace(cell, ours=ours, low=low, high=high, difference=ours - cell.paper)


def _missing_reason(
    line: PaperLine,
    results: Sequence[PartResult],
    absent: Mapping[PolicyKey, str],
    hands: Sequence[str],
) -> str:
    """Reason why no result is comparable with a line."""
    if line.hand not in hands:
        return f"the hand '{line.hand}' was not requested"
    policy_reason = absent.get(PolicyKey(line.hand, line.method))
    if policy_reason:
        return f"no policy of the method '{line.method}': {policy_reason}"
    sources = {result.source for result in results}
    if line.source in CAPTURED_DATA and line.source not in sources:
        return (
            f"needs captured constraints of {CAPTURED_DATA[line.source]}, which may not be "
            f"redistributed; --captured uses your copy"
        )
    return "not evaluated"


def summary(cells: Sequence[Cell]) -> str:
    """Summarises how many of the paper's figures have a counterpart, and how they compare."""
    rates = [cell for cell in cells if cell.quantity == SUCCESS]
    compared = [cell for cell in rates if cell.ours is not None]
    above = sum(cell.ours >= cell.paper for cell in compared if cell.ours is not None)
    verdicts = collections.Counter(cell.verdict for cell in compared)
    return (
        f"{len(compared)} of the paper's {len(rates)} success rates have a comparable one. It is "
        f"at or above the paper's in {above}; the whole 95 % interval is above it in "
        f"{verdicts['better']}, and below it in {verdicts['worse']}."
    )
