"""Tables of text, written to a terminal, as Markdown, HTML and LaTeX."""

import dataclasses
import html
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

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
        styled = super().__new__(cls, text)
        styled.style = style
        styled.note = note
        return styled

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
        names = [name for name, _ in columns]
        rows = []
        for item in items:
            rows.append([cell(item) for _, cell in columns])
        return cls(title, names, rows)

    def terminal(self) -> Any:
        """The table for a terminal, as a `rich.table.Table`."""
        from rich.table import Table as TerminalTable

        table = TerminalTable(title=self.title, title_justify="left")
        for column in self.columns:
            table.add_column(column, no_wrap=column in _UNBROKEN, overflow="fold")
        for row in self.rows:
            table.add_row(*row)
        return table

    def markdown(self) -> list[str]:
        """Lines of Markdown, without the title."""
        rule = ["---"] * len(self.columns)
        lines = []
        for row in (self.columns, rule, *self.rows):
            cells = [cell.replace("|", r"\|") for cell in row]
            lines.append(f"| {' | '.join(cells)} |")
        return lines

    def html(self) -> str:
        """The table as HTML; its title is the caption."""
        lines = ["<table>"]
        if self.title:
            lines.append(f"<caption>{html.escape(self.title)}</caption>")
        heads = [_head_html(name) for name in self.columns]
        lines.append(f"<tr>{''.join(heads)}</tr>")
        for row in self.rows:
            cells = [_cell_html(cell) for cell in row]
            lines.append(f"<tr>{''.join(cells)}</tr>")
        lines.append("</table>")
        return "\n".join(lines)

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


def _head_html(name: str) -> str:
    """Heading of a column as HTML."""
    css_class = " class=paper" if name == "paper" else ""
    return f"<th{css_class}>{html.escape(name)}</th>"


def _cell_html(cell: str) -> str:
    """A cell as HTML."""
    if isinstance(cell, Styled):
        return cell.html()
    return f"<td>{html.escape(cell)}</td>"


def escape(text: str) -> str:
    """Escapes text for LaTeX."""
    return "".join(_LATEX.get(character, character) for character in text)


def percent(
    rate: float | None, low: float | None = None, high: float | None = None, unit: str = " %"
) -> str:
    """Formats a rate, with its interval if there is one: "98.7 % (96.6-99.5)"."""
    if rate is None:
        return NONE
    text = f"{100 * rate:.1f}{unit}"
    if low is None or high is None:
        return text
    return f"{text} ({100 * low:.1f}-{100 * high:.1f})"


def verdict(low: float, high: float, paper: float) -> str:
    """ "better" or "worse" than the paper's rate if the whole interval is, else empty."""
    if low > paper:
        return "better"
    if high < paper:
        return "worse"
    return ""
