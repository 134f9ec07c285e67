"""Rows of an evaluation: rates with intervals, errors, forces, and the paper's figures to compare them with."""

import dataclasses
import json
import pathlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from congrasp.actors.stress import ASSESSED, SURVIVAL
from congrasp.common.config import TaskConfig
from congrasp.common.io.files import write_atomically
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.plausibility import CLEAN_MM
from congrasp.services.evaluate.paper import PaperRow, paper_row
from congrasp.services.evaluate.plan import ALIGNED

TABLES = {
    "single": tuple(constraint.name for constraint in CONSTRAINTS),
    "composed": ("pose+trajectory", f"pose+trajectory{ALIGNED}", "trajectory+affordance"),
    "cross": ("heading", "pose", "trajectory", "pose+trajectory"),
}
"""Rows of the paper's tables, by the constraints that are active; the aligned pairs are none of the paper's."""
ERRORS = {c.name: {spec.name: spec.column or spec.name for spec in c.errors} for c in CONSTRAINTS}
"""Of each constraint: names of its errors among the metrics of episodes and in the rows."""
_UNITS = {spec.column or spec.name: spec.unit for constraint in CONSTRAINTS for spec in constraint.errors}
PROBED_EPISODES = 2000
"""Forces are read from this many episodes of a row at most."""
_FORCES = ("link_force", "force_sum", "torque_share")
_PRESSED = ("force_peak_n", "force_mean_n")
_NORMAL_95 = 1.959964
_HUNDREDTHS = np.linspace(0, 1, 101)
_SIZES = ("small", "medium", "large")


@dataclasses.dataclass(frozen=True)
class Sample:
    """Episodes that count for one row."""

    values: dict[str, np.ndarray]
    """Metrics (E,), by the names in `actors.env.metric_names`."""
    link_force: np.ndarray
    """(E', W, L) net contact force of each link in the paper's window, N; of the first E' of the episodes."""
    torque: np.ndarray
    """(E', W, F) finger torques in that window, as shares of their limits."""

    def where(self, chosen: np.ndarray) -> "Sample":
        """The episodes that `chosen` (E,) selects."""
        kept = chosen[: len(self.link_force)]
        values = {name: column[chosen] for name, column in self.values.items()}
        return Sample(values, self.link_force[kept], self.torque[kept])

    def first(self, count: int) -> "Sample":
        """The first `count` episodes."""
        values = {name: column[:count] for name, column in self.values.items()}
        return Sample(values, self.link_force[:count], self.torque[:count])


def joined(samples: Sequence[Sample]) -> Sample:
    """All episodes of several samples, with forces of the first `PROBED_EPISODES` at most."""
    probed: list[Sample] = []
    for sample in samples:
        probed.append(sample)
        if len(sample.link_force) < len(sample.values["success"]):
            break
    return Sample(
        {name: np.concatenate([sample.values[name] for sample in samples]) for name in samples[0].values},
        np.concatenate([sample.link_force for sample in probed])[:PROBED_EPISODES],
        np.concatenate([sample.torque for sample in probed])[:PROBED_EPISODES],
    )


@dataclasses.dataclass(frozen=True)
class Row:
    """One row: rates with 95 % Wilson intervals, errors and forces averaged over successful episodes."""

    constraint: str
    hand: str
    method: str
    group: str
    """Which objects or pairs: empty for all of them."""
    episodes: int
    covered: int
    """Objects that allow the row's constraints."""
    pool: int
    """Objects that were asked for."""
    success: float
    success_low: float
    success_high: float
    held_2s: float | None
    """Rate of success that lasts for two seconds without the table; None where episodes ended before."""
    held_2s_low: float | None
    held_2s_high: float | None
    errors: dict[str, float | None]
    forces: dict[str, float | None]
    episode_return: float
    links_at_removal: float
    diverged: float
    """Rate of episodes in which the physics failed."""
    paper: PaperRow | None
    plausibility: dict[str, float | None] = dataclasses.field(default_factory=dict)
    """Over all episodes: means of the measures, `_p95` of the deepest penetrations, and rates (`actors.stress`)."""
    margins: dict[str, float] = dataclasses.field(default_factory=dict)
    """Of each error with two successful episodes: half of the 95 % interval of its mean, 1.96 standard errors."""
    quantiles: dict[str, list[float]] = dataclasses.field(default_factory=dict)
    """Of each error in successful episodes: least, every further hundredth, and greatest; 101 numbers."""
    objects: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    """Of each object with episodes: its name, their number, and its rates."""

    def to_json(self) -> dict[str, Any]:
        """The row as it is written to `--json`."""
        row = dataclasses.asdict(self)
        errors, forces, total = row.pop("errors"), row.pop("forces"), row.pop("episode_return")
        return {**row, **errors, **forces, **row.pop("plausibility"), "return": total}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> "Row":
        """The row that `to_json` made this of.

        Raises:
          LookupError, TypeError: it did not.
        """
        own = {field.name: row[field.name] for field in dataclasses.fields(cls) if field.name in row}
        # Files of before lack what constraints that came later measure.
        errors = {name: row.get(name) for names in ERRORS.values() for name in names.values()}
        forces = {f"{name}_{of}": row[f"{name}_{of}"] for name in _FORCES for of in ("mean", "p95")}
        forces |= {name: row.get(name) for name in _PRESSED}
        known = {*own, *errors, *forces, "return"}
        measured = {name: value for name, value in row.items() if name not in known}
        own |= {"paper": PaperRow(**row["paper"]) if row["paper"] else None, "plausibility": measured}
        return cls(**own, errors=errors, forces=forces, episode_return=row["return"])


def wilson(successes: int, count: int) -> tuple[float, float]:
    """95 % Wilson score interval of a rate."""
    if count == 0:
        return 0.0, 1.0
    from scipy.stats import binomtest

    interval = binomtest(successes, count).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def standard_error(values: np.ndarray) -> float:
    """Of the mean of independent values (E,), at least two."""
    return float(values.std(ddof=1) / np.sqrt(len(values)))


def known_rows(tables: Iterable[str], task: TaskConfig) -> list[str]:
    """Rows of some of `TABLES` whose constraints the task's policy knows."""
    rows = dict.fromkeys(row for table in tables for row in TABLES[table])
    return [row for row in rows if set(row.removesuffix(ALIGNED).split("+")) <= set(task.constraints)]


def summarise(
    name: str,
    hand: str,
    sample: Sample,
    *,
    held_2s: bool,
    objects: Sequence[str],
    group: str = "",
    method: str = "ours",
    paper: str = "",
) -> Row:
    """A row from its episodes.

    Args:
      name: of the row, see `services.evaluate.plan.plan_row`.
      hand: name of the hand.
      sample: its episodes.
      held_2s: whether the episodes lasted for two seconds without the table.
      objects: names of the pool's objects, those without an episode too.
      group: which objects these are, such as "small (below 8 cm)".
      method: `common.task.methods`.
      paper: which of the paper's tables it stands beside, see `services.evaluate.paper`.
    """
    constraint = name.removesuffix(ALIGNED)
    group = group or ("aligned pairs" if name.endswith(ALIGNED) else "")
    values = sample.values
    success, held = values["success"] > 0, values["held"] > 0
    low, high = wilson(int(success.sum()), len(success))
    held_low, held_high = wilson(int(held.sum()), len(held)) if held_2s else (None, None)
    found = {name: values[source][success] for part in constraint.split("+") for source, name in ERRORS[part].items()}
    reached = {name: error for name, error in found.items() if len(error)}
    means = {name: float(error.mean()) for name, error in reached.items()}
    return Row(
        constraint=constraint,
        hand=hand,
        method=method,
        group=group,
        episodes=len(success),
        covered=len(np.unique(values["object_index"])),
        pool=len(objects),
        success=float(success.mean()),
        success_low=low,
        success_high=high,
        held_2s=float(held.mean()) if held_2s else None,
        held_2s_low=held_low,
        held_2s_high=held_high,
        errors={name: means.get(name) for names in ERRORS.values() for name in names.values()},
        forces=_forces(sample.where(success)),
        episode_return=float(values["return"].mean()),
        links_at_removal=float(values["links_at_removal"].mean()),
        diverged=float((values["bad"] > 0).mean()),
        paper=paper_row(paper, hand, method, constraint, group),
        plausibility=_plausibility(values, held_2s),
        margins={name: _NORMAL_95 * standard_error(error) for name, error in reached.items() if len(error) > 1},
        quantiles={name: np.quantile(error, _HUNDREDTHS).round(6).tolist() for name, error in reached.items()},
        objects=_by_object(values, objects, held_2s),
    )


def _by_object(values: dict[str, np.ndarray], objects: Sequence[str], held_2s: bool) -> list[dict[str, Any]]:
    """Rates of each object that has episodes, in the pool's order."""
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
    """Measures of a row's episodes; None where none was measured, and without the two seconds that rates speak of."""
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
    """Mean and 95th percentile: force of a touching link, sum over the links, and finger torque over its limit.

    `force_peak_n` is the greatest force of a link in an episode, `force_mean_n` that of the strongest link in a step.
    Both are means over the episodes.
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


def terciles(values: np.ndarray, names: Sequence[str], unit: str, factor: float) -> tuple[np.ndarray, list[str]]:
    """Objects in three groups of equal number, by a property (N,).

    Returns:
      (N,) group of each object, 0 to 2, and the groups' labels with their bounds.
    """
    low, high = (float(x) for x in np.quantile(values, [1 / 3, 2 / 3]))
    labels = [
        f"{names[0]} (up to {factor * low:.3g} {unit})",
        f"{names[1]} ({factor * low:.3g} to {factor * high:.3g} {unit})",
        f"{names[2]} (above {factor * high:.3g} {unit})",
    ]
    return (values > low).astype(int) + (values > high), labels


def object_groups(sizes: np.ndarray, masses: np.ndarray, families: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Label and members (N,) bool of the groups of objects that the test on unseen geometry reports.

    The paper stratifies by size without giving bounds: here they are terciles of the largest side (m), then terciles
    of the mass (kg), then families.
    """
    groups = []
    for values, names, unit, factor in ((sizes, _SIZES, "cm", 100.0), (masses, ("light", "mid", "heavy"), "g", 1000.0)):
        of_object, labels = terciles(values, names, unit, factor)
        groups += [(label, of_object == i) for i, label in enumerate(labels)]
    return groups + [(f"family {family}", families == family) for family in np.unique(families)]


def write_json(rows: Sequence[Row], path: pathlib.Path, about: dict[str, Any]) -> None:
    """Writes `{"rows": [...]}` together with what is known about the evaluation."""
    write_atomically(path, json.dumps({**about, "rows": [row.to_json() for row in rows]}, indent=2).encode())


RATES = ("constraint", "episodes", "objects", "success", "held 2 s", "error", "paper")
"""Columns of the table that compares with the paper; `rate_cells` fills them."""
PLAUSIBILITY = (
    "constraint",
    "hand in hand, mm",
    "in table, mm",
    "in object, mm",
    "wrist m/s",
    "m/s²",
    "clean",
    "lifted",
    "pushed",
)
"""Columns of the table of plausibility (`plausibility_cells`): deepest penetration (mean, 95th percentile), in the
object also that of the hand's own meshes where it has some; peak speed and acceleration of the wrist; rates."""
FORCES = ("constraint", "link, N", "sum, N", "torque, % of limit", "links in contact at table removal", "diverged")
"""Columns of the table of forces after the removal (mean, 95th percentile); `force_cells` fills them."""


def rate_cells(row: Row) -> tuple[str, ...]:
    """A row's cells under `RATES`."""
    return (
        _name(row),
        str(row.episodes),
        str(row.covered) if row.covered == row.pool else f"{row.covered} of {row.pool}",
        _rate(row.success, row.success_low, row.success_high),
        _rate(row.held_2s, row.held_2s_low, row.held_2s_high),
        _errors(row.errors),
        "  ".join(paper_cells(row)).strip(),
    )


def paper_cells(row: Row) -> tuple[str, str]:
    """The paper's success and errors beside a row, empty where it has none."""
    return (_percent(row.paper.success), _errors(row.paper.errors)) if row.paper else ("", "")


def force_cells(row: Row) -> tuple[str, ...]:
    """A row's cells under `FORCES`."""
    return (
        _name(row),
        _pair(row.forces["link_force_mean"], row.forces["link_force_p95"], 1.0),
        _pair(row.forces["force_sum_mean"], row.forces["force_sum_p95"], 1.0),
        _pair(row.forces["torque_share_mean"], row.forces["torque_share_p95"], 100.0),
        f"{row.links_at_removal:.1f}",
        _percent(row.diverged),
    )


def plausibility_cells(row: Row) -> tuple[str, ...]:
    """A row's cells under `PLAUSIBILITY`."""
    found = row.plausibility
    *depths, mesh = (_pair(found.get(name), found.get(f"{name}_p95"), 1.0) for name in CLEAN_MM)
    if found.get("hand_mesh_mm") is not None:
        depths[-1] += f", its meshes {mesh}"
    peaks = (found.get(name) for name in ("wrist_speed", "wrist_acceleration"))
    rates = (found.get(name) for name in ("clean", "lift_survival", "push_survival"))
    return (
        _name(row),
        *depths,
        *("-" if peak is None else f"{peak:.3g}" for peak in peaks),
        *("-" if rate is None else _percent(rate) for rate in rates),
    )


def tables_of(rows: Sequence[Row], title: str, missing: Sequence[tuple[str, str, str]] = ()) -> list[Any]:
    """Rows as rich tables: rates and errors beside the paper's, plausibility, then forces.

    Args:
      rows: of one policy, or of several, which are then named and stand beside one another for each constraint.
      title: of the first table.
      missing: hands and methods that have no row, and why.
    """
    from rich.table import Table

    several = bool(missing) or len({(row.hand, row.method) for row in rows}) > 1
    order = {name: i for i, name in enumerate(dict.fromkeys(map(_name, rows)))}
    rows = sorted(rows, key=lambda row: order[_name(row)])
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
    """Success and held rate of each object (a line) in each row (a column), as a rich table."""
    from rich.table import Table

    table = Table(title="By object: success, held 2 s", title_justify="left")
    table.add_column("object", no_wrap=True)
    found = [{of["name"]: of for of in row.objects} for row in rows]
    several = len({(row.hand, row.method) for row in rows}) > 1
    for row in rows:
        table.add_column(f"{_name(row)}, {row.hand}, {row.method}" if several else _name(row))
    for name in dict.fromkeys(name for of in found for name in of):
        cells = []
        for of in found:
            rates = [of[name][key] for key in ("success", "held_2s") if key in of[name]] if name in of else []
            cells.append(", ".join(_percent(rate) for rate in rates))
        table.add_row(name, *cells)
    return table


_FOR_PEOPLE = {"rad": ("°", 180 / np.pi), "m": ("mm", 1000.0), "": ("%", 100.0)}
"""Unit and factor in which errors are shown, by the unit in which they are kept."""


def error_title(name: str) -> str:
    """Heading of an error's column, such as "heading, mm"."""
    constraint = next(constraint for constraint, names in ERRORS.items() if name in names.values())
    return f"{constraint}, {_FOR_PEOPLE[_UNITS[name]][0]}"


def scaled(name: str, error: float | None) -> str:
    """An error under `error_title`; empty where there is none."""
    return "" if error is None else f"{_FOR_PEOPLE[_UNITS[name]][1] * error:.1f}"


def _name(row: Row) -> str:
    """Constraint and group."""
    return f"{row.constraint}, {row.group}" if row.group else row.constraint


def _percent(rate: float) -> str:
    return f"{100 * rate:.1f} %"


def _rate(rate: float | None, low: float | None, high: float | None) -> str:
    """Such as "98.7 % (96.6-99.5)"."""
    if rate is None or low is None or high is None:
        return "-"
    return f"{_percent(rate)} ({100 * low:.1f}-{100 * high:.1f})"


def _pair(mean: float | None, percentile: float | None, factor: float) -> str:
    """Such as "7.1, 19.3"."""
    return "-" if mean is None or percentile is None else f"{factor * mean:.1f}, {factor * percentile:.1f}"


def _errors(errors: dict[str, float | None] | dict[str, float]) -> str:
    """Such as "0.137 rad 0.020 m", constraint by constraint."""
    parts = []
    for names in ERRORS.values():
        found = [(errors.get(name), _UNITS[name]) for name in names.values()]
        part = " ".join(f"{value:.3f} {unit}".strip() for value, unit in found if value is not None)
        parts += [part] if part else []
    return ", ".join(parts)
