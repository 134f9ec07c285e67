"""Tables of the paper as LaTeX, for documents that load booktabs and graphicx."""

from collections.abc import Sequence

from congrasp.services.reproduce.layout import NONE, Table

_ESCAPED = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    NONE: "--",
    "±": r"$\pm$",
    "<": r"$<$",
    ">": r"$>$",
}


def escape(text: str) -> str:
    """Escapes text for LaTeX."""
    return "".join(_ESCAPED.get(character, character) for character in text)


def latex(tables: Sequence[Table], conditions: str) -> str:
    """Returns one `table` environment for each table.

    Args:
      tables: the tables.
      conditions: a sentence on objects, engine and seed, for the captions.
    """
    return "\n".join(_table(table, conditions) for table in tables)


def _table(table: Table, conditions: str) -> str:
    """Returns a table, with a rule where the constraint changes."""
    lines = [
        r"\begin{table}",
        rf"  \caption{{{escape(table.title)}. {escape(conditions)}}}",
        r"  \centering",
        r"  \resizebox{\linewidth}{!}{%",
        rf"  \begin{{tabular}}{{{'l' * len(table.columns)}}}",
        r"    \toprule",
        f"    {_row([name for name, _ in table.columns])}",
    ]
    constraint = ""
    for line in table.lines:
        if line.cells[0] != constraint:
            constraint = line.cells[0]
            lines.append(r"    \midrule")
        lines.append(f"    {_row(line.cells)}")
    return "\n".join([*lines, r"    \bottomrule", r"  \end{tabular}}", r"\end{table}", ""])


def _row(cells: Sequence[str]) -> str:
    """Joins the cells of a line."""
    return " & ".join(map(escape, cells)) + r" \\"
