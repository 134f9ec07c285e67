"""Page, JSON file and LaTeX tables of a reproduction."""

import dataclasses
import json
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_file
from congrasp.services.evaluate.report import Picture, embedded, template
from congrasp.services.evaluate.scores import Row
from congrasp.services.evaluate.table import PLAUSIBILITY, RATE, RATES, Columns, Styled, Table
from congrasp.services.reproduce.comparison import Cell, not_comparable, summary, tables, unmatched
from congrasp.services.reproduce.plan import RequiredPolicy, Result

PAGE, JSON, LATEX = "reproduction.html", "reproduction.json", "tables.tex"
_LARGEST_PICTURE = 32 << 20
_CONDITIONS = (
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
    return template(pathlib.Path(__file__).with_suffix(".html"))


def write(account: Account, out: pathlib.Path) -> None:
    """Writes page, JSON and LaTeX into a folder, each atomically.

    Raises:
      CongraspError: a file cannot be written, or jinja2 is not installed.
    """
    shown, absent = tables(account.cells), not_comparable(account.cells)
    policies = [(policy.hand, policy.method, Styled(what, "text")) for policy, what in account.policies]
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
    write_atomically(out / LATEX, "\n".join(table.latex(account.conditions) for table in shown).encode())
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
            dict(zip(("line", "reason", "nearest"), row, strict=True)) for row in not_comparable(account.cells).rows
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
    """Differences that apply to every table, and for each hand the share of headings that its rules keep."""
    rules = dict.fromkeys(result.about["heading_rules"] for result in results if result.about["heading_rules"])
    return [*_CONDITIONS, *rules]


def _times(seconds: Mapping[str, float]) -> str:
    """Formats durations, such as "Evaluation took 12.3 min."."""
    took = [f"{what} took {amount / 60:.1f} min" for what, amount in seconds.items() if amount]
    return f"{', '.join(took).capitalize()}." if took else ""


def _details(results: Sequence[Result]) -> list[Table]:
    """Rates of rows without a counterpart in the paper, and the plausibility of all."""
    measured = [
        (result, row) for result in results for row in result.rows if row.plausibility.get("hand_hand_mm") is not None
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
