"""Published figures: the files of `docs/results`, and the tables of them in pages.

`congrasp evaluate … --json docs/results/NAME.json` writes a file. `python -m
congrasp.services.evaluate.results` writes each table between `<!-- results NAME KIND -->` and `<!--
end of results -->` in the README and in `docs`. KIND is one of `KINDS`.
"""

import dataclasses
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
from congrasp.common.io.inputs import read_json
from congrasp.common.runtime.engines import engine_title
from congrasp.common.runtime.parallel import cores
from congrasp.services.evaluate.columns import (
    PLAUSIBILITY,
    RATE,
    paper_rate,
    posture_columns,
    row_title,
)
from congrasp.services.evaluate.heading_rules import HeadingRules
from congrasp.services.evaluate.scores import Row
from congrasp.services.evaluate.text_table import Columns, Table, percent

ROOT = pathlib.Path(__file__).resolve().parents[2]
FOLDER = pathlib.Path("docs", "results")
_BLOCK = re.compile(r"(<!-- results (\S+) (\S+) -->\n).*?(<!-- end of results -->)", re.S)
_LARGEST = 1 << 26


@dataclasses.dataclass(frozen=True)
class Results:
    """A file of results."""

    rows: Sequence[Row]
    about: Mapping[str, Any]
    """Further content of the file from `congrasp evaluate --json`."""

    @property
    def policies(self) -> dict[str, str]:
        """SHA-256 of each policy by file name."""
        return {policy["file"]: policy["sha256"] for policy in self.about["policies"]}


def provenance() -> dict[str, Any]:
    """Version of the package, command line and machine of the current evaluation."""
    device = jax.local_devices()[0]
    accelerator = [] if device.platform == "cpu" else [device.device_kind]
    return {
        "version": congrasp.__version__,
        "command": shlex.join(["congrasp", *sys.argv[1:]]),
        "machine": ", ".join([f"{cores()} {platform.machine()} cores", *accelerator]),
    }


def read_results(file: pathlib.Path) -> Results:
    """Reads the rows of a file and their provenance.

    Raises:
      CongraspError: the file cannot be read, or another version of the project wrote it.
    """
    remedy = "Run the command that wrote it again."
    try:
        about = read_json(file, _LARGEST, remedy)
        rows = [Row.from_json(row) for row in about.pop("rows")]
    except (LookupError, TypeError, AttributeError):
        raise CongraspError(f"{file} is not a file of results of this version.", remedy) from None
    if (
        missing := {
            "policies",
            "command",
            "machine",
            "version",
            "objects",
            "physics",
            "heading_rules",
        }
        - about.keys()
    ):
        raise CongraspError(f"{file} lacks '{min(missing)}'.", remedy)
    return Results(rows, about)


def recorded(root: pathlib.Path = ROOT) -> dict[str, Results]:
    """Reads all files of results, by name."""
    return {file.stem: read_results(file) for file in sorted((root / FOLDER).glob("*.json"))}


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
        ("objects", RATE["objects"]),
        ("success (95 %)", RATE["success"]),
        ("held 2 s (95 %)", RATE["held 2 s"]),
        *((name, RATE[name]) for name in ("of all objects", "error", "paper")),
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
    return [
        f"{policies}, on {about['objects']}, {engine_title(about['physics'])}, {about['machine']}, "
        f"congrasp "
        f"{about['version']}:",
        "",
        "```text",
        about["command"],
        "```",
        *(line for sentence in headings(results) for line in ("", sentence)),
    ]


def headings(results: Results) -> list[str]:
    """Effect of the rules for headings."""
    return [
        HeadingRules(**found).sentence(hand)
        for hand, found in results.about["heading_rules"].items()
    ]


KINDS: dict[str, Callable[[Results], list[str]]] = {
    function.__name__: function for function in (summary, rates, plausibility, conditions, headings)
}
"""Tables of a file of results available to pages, as lines of Markdown."""


def filled(page: str, results: Mapping[str, Results], name: str = "page") -> str:
    """Returns a page with its tables regenerated from results.

    Raises:
      CongraspError: it names a file or a kind of table that does not exist.
    """

    def block(found: re.Match[str]) -> str:
        """Returns one table between its markers."""
        if found[2] not in results or found[3] not in KINDS:
            raise CongraspError(
                f"{name} names '{found[2]} {found[3]}', which does not exist.",
                f"Files: {', '.join(results)}; tables: {', '.join(KINDS)}.",
            )
        lines = "\n".join(KINDS[found[3]](results[found[2]]))
        return f"{found[1]}\n{lines}\n\n{found[4]}"

    return _BLOCK.sub(block, page)


def pages(root: pathlib.Path = ROOT) -> Iterator[tuple[pathlib.Path, str]]:
    """Yields every page whose tables differ from the results, and its corrected text."""
    results = recorded(root)
    for path in (root / "README.md", *sorted((root / "docs").rglob("*.md"))):
        text = path.read_text()
        if (new := filled(text, results, path.name)) != text:
            yield path, new


if __name__ == "__main__":
    for page, text in pages():
        write_atomically(page, text.encode())
        print(f"Wrote {page.relative_to(ROOT)}.")
