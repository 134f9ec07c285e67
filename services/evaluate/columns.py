"""Rows of evaluations as tables: columns of rates, errors, plausibility and forces."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from congrasp.actors.stress import SURVIVAL_NAMES
from congrasp.services.evaluate.scores import ERROR_COLUMNS, UNITS, Row
from congrasp.services.evaluate.text_table import NONE, Columns, Styled, Table, percent

FORCES_TITLE = "Forces after the removal: mean, 95th percentile"
_SMALL_UNITS = {"rad": ("°", 180 / np.pi), "m": ("mm", 1000.0), "": ("%", 100.0)}
"""Unit of a column with one error, and the factor to it, by the unit of the error in rows."""


def row_title(row: Row) -> str:
    """Constraint and group, such as "pose+trajectory, aligned pairs"."""
    return f"{row.constraint}, {row.group}" if row.group else row.constraint


def paper_rate(row: Row) -> str:
    """Success of the paper; empty if it has none."""
    return percent(row.paper.success) if row.paper else ""


def format_measure(row: Row, name: str, factor: float = 1.0) -> str:
    """Formats the mean and the 95th percentile of a force or depth, such as "7.1, 19.3"."""
    measures = {**row.forces, **row.plausibility}
    # The mean of a force is `NAME_mean` in a row, that of a depth is `NAME`
    mean = measures.get(f"{name}_mean", measures.get(name))
    percentile = measures.get(f"{name}_p95")
    if mean is None or percentile is None:
        return NONE
    return f"{factor * mean:.1f}, {factor * percentile:.1f}"


def errors_text(errors: Mapping[str, float | None]) -> str:
    """Formats errors by constraint, such as "0.137 rad 0.020 m"; a comma separates constraints."""
    texts = []
    for names in ERROR_COLUMNS.values():
        errors_of_constraint = []
        for name in names:
            error = errors.get(name)
            if error is not None:
                errors_of_constraint.append(f"{error:.3f} {UNITS[name]}".strip())
        if errors_of_constraint:
            texts.append(" ".join(errors_of_constraint))
    return ", ".join(texts)


def error_columns(rows: Sequence[Row]) -> Columns[Row]:
    """Columns of the errors that some row has, in degrees, millimetres and per cent, with the
    paper's as notes.
    """
    columns = []
    for constraint, names in ERROR_COLUMNS.items():
        for name in names:
            if all(row.errors.get(name) is None for row in rows):
                continue
            unit, factor = _SMALL_UNITS[UNITS[name]]
            columns.append((f"{constraint}, {unit}", _error_cell(name, factor)))
    return columns


def _error_cell(name: str, factor: float) -> Callable[[Row], Styled]:
    """Cell of an error: ours, with the paper's as a note."""

    def cell(row: Row) -> Styled:
        """Returns the cell of one row."""
        paper_errors = row.paper.errors if row.paper else {}
        ours = _format_error(row.errors.get(name), factor)
        paper = _format_error(paper_errors.get(name), factor)
        return Styled(ours, "number", paper)

    return cell


def _format_error(error: float | None, factor: float) -> str:
    """Formats an error; empty if there is none."""
    return "" if error is None else f"{factor * error:.1f}"


def _episodes(row: Row) -> str:
    """Number of episodes, and of different ones if some are equal."""
    if row.distinct == row.episodes:
        return str(row.episodes)
    return f"{row.episodes} ({row.distinct} different)"


def _objects(row: Row) -> str:
    """Number of objects, and of requested ones if some are not covered."""
    if row.covered == row.pool:
        return str(row.covered)
    return f"{row.covered} of {row.pool}"


def _of_all_objects(row: Row) -> str:
    """Success and held, counting uncovered objects as failures."""
    rates = [rate for rate in (row.success_all, row.held_all) if rate is not None]
    return ", ".join(map(percent, rates))


def _paper(row: Row) -> str:
    """Success and errors of the paper; empty if it has none."""
    if not row.paper:
        return ""
    return f"{paper_rate(row)}  {errors_text(row.paper.errors)}".strip()


def _depth_in_object(row: Row) -> str:
    """Depth of the hand in the object, and of its meshes if it has some."""
    depth = format_measure(row, "hand_object_mm")
    if row.plausibility.get("hand_mesh_mm") is None:
        return depth
    return f"{depth}, its meshes {format_measure(row, 'hand_mesh_mm')}"


def _peak(name: str) -> Callable[[Row], str]:
    """Cell of a peak of the wrist."""

    def cell(row: Row) -> str:
        """Returns the cell of one row."""
        peak = row.plausibility.get(name)
        return NONE if peak is None else f"{peak:.3g}"

    return cell


def _posture(row: Row) -> str:
    """Deviation from natural postures in degrees."""
    deviation = row.plausibility.get("posture_rad")
    return NONE if deviation is None else f"{np.degrees(deviation):.1f}"


def _rate_cell(name: str) -> Callable[[Row], str]:
    """Cell of a rate of plausibility."""
    return lambda row: percent(row.plausibility.get(name))


SCORES: Columns[Row] = (
    ("constraint", row_title),
    ("episodes", _episodes),
    ("objects", _objects),
    ("success", lambda row: percent(row.success, row.success_low, row.success_high)),
    ("held 2 s", lambda row: percent(row.held_2s, row.held_2s_low, row.held_2s_high)),
    ("of all objects", _of_all_objects),
    ("error", lambda row: errors_text(row.errors)),
    ("paper", _paper),
)
"""Success, held and errors, with those of the paper. "Of all objects": success and held, counting
uncovered objects as failures."""
SCORE_CELLS = dict(SCORES)
"""Functions from a row to its cell, by the columns of `SCORES`."""
_SURVIVAL_HEADS = ("lifted", "pushed by half the weight", "and by 1 N")
"""Columns of `SURVIVAL_NAMES`; they are neighbours, and the third head continues the second."""
PLAUSIBILITY: Columns[Row] = (
    ("constraint", row_title),
    ("hand in hand, mm", lambda row: format_measure(row, "hand_hand_mm")),
    ("in table, mm", lambda row: format_measure(row, "hand_table_mm")),
    ("in object, mm", _depth_in_object),
    ("wrist m/s", _peak("wrist_speed")),
    ("m/s²", _peak("wrist_acceleration")),
    ("clean", _rate_cell("clean")),
    *zip(_SURVIVAL_HEADS, map(_rate_cell, SURVIVAL_NAMES), strict=True),
)
"""Plausibility: deepest penetrations (mean, 95th percentile), also of the hand's meshes into the
object if it has some; peak speed and acceleration of the wrist; rates. Each push is a series of six
(`actors.stress.Protocol`)."""
POSTURE: Columns[Row] = (("posture off, °", _posture),)
"""Deviation of the fingers from natural postures (`common.task.posture`); files of earlier versions
have none."""
FORCES: Columns[Row] = (
    ("constraint", row_title),
    ("link, N", lambda row: format_measure(row, "link_force")),
    ("sum, N", lambda row: format_measure(row, "force_sum")),
    ("torque, % of limit", lambda row: format_measure(row, "torque_share", 100.0)),
    ("links in contact at table removal", lambda row: f"{row.links_at_removal:.1f}"),
    ("diverged", lambda row: percent(row.diverged)),
)
"""Forces after the removal of the table: mean, 95th percentile."""


def tables_of(
    rows: Sequence[Row], title: str, missing: Sequence[tuple[str, str, str]] = ()
) -> list[Table]:
    """Returns rows as tables: scores with those of the paper, plausibility, then forces.

    Args:
      rows: rows of one policy or of several. Rows with equal titles are brought together; with
        several policies, columns name each row's hand and method.
      title: title of the first table.
      missing: (hand, method, reason) of each policy without a row.
    """
    titles = list(dict.fromkeys(map(row_title, rows)))
    rows = sorted(rows, key=lambda row: titles.index(row_title(row)))
    policy_columns: Columns[Row] = ()
    if missing or _several_policies(rows):
        policy_columns = (("hand", lambda row: row.hand), ("method", lambda row: row.method))
    columns_by_title = {
        title: SCORES,
        "Plausibility of all episodes": (*PLAUSIBILITY, *posture_columns(rows)),
        FORCES_TITLE: FORCES,
    }
    tables = []
    for table_title, (first_column, *other_columns) in columns_by_title.items():
        columns = (first_column, *policy_columns, *other_columns)
        tables.append(Table.of(table_title, rows, columns))
    scores, *other_tables = tables
    missing_rows = []
    for hand, method, reason in missing:
        # The reason is in the first column; the cells after those of the policy are empty
        cells = [reason, hand, method]
        cells += [""] * (len(scores.columns) - len(cells))
        missing_rows.append(cells)
    return [dataclasses.replace(scores, rows=[*scores.rows, *missing_rows]), *other_tables]


def _several_policies(rows: Sequence[Row]) -> bool:
    """True if rows are of more than one policy."""
    return len({(row.hand, row.method) for row in rows}) > 1


def posture_columns(rows: Sequence[Row]) -> Columns[Row]:
    """Returns `POSTURE` if one of the rows has the measure, and no column otherwise."""
    if any(row.plausibility.get("posture_rad") is not None for row in rows):
        return POSTURE
    return ()


def object_table(rows: Sequence[Row]) -> Table:
    """Returns the success and held rates of each object (a line) in each row (a column)."""
    heads = [row_title(row) for row in rows]
    if _several_policies(rows):
        heads = [f"{row_title(row)}, {row.hand}, {row.method}" for row in rows]
    cells = dict[str, list[str]]()
    for column, row in enumerate(rows):
        for rates in row.objects:
            line = cells.setdefault(rates["name"], [""] * len(rows))
            line[column] = _object_rates(rates)
    lines = [[name, *line] for name, line in cells.items()]
    return Table("By object: success, held 2 s", ["object", *heads], lines)


def _object_rates(rates: Mapping[str, float]) -> str:
    """Formats success and held of an object."""
    return ", ".join(percent(rates[name]) for name in ("success", "held_2s") if name in rates)
