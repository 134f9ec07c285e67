"""Page, JSON file and LaTeX of a reproduction."""

import dataclasses
import json
import pathlib
from collections.abc import Iterator, Mapping, Sequence, Set
from typing import Any, NamedTuple

from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_file
from congrasp.services.evaluate.columns import PLAUSIBILITY, SCORE_CELLS, SCORES
from congrasp.services.evaluate.lineup import PolicyKey
from congrasp.services.evaluate.pages import Picture, embed, template
from congrasp.services.evaluate.paper.comparison import (
    SUCCESS,
    Cell,
    rows_without_counterpart,
    summary,
)
from congrasp.services.evaluate.paper.evaluation import PartResult
from congrasp.services.evaluate.paper.figures import TABLES
from congrasp.services.evaluate.scores import UNITS, Row
from congrasp.services.evaluate.text_table import NONE, Columns, Styled, Table, percent

PAGE = "reproduction.html"
JSON = "reproduction.json"
LATEX = "tables.tex"
_OBJECTS_COLUMN = 3
_ERROR_COLUMNS = (8, 9, 10)
"""Columns of `_COLUMNS` that a table does without if it has no objects, or no errors."""
_MAX_PICTURE_BYTES = 32 << 20
_DIFFERENCES = (
    "MuJoCo replaces the paper's simulator; contacts, friction, servos and the hands' models "
    "differ.",
    "The human hand replaces MANO. It has 20 anatomical joints; the paper's has MANO's.",
    "Procedural objects that are never used in training replace the objects of the paper's table "
    "of hands, and Objaverse in its table of large-scale objects. Sizes there are terciles of our "
    "objects; the paper gives no bounds.",
    "References of the table of hands are grasps of this project's reference policies, generated "
    "as in the paper.",
    "Success is the paper's: the object has not fallen a quarter of a second after the table is "
    "removed. The paper does not report whether it is held for two seconds, nor whether fingers "
    "penetrate anything.",
)
"""Differences that apply to every table."""


class Reproduction(NamedTuple):
    """Results of a reproduction."""

    results: list[PartResult]
    cells: list[Cell]
    policies: list[tuple[PolicyKey, str]]
    """Policies, each with its file or the reason why there is none."""
    failures: list[str]
    conditions: str
    """A sentence on objects, engine and seed."""
    command: str
    """Command line that reproduces it."""
    curves: list[Picture]
    """Curves of trainings."""
    seconds: dict[str, float]
    """Durations of trainings and of evaluations, including earlier starts, s."""


def page_template() -> Any:
    """Returns the page's template; raises a CongraspError if jinja2 is not installed."""
    return template(pathlib.Path(__file__).with_name("page.html"))


def write_reproduction(reproduction: Reproduction, out: pathlib.Path) -> None:
    """Writes page, JSON and LaTeX into a folder, each atomically.

    Raises:
      CongraspError: a file cannot be written, or jinja2 is not installed.
    """
    tables = paper_tables(reproduction.cells)
    latex = [table.latex(reproduction.conditions) for table in tables]
    write_atomically(out / PAGE, _page(reproduction, tables).encode())
    write_atomically(out / LATEX, "\n".join(latex).encode())
    write_atomically(out / JSON, json.dumps(to_json(reproduction), indent=2).encode())


def _page(reproduction: Reproduction, tables: Sequence[Table]) -> str:
    """Returns the page's HTML."""
    absent = not_comparable(reproduction.cells)
    policies = [
        (policy.hand, policy.method, Styled(description, "text"))
        for policy, description in reproduction.policies
    ]
    pictures = [*_episode_pictures(reproduction.results), *reproduction.curves]
    page: str = page_template().render(
        title="The paper's tables",
        summary=summary(reproduction.cells),
        conditions=f"{reproduction.conditions} {_durations(reproduction.seconds)}",
        command=reproduction.command,
        tables=_titled_html(tables),
        everywhere=_differences(reproduction.results),
        absent=absent.html() if absent.rows else "",
        details=_titled_html(_detail_tables(reproduction.results)),
        pictures=[embed(picture) for picture in pictures],
        policies=Table("", ("hand", "method", "policy"), policies).html(),
        failures=reproduction.failures,
    )
    return page


def to_json(reproduction: Reproduction) -> dict[str, Any]:
    """Returns the content of the JSON file."""
    policies = []
    for policy, description in reproduction.policies:
        policies.append(policy._asdict() | {"what": description})
    missing = []
    for line, reason, nearest in not_comparable(reproduction.cells).rows:
        missing.append({"line": line, "reason": reason, "nearest": nearest})
    parts = []
    for result in reproduction.results:
        rows = [row.to_json() for row in result.rows]
        parts.append(
            {"name": result.part.name, "source": result.source, **result.about, "rows": rows}
        )
    return {
        "conditions": reproduction.conditions,
        "command": reproduction.command,
        "seconds": reproduction.seconds,
        "policies": policies,
        "cells": [dataclasses.asdict(cell) for cell in reproduction.cells],
        "not_comparable": missing,
        "different_everywhere": _differences(reproduction.results),
        "failures": reproduction.failures,
        "parts": parts,
    }


def not_comparable(cells: Sequence[Cell]) -> Table:
    """Lines without a comparable figure: description, reason, and the nearest measured success."""
    columns: Columns[Cell] = (
        ("the paper's line", _line_title),
        ("why", lambda cell: Styled(cell.reason, "text")),
        ("nearest success here, procedural references", _nearest_success),
    )
    missing = [cell for cell in cells if cell.ours is None and cell.quantity == SUCCESS]
    return Table.of("", missing, columns)


def _line_title(cell: Cell) -> str:
    """Table, constraint, hand, method and size of a line of the paper."""
    title = f"{TABLES[cell.table]}: {cell.constraint}, {cell.hand}, {cell.method}"
    return f"{title}, {cell.group} objects" if cell.group else title


def _nearest_success(cell: Cell) -> str:
    """Nearest success that is not comparable, with the paper's."""
    if cell.nearest is None:
        return NONE
    return f"{percent(cell.nearest)} ({percent(cell.paper)} in the paper)"


def paper_tables(cells: Sequence[Cell]) -> list[Table]:
    """Returns all of the paper's tables, with a row for each constraint, hand, method, size and
    data set.
    """
    tables = []
    for name, title in TABLES.items():
        lines = dict[tuple[str, ...], list[Cell]]()
        for cell in cells:
            if cell.table == name:
                key = (cell.constraint, cell.hand, cell.method, cell.group, cell.data)
                lines.setdefault(key, []).append(cell)
        tables.append(_without_empty_columns(Table.of(title, lines.values(), _COLUMNS)))
    return tables


def _without_empty_columns(table: Table) -> Table:
    """Returns a table without the column of objects if that column is empty, and without both
    columns of errors if the paper's is empty.
    """
    hidden = set[int]()
    if _is_empty(table, _OBJECTS_COLUMN):
        hidden.add(_OBJECTS_COLUMN)
    paper_errors = _ERROR_COLUMNS[1]
    if _is_empty(table, paper_errors):
        hidden.update(_ERROR_COLUMNS)
    columns = _without(table.columns, hidden)
    return Table(table.title, columns, [_without(row, hidden) for row in table.rows])


def _without(cells: Sequence[str], hidden: Set[int]) -> list[str]:
    """Returns cells without those of some columns."""
    return [cell for i, cell in enumerate(cells) if i not in hidden]


def _is_empty(table: Table, column: int) -> bool:
    """True if no row has a figure in a column."""
    return all(row[column] == NONE for row in table.rows)


def _objects(line: list[Cell]) -> str:
    """Size of the objects, and our captured data set."""
    success = line[0]
    group = success.group
    if not group and success.table == "objects":
        group = "all"
    return ", ".join(filter(None, (group, success.data))) or NONE


def _success(line: list[Cell]) -> Styled:
    """Our success with its interval."""
    success = line[0]
    return Styled(percent(success.ours, success.low, success.high, ""), success.verdict)


def _errors(line: list[Cell]) -> Styled:
    """Our errors, such as "0.137 ± 0.004 rad"."""
    texts = []
    for cell in line[1:]:
        if cell.ours is None:
            texts.append(NONE)
        elif cell.high is None:
            texts.append(f"{cell.ours:.3f}")
        else:
            texts.append(f"{cell.ours:.3f} ± {cell.high - cell.ours:.3f}")
    return Styled(_joined_errors(line, texts), "errors")


def _paper_errors(line: list[Cell]) -> Styled:
    """The paper's errors."""
    texts = [f"{cell.paper:.3f}" for cell in line[1:]]
    return Styled(_joined_errors(line, texts), "errors paper")


def _error_differences(line: list[Cell]) -> Styled:
    """Our errors minus the paper's."""
    texts = [_format_difference(cell, 1.0, 3) for cell in line[1:]]
    return Styled(_joined_errors(line, texts), "errors")


def _joined_errors(line: list[Cell], texts: Sequence[str]) -> str:
    """Joins texts of a line's errors with their units; `NONE` if none has a figure."""
    if all(text == NONE for text in texts):
        return NONE
    units = [UNITS[cell.quantity] for cell in line[1:]]
    return " / ".join(f"{text} {unit}".strip() for text, unit in zip(texts, units, strict=True))


def _format_difference(cell: Cell, factor: float, digits: int) -> str:
    """Formats a signed difference."""
    if cell.difference is None:
        return NONE
    return f"{factor * cell.difference:+.{digits}f}"


_COLUMNS: Columns[list[Cell]] = (
    ("constraint", lambda line: line[0].constraint),
    ("hand", lambda line: line[0].hand),
    ("method", lambda line: line[0].method),
    ("objects", _objects),
    ("episodes", lambda line: str(line[0].episodes or NONE)),
    ("success, %", _success),
    ("paper", lambda line: Styled(percent(line[0].paper, unit=""), "paper")),
    ("difference", lambda line: _format_difference(line[0], 100.0, 1)),
    ("error", _errors),
    ("paper", _paper_errors),
    ("difference", _error_differences),
)
"""Columns of a line's cells, of which success is the first."""


def _titled_html(tables: Sequence[Table]) -> list[tuple[str, str]]:
    """Titles and HTML of tables."""
    return [(table.title, dataclasses.replace(table, title="").html()) for table in tables]


def _differences(results: Sequence[PartResult]) -> list[str]:
    """Differences that apply to every table, then the share of headings kept by the rules of each
    hand.
    """
    heading_rules = [result.about["heading_rules"] for result in results]
    return [*_DIFFERENCES, *dict.fromkeys(filter(None, heading_rules))]


def _durations(seconds: Mapping[str, float]) -> str:
    """Formats durations, such as "Evaluation took 12.3 min."."""
    clauses = [
        f"{phase} took {duration / 60:.1f} min" for phase, duration in seconds.items() if duration
    ]
    if not clauses:
        return ""
    return f"{', '.join(clauses).capitalize()}."


def _detail_tables(results: Sequence[PartResult]) -> list[Table]:
    """Rates of rows without a counterpart in the paper, and the plausibility of all."""
    with_plausibility = []
    for result in results:
        for row in result.rows:
            if row.plausibility.get("hand_hand_mm") is not None:
                with_plausibility.append((result, row))
    first, *others = PLAUSIBILITY
    plausibility = (first, ("held 2 s", SCORE_CELLS["held 2 s"]), *others)
    return [
        Table.of(
            "Rows without a counterpart in the paper",
            rows_without_counterpart(results),
            _with_policy(SCORES[:-1]),
        ),
        Table.of(
            "Held for two seconds, and plausibility", with_plausibility, _with_policy(plausibility)
        ),
    ]


def _with_policy(columns: Columns[Row]) -> Columns[tuple[PartResult, Row]]:
    """Prepends table, hand and method to the columns of a row."""
    policy: Columns[tuple[PartResult, Row]] = (
        ("table", lambda pair: pair[0].part.data_name or pair[0].part.table),
        ("hand", lambda pair: pair[1].hand),
        ("method", lambda pair: pair[1].method),
    )
    of_row = [(name, lambda pair, cell=cell: cell(pair[1])) for name, cell in columns]
    return (*policy, *of_row)


def _episode_pictures(results: Sequence[PartResult]) -> Iterator[Picture]:
    """Yields pictures of episodes whose files still exist."""
    for result in results:
        for picture in result.about["pictures"]:
            path = pathlib.Path(picture["file"])
            if path.is_file():
                png = read_file(path, _MAX_PICTURE_BYTES)
                yield Picture(picture["title"], png, picture["caption"])
