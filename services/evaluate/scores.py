"""Rows of an evaluation: rates with intervals, errors, forces, and the paper's figures for
comparison.
"""

import dataclasses
import itertools
import json
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from congrasp.actors.stress import ASSESSED_NAMES, SURVIVAL_NAMES
from congrasp.common.io.files import write_atomically
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.constraints.base import Constraint
from congrasp.common.task.plausibility import CLEAN_MM
from congrasp.services.evaluate.episodes import Sample
from congrasp.services.evaluate.intervals import (
    NORMAL_95,
    clustered_interval,
    independent_episodes,
    standard_error,
)
from congrasp.services.evaluate.paper.figures import PaperRow, paper_row
from congrasp.services.evaluate.plan import ALIGNED

TABLES = {
    "single": tuple(constraint.name for constraint in CONSTRAINTS),
    "composed": ("pose+trajectory", f"pose+trajectory{ALIGNED}", "trajectory+affordance"),
    "cross": ("heading", "pose", "trajectory", "pose+trajectory"),
}
"""Rows of the paper's tables, by active constraints; the aligned pairs are not in the paper."""


def _columns_of_errors(constraint: Constraint) -> dict[str, str]:
    """Names of the errors of a constraint in rows, by their names in the metrics of episodes."""
    return {spec.name: spec.column or spec.name for spec in constraint.errors}


def _units_of_errors() -> dict[str, str]:
    """Units of the errors of all constraints, by their names in rows."""
    units = {}
    for constraint in CONSTRAINTS:
        for spec in constraint.errors:
            units[spec.column or spec.name] = spec.unit
    return units


ERRORS = {constraint.name: _columns_of_errors(constraint) for constraint in CONSTRAINTS}
"""Names of the errors of each constraint, in the metrics of episodes and in rows."""
ERROR_COLUMNS: dict[str, tuple[str, ...]] = {
    constraint: tuple(columns.values()) for constraint, columns in ERRORS.items()
}
"""Names of the errors of each constraint in rows."""
UNITS = _units_of_errors()
"""Units of the errors, by their names in rows."""
_FORCE_COLUMNS = (
    "link_force_mean",
    "link_force_p95",
    "force_sum_mean",
    "force_sum_p95",
    "torque_share_mean",
    "torque_share_p95",
    "force_peak_n",
    "force_mean_n",
)
_HUNDREDTHS = np.linspace(0, 1, 101)


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of a table.

    Rates have 95 % intervals (`clustered_interval`; clusters are objects or captured sequences).
    Errors and forces are averaged over successful episodes.
    """

    constraint: str
    hand: str
    method: str
    group: str
    """Group of objects or pairs; empty for all of them."""
    episodes: int
    covered: int
    """Number of objects that allow the row's constraints."""
    pool: int
    """Number of requested objects."""
    distinct: int
    """Number of different episodes: those with the same initial conditions and goal count once."""
    independent: float
    """Number of independent episodes behind the interval of the success rate."""
    mass_kg: float
    """Mean mass of the episodes' objects, kg."""
    success: float
    success_low: float
    success_high: float
    success_all: float
    """Success rate over all requested objects, counting every uncovered object as a failure."""
    held_2s: float | None
    """Rate of success that lasts for two seconds without the table; None if episodes ended
    earlier.
    """
    held_2s_low: float | None
    held_2s_high: float | None
    held_all: float | None
    """Like `success_all`, for two seconds."""
    errors: dict[str, float | None]
    forces: dict[str, float | None]
    episode_return: float
    links_at_removal: float
    diverged: float
    """Rate of episodes with diverged physics."""
    paper: PaperRow | None
    plausibility: dict[str, float | None] = dataclasses.field(default_factory=dict)
    """Means of the measures over all episodes, `_p95` of the deepest penetrations, and rates
    (`actors.stress`).
    """
    margins: dict[str, float] = dataclasses.field(default_factory=dict)
    """Half of the 95 % interval of each error's mean (two successful episodes at least): 1.96
    standard errors.
    """
    quantiles: dict[str, list[float]] = dataclasses.field(default_factory=dict)
    """Quantiles of each error in successful episodes: minimum, every hundredth, and maximum; 101
    numbers.
    """
    objects: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    """Name, number of episodes and rates of each object with episodes."""

    def to_json(self) -> dict[str, Any]:
        """Returns the row as written to `--json`."""
        row = dataclasses.asdict(self)
        errors = row.pop("errors")
        forces = row.pop("forces")
        plausibility = row.pop("plausibility")
        total = row.pop("episode_return")
        return {**row, **errors, **forces, **plausibility, "return": total}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> "Row":
        """Returns the row from the result of `to_json`.

        Raises:
          LookupError, TypeError: `row` has another format.
        """
        fields = {
            field.name: row[field.name] for field in dataclasses.fields(cls) if field.name in row
        }
        # Older files lack constraints that were added later.
        errors = {name: row.get(name) for name in UNITS}
        forces = {name: row[name] for name in _FORCE_COLUMNS}
        other_columns = {*fields, *errors, *forces, "return"}
        plausibility = {name: value for name, value in row.items() if name not in other_columns}
        paper = PaperRow(**row["paper"]) if row["paper"] else None
        fields |= {"paper": paper, "plausibility": plausibility}
        return cls(**fields, errors=errors, forces=forces, episode_return=row["return"])


def known_rows(tables: Iterable[str], task: TaskConfig) -> list[str]:
    """Names of the rows of some of `TABLES` whose constraints the task's policy supports."""
    supported = []
    rows = itertools.chain.from_iterable(TABLES[table] for table in tables)
    for row in dict.fromkeys(rows):
        constraints = row.removesuffix(ALIGNED).split("+")
        if set(constraints) <= set(task.constraints):
            supported.append(row)
    return supported


@dataclasses.dataclass(frozen=True)
class RowDescription:
    """Description of a row's episodes."""

    name: str
    """Name of the row, see `services.evaluate.plan.plan_row`."""
    hand: str
    """Name of the hand."""
    objects: Sequence[str]
    """Names of the pool's objects, including those without an episode."""
    held_2s: bool
    """True if the episodes lasted for two seconds without the table."""
    pool: int | None = None
    """Number of requested objects, if the row covers only some of them; all if None."""
    by_reference: bool = False
    """True if references, such as captured sequences, are the clusters of the intervals instead of
    objects.
    """
    group: str = ""
    """Group of objects, such as "small (below 8 cm)"."""
    method: str = "ours"
    """Method of `common.task.methods`."""
    paper: str = ""
    """Table of the paper for comparison, see `services.evaluate.paper.figures`."""

    @property
    def constraint(self) -> str:
        """Constraints joined by `+`."""
        return self.name.removesuffix(ALIGNED)

    @property
    def title(self) -> str:
        """Group of objects or pairs."""
        if not self.group and self.name.endswith(ALIGNED):
            return "aligned pairs"
        return self.group


def summarise(description: RowDescription, sample: Sample) -> Row:
    """Computes a row from its episodes."""
    values = sample.values
    success = values["success"] > 0
    index = values["object_index"]
    clusters = values["reference"] if description.by_reference else index
    pool = description.pool or len(description.objects)
    held = _rates(("held_2s", "held_all"), values["held"] > 0, clusters, index, pool)
    if not description.held_2s:
        held = dict.fromkeys(held)
    errors = _errors_of_successes(description.constraint, values, success)
    means = {name: float(error.mean()) for name, error in errors.items()}
    return Row(
        constraint=description.constraint,
        hand=description.hand,
        method=description.method,
        group=description.title,
        episodes=len(success),
        covered=len(np.unique(index)),
        pool=pool,
        distinct=len(np.unique(values["identity"])),
        independent=independent_episodes(success, clusters),
        mass_kg=float(values["mass_kg"].mean()),
        **_rates(("success", "success_all"), success, clusters, index, pool),
        **held,
        errors={name: means.get(name) for name in UNITS},
        forces=_forces(sample.where(success)),
        episode_return=float(values["return"].mean()),
        links_at_removal=float(values["links_at_removal"].mean()),
        diverged=float((values["diverged"] > 0).mean()),
        paper=paper_row(
            description.paper,
            description.hand,
            description.method,
            description.constraint,
            description.title,
        ),
        plausibility=_plausibility(values, description.held_2s),
        margins={
            name: NORMAL_95 * standard_error(error)
            for name, error in errors.items()
            if len(error) > 1
        },
        quantiles={
            name: np.quantile(error, _HUNDREDTHS).round(6).tolist()
            for name, error in errors.items()
        },
        objects=_by_object(values, description.objects, description.held_2s),
    )


def _errors_of_successes(
    constraint: str, values: Mapping[str, np.ndarray], success: np.ndarray
) -> dict[str, np.ndarray]:
    """Errors of successful episodes by their names in rows; empty if no episode succeeded."""
    if not success.any():
        return {}
    errors = {}
    for part in constraint.split("+"):
        for metric, name in ERRORS[part].items():
            errors[name] = values[metric][success]
    return errors


def _rates(
    names: tuple[str, str],
    outcomes: np.ndarray,
    clusters: np.ndarray,
    objects: np.ndarray,
    pool: int,
) -> dict[str, Any]:
    """Columns of a rate: its mean over episodes with the interval, and over `pool` objects, some
    without episodes.

    Args:
      names: names of the two means.
      outcomes: (E,) bool.
      clusters: (E,) labels of clusters, see `independent_episodes`.
      objects: (E,) index of each episode's object.
      pool: number of objects; those without episodes have a rate of 0.
    """
    over_episodes, over_pool = names
    low, high = clustered_interval(outcomes, clusters)
    _, members = np.unique(objects, return_inverse=True)
    rate_of_object = np.bincount(members, outcomes) / np.bincount(members)
    return {
        over_episodes: float(outcomes.mean()),
        f"{over_episodes}_low": low,
        f"{over_episodes}_high": high,
        over_pool: float(rate_of_object.sum() / pool),
    }


def _by_object(
    values: dict[str, np.ndarray], objects: Sequence[str], held_2s: bool
) -> list[dict[str, Any]]:
    """Rates of each object with episodes, in the pool's order."""
    index = values["object_index"].astype(int)
    counts = np.bincount(index, minlength=len(objects))
    columns = {"success": values["success"] > 0}
    if held_2s:
        columns["held_2s"] = values["held"] > 0
        if "clean" in values:
            columns["clean"] = values["clean"] > 0
    totals = {name: np.bincount(index, column, len(objects)) for name, column in columns.items()}
    rows = []
    for i in np.flatnonzero(counts).tolist():
        rates = {name: float(total[i] / counts[i]) for name, total in totals.items()}
        rows.append({"name": objects[i], "episodes": int(counts[i]), **rates})
    return rows


def _plausibility(values: dict[str, np.ndarray], held_2s: bool) -> dict[str, float | None]:
    """Means of the plausibility measures; None if not measured, or if they need the missing
    two-second hold.
    """
    row: dict[str, float | None] = {}
    for name in ASSESSED_NAMES:
        column = values.get(name, np.zeros(0))
        column = column[~np.isnan(column)]
        needs_hold = name == "clean" or name in SURVIVAL_NAMES
        row[name] = None
        if len(column) and (held_2s or not needs_hold):
            row[name] = float(column.mean())
        if name in CLEAN_MM:
            row[f"{name}_p95"] = float(np.percentile(column, 95)) if len(column) else None
    return row


def _forces(sample: Sample) -> dict[str, float | None]:
    """Mean and 95th percentile of: force of a touching link, sum over the links, and finger torque
    over its limit.

    `force_peak_n` is the greatest force of a link in an episode, `force_mean_n` that of the
    strongest link in a step. Both are means over the episodes.
    """
    links = np.asarray(sample.link_force, np.float32)
    samples = {
        "link_force": links[links > 0],
        "force_sum": links.sum(-1).ravel(),
        "torque_share": np.asarray(sample.torque, np.float32).ravel(),
    }
    row: dict[str, float | None] = {}
    for name, values in samples.items():
        row[f"{name}_mean"] = float(values.mean()) if values.size else None
        row[f"{name}_p95"] = float(np.percentile(values, 95)) if values.size else None
    strongest = links.max(-1) if links.size else np.zeros(0)
    row["force_peak_n"] = float(strongest.max(-1).mean()) if strongest.size else None
    row["force_mean_n"] = float(strongest.mean()) if strongest.size else None
    return row


def write_json(rows: Sequence[Row], path: pathlib.Path, about: dict[str, Any]) -> None:
    """Writes `{"rows": [...]}`, one line per row, with the metadata of the evaluation."""
    head = json.dumps({**about, "rows": []}, indent=1).removesuffix("]\n}")
    lines = ",\n".join(json.dumps(row.to_json()) for row in rows)
    write_atomically(path, f"{head}\n{lines}\n ]\n}}\n".encode())
