"""Page, JSON file and LaTeX tables of a reproduction."""

import collections
import dataclasses
import json
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_file
from congrasp.services.evaluate.cells import PLAUSIBILITY, RATES, plausibility_cells, rate_cells
from congrasp.services.evaluate.report import Picture, embedded, template
from congrasp.services.evaluate.scores import Row
from congrasp.services.reproduce.comparison import CONDITIONS, SUCCESS, Cell, unmatched
from congrasp.services.reproduce.evaluation import Result
from congrasp.services.reproduce.latex import latex
from congrasp.services.reproduce.layout import not_comparable, tables
from congrasp.services.reproduce.plan import RequiredPolicy

PAGE, JSON, LATEX = "reproduction.html", "reproduction.json", "tables.tex"
_LARGEST_PICTURE = 32 << 20


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
    shown = tables(account.cells)
    absent = not_comparable(account.cells)
    text = page().render(
        title="The paper's tables",
        summary=summary(account.cells),
        conditions=f"{account.conditions} {_times(account.seconds)}",
        command=account.command,
        tables=shown,
        everywhere=_different(account.results),
        absent=absent,
        details=_details(account.results),
        pictures=[embedded(picture) for picture in [*_pictures(account.results), *account.curves]],
        policies=[(policy.hand, policy.method, what) for policy, what in account.policies],
        failures=account.failures,
    )
    write_atomically(out / PAGE, text.encode())
    write_atomically(out / LATEX, latex(shown, account.conditions).encode())
    write_atomically(out / JSON, json.dumps(to_json(account), indent=2).encode())


def to_json(account: Account) -> dict[str, Any]:
    """Returns the content of the JSON file."""
    return {
        "conditions": account.conditions,
        "command": account.command,
        "seconds": account.seconds,
        "policies": [policy._asdict() | {"what": what} for policy, what in account.policies],
        "cells": [dataclasses.asdict(cell) for cell in account.cells],
        "not_comparable": [
            {"line": what, "reason": why, "nearest": nearest} for what, why, nearest in not_comparable(account.cells)
        ],
        "different_everywhere": _different(account.results),
        "failures": account.failures,
        "parts": [
            {"name": result.part.name, "source": result.source, **result.about}
            | {"rows": [row.to_json() for row in result.rows]}
            for result in account.results
        ],
    }


def summary(cells: Sequence[Cell]) -> str:
    """Summarises how many of the paper's figures have a counterpart, and how they compare."""
    rates = [cell for cell in cells if cell.quantity == SUCCESS]
    compared = [cell for cell in rates if cell.ours is not None]
    above = sum(cell.ours >= cell.paper for cell in compared if cell.ours is not None)
    verdicts = collections.Counter(cell.verdict for cell in compared)
    return (
        f"{len(compared)} of the paper's {len(rates)} success rates have a comparable one. It is at or above the "
        f"paper's in {above}; the whole 95 % interval is above it in {verdicts['better']}, and below it in "
        f"{verdicts['worse']}."
    )


def _different(results: Sequence[Result]) -> list[str]:
    """Differences that apply to every table, and for each hand the share of headings that its rules keep."""
    rules = dict.fromkeys(result.about["heading_rules"] for result in results if result.about["heading_rules"])
    return [*CONDITIONS, *rules]


def _times(seconds: Mapping[str, float]) -> str:
    """Formats durations, such as "Evaluation took 12.3 min."."""
    took = [f"{what} took {amount / 60:.1f} min" for what, amount in seconds.items() if amount]
    return f"{', '.join(took).capitalize()}." if took else ""


class _Details(NamedTuple):
    """A table of further rows of ours."""

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]


def _details(results: Sequence[Result]) -> list[_Details]:
    """Rates of rows without a counterpart in the paper, and the plausibility of all."""
    own = ("table", "hand", "method")
    rates, of_rate = RATES[:-1], _of(lambda row: rate_cells(row)[:-1])
    all_rows = [(result, row) for result in results for row in result.rows]
    return [
        _Details(
            "Rows without a counterpart in the paper", (*own, *rates), [of_rate(*pair) for pair in unmatched(results)]
        ),
        _Details(
            "Held for two seconds, and plausibility",
            (*own, "constraint", "held 2 s", *PLAUSIBILITY[1:]),
            [_of(_plausible)(*pair) for pair in all_rows if pair[1].plausibility.get("hand_hand_mm") is not None],
        ),
    ]


def _of(cells: Callable[[Row], tuple[str, ...]]) -> Callable[[Result, Row], tuple[str, ...]]:
    """Prepends table, hand and method to the cells of a row."""
    return lambda result, row: (result.part.name.removeprefix(f"{result.part.policy.name}-"), row.hand, row.method,
                                *cells(row))  # fmt: skip


def _plausible(row: Row) -> tuple[str, ...]:
    """Rate of grasps held for two seconds, and plausibility."""
    name, *cells = plausibility_cells(row)
    return name, rate_cells(row)[RATES.index("held 2 s")], *cells


def _pictures(results: Sequence[Result]) -> Iterator[Picture]:
    """Yields pictures of episodes whose files still exist."""
    for result in results:
        for found in result.about["pictures"]:
            path = pathlib.Path(found["file"])
            if path.is_file():
                yield Picture(found["title"], read_file(path, _LARGEST_PICTURE), found["caption"])
