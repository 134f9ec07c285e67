"""Rows of an evaluation: rates with intervals, errors, forces, and the paper's figures for
comparison.
"""

import dataclasses
import json
import math
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from congrasp.actors.stress import ASSESSED, SURVIVAL
from congrasp.common.io.files import write_atomically
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.plausibility import CLEAN_MM
from congrasp.services.evaluate.episodes import Sample
from congrasp.services.evaluate.paper import PaperRow, paper_row
from congrasp.services.evaluate.plan import ALIGNED

TABLES = {
    "single": tuple(constraint.name for constraint in CONSTRAINTS),
    "composed": ("pose+trajectory", f"pose+trajectory{ALIGNED}", "trajectory+affordance"),
    "cross": ("heading", "pose", "trajectory", "pose+trajectory"),
}
"""Rows of the paper's tables, by active constraints; the aligned pairs are not in the paper."""
ERRORS = {c.name: {spec.name: spec.column or spec.name for spec in c.errors} for c in CONSTRAINTS}
"""Names of the errors of each constraint, in the metrics of episodes and in rows."""
UNITS = {
    spec.column or spec.name: spec.unit for constraint in CONSTRAINTS for spec in constraint.errors
}
"""Units of the errors, by their names in rows."""
NORMAL_95 = 1.959964
"""Quantile of the normal distribution for two-sided 95 % intervals."""
_FORCES = ("link_force", "force_sum", "torque_share")
_PRESSED = ("force_peak_n", "force_mean_n")
_HUNDREDTHS = np.linspace(0, 1, 101)
_SIZES = ("small", "medium", "large")


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of a table.

    Rates have 95 % intervals (`clustered`; clusters are objects or captured sequences).
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
        errors, forces, total = row.pop("errors"), row.pop("forces"), row.pop("episode_return")
        return {**row, **errors, **forces, **row.pop("plausibility"), "return": total}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> "Row":
        """Returns the row from the result of `to_json`.

        Raises:
          LookupError, TypeError: `row` has another format.
        """
        own = {
            field.name: row[field.name] for field in dataclasses.fields(cls) if field.name in row
        }
        # Older files lack constraints that were added later.
        errors = {name: row.get(name) for names in ERRORS.values() for name in names.values()}
        forces = {f"{name}_{of}": row[f"{name}_{of}"] for name in _FORCES for of in ("mean", "p95")}
        forces |= {name: row[name] for name in _PRESSED}
        known = {*own, *errors, *forces, "return"}
        measured = {name: value for name, value in row.items() if name not in known}
        own |= {
            "paper": PaperRow(**row["paper"]) if row["paper"] else None,
            "plausibility": measured,
        }
        return cls(**own, errors=errors, forces=forces, episode_return=row["return"])


def known_rows(tables: Iterable[str], task: TaskConfig) -> list[str]:
    """Names of the rows of some of `TABLES` whose constraints the task's policy supports."""
    rows = dict.fromkeys(row for table in tables for row in TABLES[table])
    return [
        row for row in rows if set(row.removesuffix(ALIGNED).split("+")) <= set(task.constraints)
    ]


def summarise(  # noqa: PLR0913
    name: str,
    hand: str,
    sample: Sample,
    *,
    held_2s: bool,
    objects: Sequence[str],
    pool: int | None = None,
    by_reference: bool = False,
    group: str = "",
    method: str = "ours",
    paper: str = "",
) -> Row:
    """Computes a row from its episodes.

    Args:
      name: name of the row, see `services.evaluate.plan.plan_row`.
      hand: name of the hand.
      sample: episodes of the row.
      held_2s: True if the episodes lasted for two seconds without the table.
      objects: names of the pool's objects, including those without an episode.
      pool: number of requested objects, if the row covers only some of them; all by default.
      by_reference: uses references, such as captured sequences, as clusters of the intervals
        instead of objects.
      group: group of objects, such as "small (below 8 cm)".
      method: method of `common.task.methods`.
      paper: table of the paper for comparison, see `services.evaluate.paper`.
    """
    constraint = name.removesuffix(ALIGNED)
    group = group or ("aligned pairs" if name.endswith(ALIGNED) else "")
    values, pool = sample.values, pool or len(objects)
    success, index = values["success"] > 0, values["object_index"]
    clusters = values["reference"] if by_reference else index
    held = _rates(("held_2s", "held_all"), values["held"] > 0, clusters, index, pool)
    found = {
        name: values[source][success]
        for part in constraint.split("+")
        for source, name in ERRORS[part].items()
    }
    reached = {name: error for name, error in found.items() if len(error)}
    means = {name: float(error.mean()) for name, error in reached.items()}
    return Row(
        constraint=constraint,
        hand=hand,
        method=method,
        group=group,
        episodes=len(success),
        covered=len(np.unique(index)),
        pool=pool,
        distinct=len(np.unique(values["identity"])),
        independent=independent_episodes(success, clusters),
        mass_kg=float(values["mass_kg"].mean()),
        **_rates(("success", "success_all"), success, clusters, index, pool),
        **(held if held_2s else dict.fromkeys(held)),
        errors={name: means.get(name) for names in ERRORS.values() for name in names.values()},
        forces=_forces(sample.where(success)),
        episode_return=float(values["return"].mean()),
        links_at_removal=float(values["links_at_removal"].mean()),
        diverged=float((values["diverged"] > 0).mean()),
        paper=paper_row(paper, hand, method, constraint, group),
        plausibility=_plausibility(values, held_2s),
        margins={
            name: NORMAL_95 * standard_error(error)
            for name, error in reached.items()
            if len(error) > 1
        },
        quantiles={
            name: np.quantile(error, _HUNDREDTHS).round(6).tolist()
            for name, error in reached.items()
        },
        objects=_by_object(values, objects, held_2s),
    )


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
    low, high = clustered(outcomes, clusters)
    _, members = np.unique(objects, return_inverse=True)
    of_each = np.bincount(members, outcomes) / np.bincount(members)
    found = {names[0]: float(outcomes.mean()), f"{names[0]}_low": low, f"{names[0]}_high": high}
    return {**found, names[1]: float(of_each.sum() / pool)}


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
    of_each = {name: np.bincount(index, column, len(objects)) for name, column in columns.items()}
    return [
        {"name": objects[i], "episodes": int(counts[i])}
        | {name: float(total[i] / counts[i]) for name, total in of_each.items()}
        for i in np.flatnonzero(counts).tolist()
    ]


def _plausibility(values: dict[str, np.ndarray], held_2s: bool) -> dict[str, float | None]:
    """Means of the plausibility measures; None if not measured, or if they need the missing
    two-second hold.
    """
    row: dict[str, float | None] = {}
    for name in ASSESSED:
        column = values.get(name, np.zeros(0))
        column = column[~np.isnan(column)]
        rate = name == "clean" or name in SURVIVAL
        row[name] = float(column.mean()) if len(column) and (held_2s or not rate) else None
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
    samples = links[links > 0], links.sum(-1).ravel(), np.asarray(sample.torque, np.float32).ravel()
    row: dict[str, float | None] = {}
    for name, found in zip(_FORCES, samples, strict=True):
        row[f"{name}_mean"] = float(found.mean()) if found.size else None
        row[f"{name}_p95"] = float(np.percentile(found, 95)) if found.size else None
    strongest = links.max(-1) if links.size else np.zeros(0)
    row["force_peak_n"] = float(strongest.max(-1).mean()) if strongest.size else None
    row["force_mean_n"] = float(strongest.mean()) if strongest.size else None
    return row


def wilson(rate: float, count: float) -> tuple[float, float]:
    """95 % Wilson score interval of a rate.

    Args:
      rate: share of successes.
      count: number of independent episodes, not necessarily an integer.
    """
    if count <= 0:
        return 0.0, 1.0
    z2 = NORMAL_95**2
    center = (rate + z2 / (2 * count)) / (1 + z2 / count)
    half = NORMAL_95 / (1 + z2 / count) * math.sqrt(rate * (1 - rate) / count + z2 / (4 * count**2))
    return max(center - half, 0.0), min(center + half, 1.0)


def independent_episodes(outcomes: np.ndarray, clusters: np.ndarray) -> float:
    """Number of independent episodes with the same variance of the rate as these clustered ones.

    It is the number of episodes over the design effect (Kish, Survey Sampling, 1965): the
    cluster-robust variance of the rate, G / (G - 1) sum_g (sum_{i in g} (y_i - p))^2 / n^2, over p
    (1 - p) / n. The design effect is at least 1. If all episodes have the same outcome it cannot be
    estimated, and each cluster counts once. Episodes of a single cluster count as independent, and
    the rate is that of the cluster.

    Args:
      outcomes: (E,) bool.
      clusters: (E,) label of the cluster of each episode.
    """
    count, rate = len(outcomes), float(np.mean(outcomes)) if len(outcomes) else 0.0
    _, members = np.unique(clusters, return_inverse=True)
    number = int(members.max(initial=-1)) + 1
    if number <= 1:
        return float(count)
    if rate in (0.0, 1.0):
        return float(number)
    off = np.bincount(members, np.asarray(outcomes, float) - rate)
    robust = number / (number - 1) * float(off @ off) / count**2
    return count / max(robust * count / (rate * (1 - rate)), 1.0)


def clustered(outcomes: np.ndarray, clusters: np.ndarray) -> tuple[float, float]:
    """95 % interval of the rate of outcomes (E,) in clusters (E,): Wilson's, with
    `independent_episodes`.
    """
    rate = float(np.mean(outcomes)) if len(outcomes) else 0.0
    return wilson(rate, independent_episodes(outcomes, clusters))


def standard_error(values: np.ndarray) -> float:
    """Standard error of the mean of independent values (E,), at least two."""
    return float(values.std(ddof=1) / np.sqrt(len(values)))


def terciles(
    values: np.ndarray, names: Sequence[str], unit: str, factor: float
) -> tuple[np.ndarray, list[str]]:
    """Divides objects into three groups of equal size by a property (N,).

    Returns:
      Groups (N,) of the objects, 0 to 2, and labels of the groups with their bounds.
    """
    low, high = (float(x) for x in np.quantile(values, [1 / 3, 2 / 3]))
    labels = [
        f"{names[0]} (up to {factor * low:.3g} {unit})",
        f"{names[1]} ({factor * low:.3g} to {factor * high:.3g} {unit})",
        f"{names[2]} (above {factor * high:.3g} {unit})",
    ]
    return (values > low).astype(int) + (values > high), labels


def object_groups(
    sizes: np.ndarray, masses: np.ndarray, families: np.ndarray
) -> list[tuple[str, np.ndarray]]:
    """Labels and members (N,) bool of the groups of objects in the test on unseen geometry.

    The paper stratifies by size without giving bounds. The groups are terciles of the largest side
    (m), terciles of the mass (kg), and families.
    """
    groups = []
    for values, names, unit, factor in (
        (sizes, _SIZES, "cm", 100.0),
        (masses, ("light", "mid", "heavy"), "g", 1000.0),
    ):
        of_object, labels = terciles(values, names, unit, factor)
        groups += [(label, of_object == i) for i, label in enumerate(labels)]
    return groups + [(f"family {family}", families == family) for family in np.unique(families)]


def write_json(rows: Sequence[Row], path: pathlib.Path, about: dict[str, Any]) -> None:
    """Writes `{"rows": [...]}`, one line per row, with the metadata of the evaluation."""
    head = json.dumps({**about, "rows": []}, indent=1).removesuffix("]\n}")
    lines = ",\n".join(json.dumps(row.to_json()) for row in rows)
    write_atomically(path, f"{head}\n{lines}\n ]\n}}\n".encode())
