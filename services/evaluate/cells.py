"""Rows of an evaluation as tables for display: in a terminal, in reports, and in Markdown."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from congrasp.actors.stress import SURVIVAL
from congrasp.common.task.plausibility import CLEAN_MM
from congrasp.services.evaluate.scores import ERRORS, UNITS, Row

RATES = ("constraint", "episodes", "objects", "success", "held 2 s", "of all objects", "error", "paper")
"""Columns of the comparison with the paper; `rate_cells` fills them. "Of all objects": success and held, counting
uncovered objects as failures."""
PLAUSIBILITY = (
    "constraint",
    "hand in hand, mm",
    "in table, mm",
    "in object, mm",
    "wrist m/s",
    "m/s²",
    "clean",
    "lifted",
    "pushed by half the weight",
    "and by 1 N",
)
"""Columns of the table of plausibility (`plausibility_cells`): deepest penetration (mean, 95th percentile), also of the
hand's meshes into the object if it has some; peak speed and acceleration of the wrist; rates. Each push stands for six
pushes in a row (`actors.stress.Protocol`)."""
FORCES = ("constraint", "link, N", "sum, N", "torque, % of limit", "links in contact at table removal", "diverged")
"""Columns of the table of forces after the removal (mean, 95th percentile); `force_cells` fills them."""


def rate_cells(row: Row) -> tuple[str, ...]:
    """Cells of a row under `RATES`."""
    return (
        row_title(row),
        str(row.episodes) if row.distinct == row.episodes else f"{row.episodes} ({row.distinct} different)",
        str(row.covered) if row.covered == row.pool else f"{row.covered} of {row.pool}",
        _rate(row.success, row.success_low, row.success_high),
        _rate(row.held_2s, row.held_2s_low, row.held_2s_high),
        ", ".join(_percent(rate) for rate in (row.success_all, row.held_all) if rate is not None),
        _errors(row.errors),
        "  ".join(paper_cells(row)).strip(),
    )


def paper_cells(row: Row) -> tuple[str, str]:
    """Success and errors of the paper for a row; empty if it has none."""
    return (_percent(row.paper.success), _errors(row.paper.errors)) if row.paper else ("", "")


def force_cells(row: Row) -> tuple[str, ...]:
    """Cells of a row under `FORCES`."""
    return (
        row_title(row),
        _pair(row.forces["link_force_mean"], row.forces["link_force_p95"], 1.0),
        _pair(row.forces["force_sum_mean"], row.forces["force_sum_p95"], 1.0),
        _pair(row.forces["torque_share_mean"], row.forces["torque_share_p95"], 100.0),
        f"{row.links_at_removal:.1f}",
        _percent(row.diverged),
    )


def plausibility_cells(row: Row) -> tuple[str, ...]:
    """Cells of a row under `PLAUSIBILITY`."""
    found = row.plausibility
    *depths, mesh = (_pair(found.get(name), found.get(f"{name}_p95"), 1.0) for name in CLEAN_MM)
    if found.get("hand_mesh_mm") is not None:
        depths[-1] += f", its meshes {mesh}"
    peaks = (found.get(name) for name in ("wrist_speed", "wrist_acceleration"))
    rates = (found.get(name) for name in ("clean", *SURVIVAL))
    return (
        row_title(row),
        *depths,
        *("-" if peak is None else f"{peak:.3g}" for peak in peaks),
        *("-" if rate is None else _percent(rate) for rate in rates),
    )


def tables_of(rows: Sequence[Row], title: str, missing: Sequence[tuple[str, str, str]] = ()) -> list[Any]:
    """Returns rows as rich tables: rates and errors with those of the paper, plausibility, then forces.

    Args:
      rows: rows of one policy, or of several, which are then named and grouped by constraint.
      title: title of the first table.
      missing: hands and methods without a row, and the reason.
    """
    from rich.table import Table

    several = bool(missing) or len({(row.hand, row.method) for row in rows}) > 1
    order = {name: i for i, name in enumerate(dict.fromkeys(map(row_title, rows)))}
    rows = sorted(rows, key=lambda row: order[row_title(row)])
    tables = []
    for heading, columns, cells in (
        (title, RATES, rate_cells),
        ("Plausibility of all episodes", PLAUSIBILITY, plausibility_cells),
        ("Forces after the removal: mean, 95th percentile", FORCES, force_cells),
    ):
        table = Table(title=heading, title_justify="left")
        for column in (*columns[:1], *(("hand", "method") if several else ()), *columns[1:]):
            table.add_column(column, no_wrap=column in ("constraint", "method", "success", "held 2 s"))
        for row in rows:
            name, *others = cells(row)
            table.add_row(name, *((row.hand, row.method) if several else ()), *others)
        for hand, method, reason in missing if heading == title else ():
            table.add_row(reason, hand, method)
        tables.append(table)
    return tables


def object_table(rows: Sequence[Row]) -> Any:
    """Returns the success and held rates of each object (a line) in each row (a column), as a rich table."""
    from rich.table import Table

    table = Table(title="By object: success, held 2 s", title_justify="left")
    table.add_column("object", no_wrap=True)
    found = [{of["name"]: of for of in row.objects} for row in rows]
    several = len({(row.hand, row.method) for row in rows}) > 1
    for row in rows:
        table.add_column(f"{row_title(row)}, {row.hand}, {row.method}" if several else row_title(row))
    for name in dict.fromkeys(name for of in found for name in of):
        cells = []
        for of in found:
            rates = [of[name][key] for key in ("success", "held_2s") if key in of[name]] if name in of else []
            cells.append(", ".join(_percent(rate) for rate in rates))
        table.add_row(name, *cells)
    return table


_FOR_PEOPLE = {"rad": ("°", 180 / np.pi), "m": ("mm", 1000.0), "": ("%", 100.0)}
"""Unit and factor for the display of errors, by the stored unit."""


def error_title(name: str) -> str:
    """Heading of an error's column, such as "heading, mm"."""
    constraint = next(constraint for constraint, names in ERRORS.items() if name in names.values())
    return f"{constraint}, {_FOR_PEOPLE[UNITS[name]][0]}"


def scaled(name: str, error: float | None) -> str:
    """Formats an error under `error_title`; empty if there is none."""
    return "" if error is None else f"{_FOR_PEOPLE[UNITS[name]][1] * error:.1f}"


def row_title(row: Row) -> str:
    """Constraint and group, such as "pose+trajectory, aligned pairs"."""
    return f"{row.constraint}, {row.group}" if row.group else row.constraint


def _percent(rate: float) -> str:
    return f"{100 * rate:.1f} %"


def _rate(rate: float | None, low: float | None, high: float | None) -> str:
    """Formats a rate with its interval, such as "98.7 % (96.6-99.5)"."""
    if rate is None or low is None or high is None:
        return "-"
    return f"{_percent(rate)} ({100 * low:.1f}-{100 * high:.1f})"


def _pair(mean: float | None, percentile: float | None, factor: float) -> str:
    """Formats a mean and a percentile, such as "7.1, 19.3"."""
    return "-" if mean is None or percentile is None else f"{factor * mean:.1f}, {factor * percentile:.1f}"


def _errors(errors: dict[str, float | None] | dict[str, float]) -> str:
    """Formats errors by constraint, such as "0.137 rad 0.020 m"."""
    parts = []
    for names in ERRORS.values():
        found = [(errors.get(name), UNITS[name]) for name in names.values()]
        part = " ".join(f"{value:.3f} {unit}".strip() for value, unit in found if value is not None)
        parts += [part] if part else []
    return ", ".join(parts)
