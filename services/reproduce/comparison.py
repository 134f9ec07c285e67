"""Every figure of the paper with our measurement, or the reason why there is no comparable one.

They are written as tables of a page, as a JSON file and as LaTeX.
"""

import collections
import dataclasses
import json
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_file
from congrasp.services.evaluate.paper import TABLES, PaperLine, paper_lines
from congrasp.services.evaluate.report import Picture, embedded, template
from congrasp.services.evaluate.scores import UNITS, Row
from congrasp.services.evaluate.table import (
    NONE,
    PLAUSIBILITY,
    RATE,
    RATES,
    Columns,
    Styled,
    Table,
    percent,
    verdict,
)
from congrasp.services.reproduce.plan import RequiredPolicy, Result

SUCCESS = "success"
CAPTURED_DATA = {"captured": "GRAB and OakInk", "cross": "DexYCB"}
_OPTIONAL = {3: (3,), 9: (8, 9, 10)}
"""Columns that are left out if the first of them is empty: objects, and errors if the paper has
none.
"""
PAGE, JSON, LATEX = "reproduction.html", "reproduction.json", "tables.tex"
_LARGEST_PICTURE = 32 << 20
_CONDITIONS = (
    "MuJoCo replaces the paper's simulator; contacts, friction, servos and the hands' models "
    "differ.",
    "The human hand replaces MANO. It has 20 anatomical joints; the paper's has MANO's.",
    "Procedural objects that are never used in training replace the objects of the paper's table "
    "of hands, and "
    "Objaverse in its table of large-scale objects. Sizes there are terciles of our objects; the "
    "paper gives no "
    "bounds.",
    "References of the table of hands are grasps of this project's reference policies, generated "
    "as in the paper.",
    "Success is the paper's: the object has not fallen a quarter of a second after the table is "
    "removed. The "
    "paper does not report whether it is held for two seconds, nor whether fingers penetrate "
    "anything.",
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
    results: Sequence[Result], absent: Mapping[RequiredPolicy, str], hands: Sequence[str]
) -> list[Cell]:
    """Returns a cell for every figure of the paper and every comparable result.

    Args:
      results: results of all parts.
      absent: reasons for missing policies.
      hands: requested hands.
    """
    cells: list[Cell] = []
    for line in paper_lines():
        matching = [
            found
            for result in results
            if result.source == line.source
            for found in _rows(result, line)
        ]
        near = [
            row for result in results if result.source == "hands" for _, row in _rows(result, line)
        ]
        reason = "" if matching else _reason(line, results, absent, hands)
        for quantity, paper in {SUCCESS: line.figures.success, **line.figures.errors}.items():
            cell = Cell(
                line.table, line.constraint, line.hand, line.method, line.group, quantity, paper
            )
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
    """Returns the cell with our figure; without a successful episode there is no error to
    compare.
    """
    cell = dataclasses.replace(cell, data=data, episodes=row.episodes)
    if (ours := _figure(row, cell.quantity)) is None:
        return dataclasses.replace(cell, reason="no episode succeeded")
    low, high = (row.success_low, row.success_high) if cell.quantity == SUCCESS else (None, None)
    if (margin := row.margins.get(cell.quantity)) is not None:
        low, high = ours - margin, ours + margin
    return dataclasses.replace(cell, ours=ours, low=low, high=high, difference=ours - cell.paper)


def _reason(
    line: PaperLine,
    results: Sequence[Result],
    absent: Mapping[RequiredPolicy, str],
    hands: Sequence[str],
) -> str:
    """Reason why no result is comparable with a line."""
    if line.hand not in hands:
        return f"the hand '{line.hand}' was not requested"
    if reason := absent.get(RequiredPolicy(line.hand, line.method)):
        return f"no policy of the method '{line.method}': {reason}"
    if line.source in CAPTURED_DATA and not any(result.source == line.source for result in results):
        return (
            f"needs captured constraints of {CAPTURED_DATA[line.source]}, which may not be "
            f"redistributed; "
            "--captured uses your copy"
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
        f"at or above the "
        f"paper's in {above}; the whole 95 % interval is above it in {verdicts['better']}, and "
        f"below it in "
        f"{verdicts['worse']}."
    )


def not_comparable(cells: Sequence[Cell]) -> Table:
    """Lines without a comparable figure: description, reason, and the nearest measured success."""
    columns: Columns[Cell] = (
        (
            "the paper's line",
            lambda cell: (
                f"{TABLES[cell.table]}: {cell.constraint}, {cell.hand}, {cell.method}"
                + (f", {cell.group} objects" if cell.group else "")
            ),
        ),
        ("why", lambda cell: Styled(cell.reason, "text")),
        (
            "nearest success here, procedural references",
            lambda cell: (
                NONE
                if cell.nearest is None
                else f"{percent(cell.nearest)} ({percent(cell.paper)} in the paper)"
            ),
        ),
    )
    return Table.of(
        "", [cell for cell in cells if cell.ours is None and cell.quantity == SUCCESS], columns
    )


def tables(cells: Sequence[Cell]) -> list[Table]:
    """Returns all of the paper's tables, with a row for each constraint, hand, method, size and
    data set.
    """
    found: list[Table] = []
    for name, title in TABLES.items():
        lines = dict[tuple[str, ...], list[Cell]]()
        for cell in cells:
            if cell.table == name:
                lines.setdefault(
                    (cell.constraint, cell.hand, cell.method, cell.group, cell.data), []
                ).append(cell)
        table = Table.of(title, lines.values(), _COLUMNS)
        hidden = {
            i
            for key, group in _OPTIONAL.items()
            if {row[key] for row in table.rows} <= {NONE}
            for i in group
        }
        shown = [i for i in range(len(_COLUMNS)) if i not in hidden]
        found.append(
            Table(
                title,
                [table.columns[i] for i in shown],
                [[row[i] for i in shown] for row in table.rows],
            )
        )
    return found


def _joined(show: Callable[[Cell], str]) -> Callable[[list[Cell]], str]:
    """Joins all errors of a line with their units; `NONE` if no error is shown."""

    def cell(line: list[Cell]) -> str:
        """Cell of the errors."""
        texts = [show(error) for error in line[1:]]
        if set(texts) <= {NONE}:
            return NONE
        return " / ".join(
            f"{text} {UNITS[error.quantity]}".strip()
            for text, error in zip(texts, line[1:], strict=True)
        )

    return cell


def _objects(line: list[Cell]) -> str:
    """Size of the objects, and our captured data set."""
    success = line[0]
    group = success.group or ("all" if success.table == "objects" else "")
    return ", ".join(filter(None, (group, success.data))) or NONE


def _error(cell: Cell) -> str:
    """Formats an error, such as "0.137 ± 0.004"."""
    if cell.ours is None:
        return NONE
    return f"{cell.ours:.3f}" + ("" if cell.high is None else f" ± {cell.high - cell.ours:.3f}")


def _difference(cell: Cell) -> str:
    """Formats a signed difference in percentage points, or in the error's unit."""
    if cell.difference is None:
        return NONE
    return (
        f"{100 * cell.difference:+.1f}" if cell.quantity == SUCCESS else f"{cell.difference:+.3f}"
    )


def _styled(style: str, cell: Callable[[list[Cell]], str]) -> Callable[[list[Cell]], str]:
    """The same cells with a CSS class."""
    return lambda line: Styled(cell(line), style)


_COLUMNS: Columns[list[Cell]] = (
    ("constraint", lambda line: line[0].constraint),
    ("hand", lambda line: line[0].hand),
    ("method", lambda line: line[0].method),
    ("objects", _objects),
    ("episodes", lambda line: str(line[0].episodes or NONE)),
    (
        "success, %",
        lambda line: Styled(percent(line[0].ours, line[0].low, line[0].high, ""), line[0].verdict),
    ),
    ("paper", _styled("paper", lambda line: percent(line[0].paper, unit=""))),
    ("difference", lambda line: _difference(line[0])),
    ("error", _styled("errors", _joined(_error))),
    ("paper", _styled("errors paper", _joined(lambda cell: f"{cell.paper:.3f}"))),
    ("difference", _styled("errors", _joined(_difference))),
)
"""Columns of a line's figures, success first."""


class Account(NamedTuple):
    """Results of a reproduction."""

    results: list[Result]
    cells: list[Cell]
    policies: list[tuple[RequiredPolicy, str]]
    """Policies, each with its file or the reason why there is none."""
    failures: list[str]
    conditions: str
    """A sentence on objects, engine and seed."""
    command: str
    """Command line that reproduces it."""
    curves: list[Picture]
    """Curves of trainings."""
    seconds: dict[str, float]
    """Durations of trainings and of evaluations, including earlier sessions, s."""


def page() -> Any:
    """Returns the page's template; raises a CongraspError if jinja2 is not installed."""
    return template(pathlib.Path(__file__).with_name("page.html"))


def write(account: Account, out: pathlib.Path) -> None:
    """Writes page, JSON and LaTeX into a folder, each atomically.

    Raises:
      CongraspError: a file cannot be written, or jinja2 is not installed.
    """
    shown, absent = tables(account.cells), not_comparable(account.cells)
    policies = [
        (policy.hand, policy.method, Styled(what, "text")) for policy, what in account.policies
    ]
    text = page().render(
        title="The paper's tables",
        summary=summary(account.cells),
        conditions=f"{account.conditions} {_times(account.seconds)}",
        command=account.command,
        tables=_shown(shown),
        everywhere=_different(account.results),
        absent=absent.html() if absent.rows else "",
        details=_shown(_details(account.results)),
        pictures=[embedded(picture) for picture in [*_pictures(account.results), *account.curves]],
        policies=Table("", ("hand", "method", "policy"), policies).html(),
        failures=account.failures,
    )
    write_atomically(out / PAGE, text.encode())
    write_atomically(
        out / LATEX, "\n".join(table.latex(account.conditions) for table in shown).encode()
    )
    write_atomically(out / JSON, json.dumps(to_json(account), indent=2).encode())


def _shown(shown: Sequence[Table]) -> list[tuple[str, str]]:
    """Titles and HTML of tables."""
    return [(table.title, dataclasses.replace(table, title="").html()) for table in shown]


def to_json(account: Account) -> dict[str, Any]:
    """Returns the content of the JSON file."""
    return {
        "conditions": account.conditions,
        "command": account.command,
        "seconds": account.seconds,
        "policies": [policy._asdict() | {"what": what} for policy, what in account.policies],
        "cells": [dataclasses.asdict(cell) for cell in account.cells],
        "not_comparable": [
            dict(zip(("line", "reason", "nearest"), row, strict=True))
            for row in not_comparable(account.cells).rows
        ],
        "different_everywhere": _different(account.results),
        "failures": account.failures,
        "parts": [
            {"name": result.part.name, "source": result.source, **result.about}
            | {"rows": [row.to_json() for row in result.rows]}
            for result in account.results
        ],
    }


def _different(results: Sequence[Result]) -> list[str]:
    """Differences that apply to every table, and for each hand the share of headings that its rules
    keep.
    """
    rules = dict.fromkeys(
        result.about["heading_rules"] for result in results if result.about["heading_rules"]
    )
    return [*_CONDITIONS, *rules]


def _times(seconds: Mapping[str, float]) -> str:
    """Formats durations, such as "Evaluation took 12.3 min."."""
    took = [f"{what} took {amount / 60:.1f} min" for what, amount in seconds.items() if amount]
    return f"{', '.join(took).capitalize()}." if took else ""


def _details(results: Sequence[Result]) -> list[Table]:
    """Rates of rows without a counterpart in the paper, and the plausibility of all."""
    measured = [
        (result, row)
        for result in results
        for row in result.rows
        if row.plausibility.get("hand_hand_mm") is not None
    ]
    plausibility = (PLAUSIBILITY[0], ("held 2 s", RATE["held 2 s"]), *PLAUSIBILITY[1:])
    return [
        Table.of("Rows without a counterpart in the paper", unmatched(results), _named(RATES[:-1])),
        Table.of("Held for two seconds, and plausibility", measured, _named(plausibility)),
    ]


def _named(columns: Columns[Row]) -> Columns[tuple[Result, Row]]:
    """Prepends table, hand and method to the columns of a row."""
    return (
        ("table", lambda pair: pair[0].part.name.removeprefix(f"{pair[0].part.policy.name}-")),
        ("hand", lambda pair: pair[1].hand),
        ("method", lambda pair: pair[1].method),
        *((name, lambda pair, cell=cell: cell(pair[1])) for name, cell in columns),
    )


def _pictures(results: Sequence[Result]) -> Iterator[Picture]:
    """Yields pictures of episodes whose files still exist."""
    for result in results:
        for found in result.about["pictures"]:
            path = pathlib.Path(found["file"])
            if path.is_file():
                yield Picture(found["title"], read_file(path, _LARGEST_PICTURE), found["caption"])
