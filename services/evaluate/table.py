"""Tables of text, and how they are written: to a terminal, as Markdown, HTML and LaTeX; and the
rows of evaluations as such tables."""

import dataclasses
import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from congrasp.actors.stress import SURVIVAL
from congrasp.services.evaluate.scores import ERRORS, UNITS, Row

NONE = "\N{EN DASH}"
"""Placeholder for a missing figure."""
_Item = TypeVar("_Item")
Columns = Sequence[tuple[str, Callable[[_Item], str]]]
"""Names of columns, and functions from an item to its cell."""
_LATEX = {
    "\\": r"\textbackslash{}",
    **{character: rf"\{character}" for character in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    NONE: "--",
    "±": r"$\pm$",
    "<": r"$<$",
    ">": r"$>$",
}
_UNBROKEN = ("method", "success", "held 2 s", "object")
"""Columns without line breaks in a terminal."""


class Styled(str):
    """Text of a cell with a CSS class, and a note in grey; only HTML shows them."""

    style: str
    note: str

    def __new__(cls, text: str, style: str, note: str = "") -> "Styled":
        """Returns the text with these attributes."""
        made = super().__new__(cls, text)
        made.style, made.note = style, note
        return made

    def html(self) -> str:
        """The cell as HTML."""
        note = f' <span class="paper">{html.escape(self.note)}</span>' if self.note else ""
        return f'<td class="{self.style}">{html.escape(self)}{note}</td>'


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of text."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    @classmethod
    def of(cls, title: str, items: Iterable[_Item], columns: Columns[_Item]) -> "Table":
        """Returns a table with a row for each item."""
        return cls(
            title,
            [name for name, _ in columns],
            [[cell(item) for _, cell in columns] for item in items],
        )

    def terminal(self) -> Any:
        """The table for a terminal, as a `rich.table.Table`."""
        from rich.table import Table as Shown

        shown = Shown(title=self.title, title_justify="left")
        for column in self.columns:
            shown.add_column(column, no_wrap=column in _UNBROKEN, overflow="fold")
        for row in self.rows:
            shown.add_row(*row)
        return shown

    def markdown(self) -> list[str]:
        """Lines of Markdown, without the title."""
        lines = [self.columns, ["---"] * len(self.columns), *self.rows]
        return [
            f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines
        ]

    def html(self) -> str:
        """The table as HTML; its title is the caption."""
        heads = (
            f"<th{' class=paper' * (name == 'paper')}>{html.escape(name)}</th>"
            for name in self.columns
        )
        rows = (
            "".join(
                x.html() if isinstance(x, Styled) else f"<td>{html.escape(x)}</td>" for x in row
            )
            for row in self.rows
        )
        caption = f"<caption>{html.escape(self.title)}</caption>\n" if self.title else ""
        lines = "\n".join(f"<tr>{line}</tr>" for line in ("".join(heads), *rows))
        return f"<table>\n{caption}{lines}\n</table>"

    def latex(self, conditions: str) -> str:
        """A `table` environment for documents that load booktabs and graphicx, with a rule before
        each new first cell.

        Args:
          conditions: a sentence for the caption.
        """
        lines = [
            r"\begin{table}",
            rf"  \caption{{{escape(self.title)}. {escape(conditions)}}}",
            r"  \centering",
            r"  \resizebox{\linewidth}{!}{%",
            rf"  \begin{{tabular}}{{{'l' * len(self.columns)}}}",
            r"    \toprule",
        ]
        first = None
        for line in (self.columns, *self.rows):
            if first is not None and line[0] != first:
                lines.append(r"    \midrule")
            first = line[0]
            lines.append(f"    {' & '.join(map(escape, line))} \\\\")
        return "\n".join([*lines, r"    \bottomrule", r"  \end{tabular}}", r"\end{table}", ""])


def escape(text: str) -> str:
    """Escapes text for LaTeX."""
    return "".join(_LATEX.get(character, character) for character in text)


def percent(
    rate: float | None, low: float | None = None, high: float | None = None, unit: str = " %"
) -> str:
    """Formats a rate, with its interval if there is one: "98.7 % (96.6-99.5)"."""
    if rate is None:
        return NONE
    return f"{100 * rate:.1f}{unit}" + (
        "" if low is None or high is None else f" ({100 * low:.1f}-{100 * high:.1f})"
    )


def row_title(row: Row) -> str:
    """Constraint and group, such as "pose+trajectory, aligned pairs"."""
    return f"{row.constraint}, {row.group}" if row.group else row.constraint


def verdict(low: float, high: float, paper: float) -> str:
    """ "better" or "worse" than the paper's rate if the whole interval is, else empty."""
    return "better" if low > paper else "worse" if high < paper else ""


def paper_rate(row: Row) -> str:
    """Success of the paper; empty if it has none."""
    return percent(row.paper.success) if row.paper else ""


def measured(row: Row, name: str, factor: float = 1.0) -> str:
    """Formats the mean and the 95th percentile of a force or depth, such as "7.1, 19.3"."""
    found = {**row.forces, **row.plausibility}
    pair = found.get(f"{name}_mean", found.get(name)), found.get(f"{name}_p95")
    return NONE if None in pair else ", ".join(f"{factor * x:.1f}" for x in pair if x is not None)


def errors_text(errors: Mapping[str, float | None]) -> str:
    """Formats errors by constraint, such as "0.137 rad 0.020 m"."""
    parts = []
    for names in ERRORS.values():
        found = [(errors.get(name), UNITS[name]) for name in names.values()]
        parts.append(
            " ".join(f"{value:.3f} {unit}".strip() for value, unit in found if value is not None)
        )
    return ", ".join(filter(None, parts))


def error_columns(rows: Sequence[Row]) -> Columns[Row]:
    """Columns of the errors that some row has, in degrees, millimetres and per cent, with the
    paper's as notes.
    """
    shown = {"rad": ("°", 180 / np.pi), "m": ("mm", 1000.0), "": ("%", 100.0)}
    columns = []
    for constraint, names in ERRORS.items():
        for name in (
            name for name in names.values() if any(row.errors.get(name) is not None for row in rows)
        ):
            unit, factor = shown[UNITS[name]]

            def cell(row: Row, name: str = name, factor: float = factor) -> Styled:
                """Our error, and the paper's as a note."""
                ours, paper = (
                    "" if error is None else f"{factor * error:.1f}"
                    for error in (
                        row.errors.get(name),
                        row.paper.errors.get(name) if row.paper else None,
                    )
                )
                return Styled(ours, "number", paper)

            columns.append((f"{constraint}, {unit}", cell))
    return columns


def _mesh_note(row: Row) -> str:
    """Depth of the hand's meshes in the object, if it has some."""
    return (
        f", its meshes {measured(row, 'hand_mesh_mm')}"
        if row.plausibility.get("hand_mesh_mm") is not None
        else ""
    )


def _peak(name: str) -> Callable[[Row], str]:
    """Cell of a peak of the wrist."""
    return lambda row: NONE if (peak := row.plausibility.get(name)) is None else f"{peak:.3g}"


def _posture(row: Row) -> str:
    """Deviation from natural postures in degrees."""
    deviation = row.plausibility.get("posture_rad")
    return NONE if deviation is None else f"{np.degrees(deviation):.1f}"


def _survived(name: str) -> Callable[[Row], str]:
    """Cell of a rate of plausibility."""
    return lambda row: percent(row.plausibility.get(name))


RATES: Columns[Row] = (
    ("constraint", row_title),
    (
        "episodes",
        lambda row: (
            str(row.episodes)
            + (f" ({row.distinct} different)" if row.distinct != row.episodes else "")
        ),
    ),
    (
        "objects",
        lambda row: str(row.covered) + (f" of {row.pool}" if row.covered != row.pool else ""),
    ),
    ("success", lambda row: percent(row.success, row.success_low, row.success_high)),
    ("held 2 s", lambda row: percent(row.held_2s, row.held_2s_low, row.held_2s_high)),
    (
        "of all objects",
        lambda row: ", ".join(percent(x) for x in (row.success_all, row.held_all) if x is not None),
    ),
    ("error", lambda row: errors_text(row.errors)),
    (
        "paper",
        lambda row: (
            "  ".join((paper_rate(row), errors_text(row.paper.errors))).strip() if row.paper else ""
        ),
    ),
)
"""Rates and errors, with those of the paper. "Of all objects": success and held, counting uncovered
objects as failures."""
RATE = dict(RATES)
"""Cells of `RATES` by their columns."""
PLAUSIBILITY: Columns[Row] = (
    ("constraint", row_title),
    ("hand in hand, mm", lambda row: measured(row, "hand_hand_mm")),
    ("in table, mm", lambda row: measured(row, "hand_table_mm")),
    ("in object, mm", lambda row: measured(row, "hand_object_mm") + _mesh_note(row)),
    ("wrist m/s", _peak("wrist_speed")),
    ("m/s²", _peak("wrist_acceleration")),
    *zip(
        ("clean", "lifted", "pushed by half the weight", "and by 1 N"),
        map(_survived, ("clean", *SURVIVAL)),
        strict=True,
    ),
)
"""Plausibility: deepest penetrations (mean, 95th percentile), also of the hand's meshes into the
object if it has some; peak speed and acceleration of the wrist; rates. A push stands for six in a
row (`actors.stress.Protocol`)."""
POSTURE: Columns[Row] = (("posture off, °", lambda row: _posture(row)),)
"""Deviation of the fingers from natural postures (`common.task.posture`); files of earlier versions
have none."""
FORCES: Columns[Row] = (
    ("constraint", row_title),
    ("link, N", lambda row: measured(row, "link_force")),
    ("sum, N", lambda row: measured(row, "force_sum")),
    ("torque, % of limit", lambda row: measured(row, "torque_share", 100.0)),
    ("links in contact at table removal", lambda row: f"{row.links_at_removal:.1f}"),
    ("diverged", lambda row: percent(row.diverged)),
)
"""Forces after the removal of the table: mean, 95th percentile."""
FORCES_TITLE = "Forces after the removal: mean, 95th percentile"


def tables_of(
    rows: Sequence[Row], title: str, missing: Sequence[tuple[str, str, str]] = ()
) -> list[Table]:
    """Returns rows as tables: rates and errors with those of the paper, plausibility, then forces.

    Args:
      rows: rows of one policy, or of several, which are then named and grouped by constraint.
      title: title of the first table.
      missing: hands and methods without a row, and the reason.
    """
    order = {name: i for i, name in enumerate(dict.fromkeys(map(row_title, rows)))}
    rows = sorted(rows, key=lambda row: order[row_title(row)])
    who: Columns[Row] = ()
    if missing or len({(row.hand, row.method) for row in rows}) > 1:
        who = (("hand", lambda row: row.hand), ("method", lambda row: row.method))
    titled = {
        title: RATES,
        "Plausibility of all episodes": (*PLAUSIBILITY, *posture_columns(rows)),
        FORCES_TITLE: FORCES,
    }
    rates, *others = (
        Table.of(name, rows, (*own[:1], *who, *own[1:])) for name, own in titled.items()
    )
    absent = [(reason, hand, method, *[""] * (len(RATES) - 1)) for hand, method, reason in missing]
    return [dataclasses.replace(rates, rows=[*rates.rows, *absent]), *others]


def posture_columns(rows: Sequence[Row]) -> Columns[Row]:
    """Returns `POSTURE` if one of the rows has the measure, and no column otherwise."""
    if any(row.plausibility.get("posture_rad") is not None for row in rows):
        return POSTURE
    return ()


def object_table(rows: Sequence[Row]) -> Table:
    """Returns the success and held rates of each object (a line) in each row (a column)."""
    several = len({(row.hand, row.method) for row in rows}) > 1
    heads = [
        f"{row_title(row)}, {row.hand}, {row.method}" if several else row_title(row) for row in rows
    ]
    found = [{of["name"]: of for of in row.objects} for row in rows]
    lines = [
        [
            name,
            *(
                ", ".join(
                    percent(of[name][k]) for k in ("success", "held_2s") if k in of.get(name, ())
                )
                for of in found
            ),
        ]
        for name in dict.fromkeys(name for of in found for name in of)
    ]
    return Table("By object: success, held 2 s", ["object", *heads], lines)
