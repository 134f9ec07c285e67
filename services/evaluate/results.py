"""Tables of published figures: those of the files of `docs/results`, in pages.

`congrasp evaluate … --json docs/results/NAME.json` writes a file. `python -m
congrasp.services.evaluate.results` writes each table between `<!-- results NAME KIND -->` and `<!--
end of results -->` in the README and in `docs`. KIND is one of `KINDS`, or `engines` for a table of
the hand NAME in several engines (`engine_table`). The NAME `hands` is for the records of hands of
others, and KIND is then one of `hand_tables.KINDS`.
"""

import pathlib
import platform
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax

import congrasp
from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.runtime.engines import engine_title
from congrasp.common.runtime.resources import cores
from congrasp.services.evaluate import hand_tables
from congrasp.services.evaluate.columns import (
    PLAUSIBILITY,
    SCORE_CELLS,
    paper_rate,
    posture_columns,
    row_title,
)
from congrasp.services.evaluate.engine_table import engine_table
from congrasp.services.evaluate.hand_records import HandRecord, read_hand_records
from congrasp.services.evaluate.heading_rules import HeadingRules
from congrasp.services.evaluate.published import ROOT, Results, read_all_results
from congrasp.services.evaluate.scores import Row
from congrasp.services.evaluate.text_table import Columns, Table, percent

_BLOCK = re.compile(r"(<!-- results (\S+) (\S+) -->\n).*?(<!-- end of results -->)", re.S)
_ENGINES = "engines"
"""Kind of the table of several files (`engine_table`)."""
_HANDS = "hands"
"""Name of the tables of the records of hands of others (`hand_tables`)."""


def provenance(accelerators: str = "") -> dict[str, Any]:
    """Version of the package, command line and machine of the current evaluation.

    Args:
      accelerators: their names, by default those of this process.
    """
    device = jax.local_devices()[0]
    if not accelerators and device.platform != "cpu":
        accelerators = device.device_kind
    machine = f"{cores()} {platform.machine()} cores"
    if accelerators:
        machine = f"{machine}, {accelerators}"
    return {
        "version": congrasp.__version__,
        "command": shlex.join(["congrasp", *sys.argv[1:]]),
        "machine": machine,
    }


def summary(results: Results) -> list[str]:
    """Success, held and clean, with the paper's success."""
    columns: Columns[Row] = (
        ("constraint", row_title),
        ("success", lambda row: percent(row.success)),
        ("held for 2 s", lambda row: percent(row.held_2s)),
        ("held, and clean", lambda row: percent(row.plausibility.get("clean"))),
        (
            "success, held of all objects",
            lambda row: f"{percent(row.success_all)}, {percent(row.held_all)}",
        ),
        ("paper", paper_rate),
    )
    return Table.of("", results.rows, columns).markdown()


def rates(results: Results) -> list[str]:
    """Rates with intervals and errors, and those of the paper."""
    columns: Columns[Row] = (
        ("constraint", row_title),
        ("episodes (independent)", lambda row: f"{row.episodes} ({row.independent:.0f})"),
        ("objects", SCORE_CELLS["objects"]),
        ("success (95 %)", SCORE_CELLS["success"]),
        ("held 2 s (95 %)", SCORE_CELLS["held 2 s"]),
        ("of all objects", SCORE_CELLS["of all objects"]),
        ("error", SCORE_CELLS["error"]),
        ("paper", SCORE_CELLS["paper"]),
    )
    return Table.of("", results.rows, columns).markdown()


def plausibility(results: Results) -> list[str]:
    """Penetrations (mean, 95th percentile), peaks of the wrist, and survival of grasps."""
    heads = (
        "constraint",
        "in itself, mm",
        "in the table",
        "in the object",
        "wrist, m/s",
        *dict(PLAUSIBILITY[5:]),
    )
    columns = [(head, cell) for head, (_, cell) in zip(heads, PLAUSIBILITY, strict=True)]
    columns += posture_columns(results.rows)
    return Table.of("", results.rows, columns).markdown()


def conditions(results: Results) -> list[str]:
    """Policy, objects, machine and command, and the effect of the rules for headings."""
    about = results.about
    policies = ", ".join(
        f"`{policy['file']}` of version {policy['version']} (SHA-256 {policy['sha256'][:12]})"
        for policy in about["policies"]
    )
    lines = [
        f"{policies}, on {about['objects']}, {engine_title(about['physics'])}, "
        f"{about['machine']}, congrasp {about['version']}:",
        "",
        "```text",
        about["command"],
        "```",
    ]
    for sentence in headings(results):
        lines += ["", sentence]
    return lines


def headings(results: Results) -> list[str]:
    """Effect of the rules for headings."""
    rules_by_hand = results.about["heading_rules"]
    return [HeadingRules(**rules).sentence(hand) for hand, rules in rules_by_hand.items()]


KINDS: dict[str, Callable[[Results], list[str]]] = {
    function.__name__: function for function in (summary, rates, plausibility, conditions, headings)
}
"""Tables of a file of results available to pages, as lines of Markdown."""


def _kinds(results: Mapping[str, Results], name: str) -> Sequence[str]:
    """Returns the kinds of tables of a name; none for a name without a file."""
    if name == _HANDS:
        return tuple(hand_tables.KINDS)
    if name in results:
        return (*KINDS, _ENGINES)
    return ()


def _table(
    kind: str, name: str, results: Mapping[str, Results], hands: Sequence[HandRecord]
) -> list[str]:
    """Returns the lines of a table."""
    if name == _HANDS:
        return hand_tables.KINDS[kind](hands)
    if kind == _ENGINES:
        return engine_table(results, name)
    return KINDS[kind](results[name])


def fill_tables(
    page: str,
    results: Mapping[str, Results],
    name: str = "page",
    hands: Sequence[HandRecord] = (),
) -> str:
    """Returns a page with its tables regenerated from results.

    Args:
      page: text of the page.
      results: all results by their names.
      name: name of the page in errors.
      hands: records of hands of others.

    Raises:
      CongraspError: it names a file or a kind of table that does not exist.
    """

    def block(match: re.Match[str]) -> str:
        """Returns one table between its markers."""
        opening, file, kind, closing = match.groups()
        if kind not in _kinds(results, file):
            tables = (*KINDS, _ENGINES, *hand_tables.KINDS)
            raise CongraspError(
                f"{name} names '{file} {kind}', which does not exist.",
                f"Files: {', '.join([*results, _HANDS])}; tables: {', '.join(tables)}.",
            )
        return "\n".join([opening, *_table(kind, file, results, hands), "", closing])

    return _BLOCK.sub(block, page)


def pages(root: pathlib.Path = ROOT) -> Iterator[tuple[pathlib.Path, str]]:
    """Yields every page whose tables differ from the results, and its corrected text."""
    results = read_all_results(root)
    hands = read_hand_records(root)
    for path in (root / "README.md", *sorted((root / "docs").rglob("*.md"))):
        text = path.read_text(encoding="utf-8")
        corrected = fill_tables(text, results, path.name, hands)
        if corrected != text:
            yield path, corrected


if __name__ == "__main__":
    for page, text in pages():
        write_atomically(page, text.encode())
        print(f"Wrote {page.relative_to(ROOT)}.")
