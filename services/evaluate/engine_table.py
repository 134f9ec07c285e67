"""Table of one policy in several physics engines, side by side."""

from collections.abc import Callable, Mapping, Sequence

from congrasp.common.runtime.engines import engine_title
from congrasp.services.evaluate.columns import row_title
from congrasp.services.evaluate.published import Results
from congrasp.services.evaluate.scores import Row
from congrasp.services.evaluate.text_table import Table, percent

FOLDER = "physics"
"""Folder of the files HAND-ENGINE.json, in that of the results."""
ENGINES = ("native", "physx", "warp", "jax")
"""Columns of the table."""
NOT_RUN = "not run"


def engine_table(results: Mapping[str, Results], hand: str) -> list[str]:
    """Success (held for 2 s) and episodes of the constraints in each engine, and the conditions of
    each engine's episodes, as lines of Markdown.

    Args:
      results: all results by their names.
      hand: name of the hand and of the policy's published results, which are the column of their
        engine unless a file of `FOLDER` has the same engine.
    """
    by_engine = _results_by_engine(results, hand)
    titles: dict[str, None] = {}
    for of_engine in by_engine.values():
        titles |= dict.fromkeys(row_title(row) for row in of_engine.rows)
    columns: list[tuple[str, Callable[[str], str]]] = [("constraint", str)]
    for engine in ENGINES:
        rows: Sequence[Row] = []
        if engine in by_engine:
            rows = by_engine[engine].rows
        columns.append((engine_title(engine), _cell(rows)))
    lines = Table.of("", titles, columns).markdown()
    lines.append("")
    for engine, of_engine in by_engine.items():
        lines.append(f"* {engine_title(engine)}: {_conditions(of_engine)}.")
    return lines


def _results_by_engine(results: Mapping[str, Results], hand: str) -> dict[str, Results]:
    """Results of a hand's policy by engine, in the order of `ENGINES`."""
    published = results[hand]
    by_engine = {}
    for engine in ENGINES:
        name = f"{FOLDER}/{hand}-{engine}"
        if name in results:
            by_engine[engine] = results[name]
        elif published.about["physics"] == engine:
            by_engine[engine] = published
    return by_engine


def _cell(rows: Sequence[Row]) -> Callable[[str], str]:
    """Cells of an engine's column by the title of the row."""
    by_title = {row_title(row): row for row in rows}

    def cell(title: str) -> str:
        """Returns the cell of one row."""
        if title not in by_title:
            return NOT_RUN
        row = by_title[title]
        return f"{percent(row.success)} ({percent(row.held_2s)}), {row.episodes}"

    return cell


def _conditions(results: Results) -> str:
    """Objects, engine of the references, machine and version of an engine's episodes."""
    about = results.about
    reference_engine = about.get("reference_physics") or about["physics"]
    return (
        f"{about['objects']}, references of {engine_title(reference_engine)}, {about['machine']}, "
        f"congrasp {about['version']}"
    )
