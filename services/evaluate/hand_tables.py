"""Page about hands of others: tables and sections from their records, as lines of Markdown."""

import re
from collections.abc import Callable, Sequence

from congrasp.common.runtime.engines import engine_title
from congrasp.services.evaluate.columns import row_title
from congrasp.services.evaluate.hand_records import HandRecord
from congrasp.services.evaluate.text_table import NONE, Columns, Table, percent

NOT_TRAINED = "not trained yet"
_MARKUP = re.compile(r"([\\`*_<>\[\]])")
"""Characters with a meaning in Markdown."""


def overview(records: Sequence[HandRecord]) -> list[str]:
    """A row for each hand: source, size, notes of the import and self-check."""
    columns: Columns[HandRecord] = (
        ("hand", _link),
        ("package", lambda record: f"`{record.source.package}` {record.source.version}"),
        ("licence", lambda record: record.source.licence),
        ("fingers", lambda record: str(len(record.imported.fingers))),
        ("joints", lambda record: str(record.imported.joints)),
        ("motors", lambda record: str(record.imported.motors)),
        ("opening, mm", lambda record: f"{record.imported.opening_mm:.0f}"),
        ("options of the import", lambda record: _code(record.source.options) or "none"),
        ("its notes", lambda record: str(len(record.imported.notes))),
        ("self-check", _self_check),
    )
    return Table.of("", records, columns).markdown()


def exams(records: Sequence[HandRecord]) -> list[str]:
    """A row for each hand: success (held for 2 s) in each row of its exam, training and exam."""
    titles: dict[str, None] = {}
    for record in records:
        if record.exam is not None:
            titles |= dict.fromkeys(row_title(row) for row in record.exam.rows)
    columns: list[tuple[str, Callable[[HandRecord], str]]] = [("hand", _link)]
    columns += [(title, _rate(title)) for title in titles]
    columns += [("training", _training), ("exam", _exam)]
    return Table.of("", records, columns).markdown()


def sections(records: Sequence[HandRecord]) -> list[str]:
    """A section for each hand: picture, commands, notes of the import, doubts of the self-check."""
    lines: list[str] = []
    for record in records:
        if lines:
            lines.append("")
        lines += _section(record)
    return lines


KINDS: dict[str, Callable[[Sequence[HandRecord]], list[str]]] = {
    function.__name__: function for function in (overview, exams, sections)
}
"""Tables of the records available to pages, as lines of Markdown."""


def picture_name(hand: str) -> str:
    """Name of a hand's picture in `docs/images`."""
    return f"hand-of-others-{hand}.jpg"


def train_command(record: HandRecord) -> str:
    """Command that trains the hand."""
    command = f"congrasp hands train {record.source.name}"
    if record.is_failed:
        return f"{command} --anyway"
    return command


def _link(record: HandRecord) -> str:
    """Link to the hand's section."""
    title = record.source.title
    anchor = re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
    return f"[{title}](#{anchor})"


def _self_check(record: HandRecord) -> str:
    """Number of passed checks, and the others by name."""
    passed = [finding for finding in record.findings if finding.verdict == "passed"]
    text = f"{len(passed)} of {len(record.findings)}"
    for verdict, title in (("failed", "failed"), ("doubt", "in doubt")):
        names = [finding.check for finding in record.findings if finding.verdict == verdict]
        if names:
            text += f"; {title}: {', '.join(dict.fromkeys(names))}"
    return text


def _rate(title: str) -> Callable[[HandRecord], str]:
    """Cells of a row of the exam."""

    def cell(record: HandRecord) -> str:
        """Returns the cell of one hand."""
        if record.exam is None:
            return NONE
        for row in record.exam.rows:
            if row_title(row) == title:
                return f"{percent(row.success)} ({percent(row.held_2s)})"
        return NONE

    return cell


def _training(record: HandRecord) -> str:
    """Duration and steps of the training, or the command that trains the hand."""
    if record.exam is None:
        return f"{NOT_TRAINED}: {_code(train_command(record))}"
    about = record.exam.about
    steps = f"{about['transitions'] / 1e6:.0f} million steps"
    if about["training_seconds"] is None:
        return steps
    return f"{about['training_seconds'] / 60:.1f} min, {steps}"


def _exam(record: HandRecord) -> str:
    """Size, engine and machine of the exam."""
    if record.exam is None:
        return NONE
    about = record.exam.about
    return (
        f"{about['episodes']} episodes a row, {about['pool']} objects, "
        f"{engine_title(about['physics'])}, {about['machine']}, congrasp {about['version']}"
    )


def _section(record: HandRecord) -> list[str]:
    """Section of one hand."""
    source = record.source
    imported = record.imported
    thumb = imported.fingers[0][-1]
    lines = [
        f"### {source.title}",
        "",
        f"![{source.title}: open with its grasp frame, half closed, closed]"
        f"(images/{picture_name(source.name)})",
        "",
        f"`{source.package}` {source.version}; licence: {source.licence} "
        f"(`{source.licence_file}`). Palm `{imported.palm}`, thumb `{thumb}`, "
        f"{imported.mass_kg:g} kg, objects x {imported.object_scale:g}.",
        "",
        "```sh",
        source.install_command,
        source.import_command(),
        f"congrasp hands check {source.name}",
        f"{train_command(record)}  # on a GPU",
        "```",
        "",
    ]
    if source.remark:
        lines.append(f"* {source.remark}")
    if not imported.notes:
        lines.append("* Import: no notes.")
    lines += [f"* Import: {_escaped(note)}" for note in imported.notes]
    lines.append(f"* Self-check: {_self_check(record)}")
    for finding in record.findings:
        if finding.verdict == "passed":
            continue
        text = f"{finding.check} ({finding.verdict}): {finding.measured}. Remedy: {finding.remedy}"
        lines.append(f"  * {_escaped(text)}")
    return lines


def _code(text: str) -> str:
    """Text as code; empty if it is empty."""
    return f"`{text}`" if text else ""


def _escaped(text: str) -> str:
    """Text without markup."""
    return _MARKUP.sub(r"\\\1", text)
