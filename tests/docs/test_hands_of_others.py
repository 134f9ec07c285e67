"""The page about hands of others: its tables are those of the records, and its commands parse.

That the page is up to date is tested with the other generated tables (`test_results.py`).
"""

import dataclasses
import json
import shlex
import shutil

import pytest

from congrasp.common.errors import CongraspError
from congrasp.services.assets.hands.findings import Finding
from congrasp.services.cli import main, parse_errors
from congrasp.services.evaluate import hand_records, hand_tables
from congrasp.services.evaluate.hand_records import (
    CHECK,
    IMPORT,
    PACKAGES,
    REPORT,
    SOURCES,
    HandRecord,
    read_hand_records,
)
from congrasp.services.evaluate.published import HANDS_FOLDER, ROOT, Results
from congrasp.services.evaluate.results import fill_tables
from congrasp.services.evaluate.scores import write_json
from congrasp.services.evaluate.text_table import NONE
from tests.rows import row

RECORDS = {record.source.name: record for record in read_hand_records()}
MAX_PICTURE_BYTES = 60_000
ABOUT = {
    "version": "0.1.0",
    "machine": "16 x86_64 cores, NVIDIA H200",
    "physics": "warp",
    "episodes": 192,
    "pool": 64,
    "transitions": 184_000_000,
    "training_seconds": 534.0,
}


def content(file: str, name: str) -> dict:
    return json.loads((ROOT / HANDS_FOLDER / name / file).read_text())


def trained(record: HandRecord, **changes) -> HandRecord:
    """The record with an exam of two rows."""
    heading = dataclasses.replace(row("heading", 0.964, 0.9, 0.98), held_2s=0.93)
    pose = dataclasses.replace(row("pose", 1.0, 0.98, 1.0), held_2s=0.99)
    return dataclasses.replace(record, exam=Results([heading, pose], {**ABOUT, **changes}))


def test_every_folder_of_records_is_in_the_list() -> None:
    folders = {folder.name for folder in (ROOT / HANDS_FOLDER).iterdir()}
    assert folders == RECORDS.keys()


@pytest.mark.parametrize("name", RECORDS)
def test_records_are_written_by_the_commands_of_the_page(name: str) -> None:
    source = RECORDS[name].source
    folder = HANDS_FOLDER / name
    imported = content(IMPORT, name)
    assert imported["command"] == f"{source.import_command()} --json {folder / IMPORT}"
    assert imported["hand"] == name
    checked = content(CHECK, name)
    assert checked["hand"] == name
    assert checked["command"].startswith(f"congrasp hands check {name} ")
    assert f"--json {folder / CHECK}" in checked["command"]


@pytest.mark.parametrize("name", RECORDS)
def test_commands_of_a_hand_parse(name: str) -> None:
    """Their options exist; nothing is run."""
    page = "\n".join(hand_tables.sections([RECORDS[name]]))
    lines = [line for line in page.splitlines() if line.startswith("congrasp ")]
    commands = [shlex.split(line, comments=True) for line in lines]
    assert [command[:3] for command in commands] == [
        ["congrasp", "hands", "import"],
        ["congrasp", "hands", "check"],
        ["congrasp", "hands", "train"],
    ]
    for _, program, *words in commands:
        parse_errors.parse(program, main.load(program), words)
    assert f"--target {PACKAGES} {RECORDS[name].source.package}==" in page
    assert commands[0][3].startswith(f"{PACKAGES}/")


@pytest.mark.parametrize("name", RECORDS)
def test_a_hand_has_a_small_picture(name: str) -> None:
    picture = ROOT / "docs" / "images" / hand_tables.picture_name(name)
    assert picture.stat().st_size <= MAX_PICTURE_BYTES


def test_a_hand_without_a_policy_is_not_trained_yet() -> None:
    passed = [Finding("ball", "passed", "held")]
    record = dataclasses.replace(RECORDS["leap"], exam=None, findings=passed)
    table = "\n".join(hand_tables.exams([record]))
    assert "not trained yet: `congrasp hands train leap`" in table
    failed = dataclasses.replace(record, findings=[Finding("ball", "failed", "falls", "close")])
    assert "`congrasp hands train leap --anyway`" in "\n".join(hand_tables.exams([failed]))


def test_an_exam_is_a_column_for_each_of_its_rows() -> None:
    untrained = dataclasses.replace(RECORDS["shadow"], exam=None)
    lines = hand_tables.exams([trained(RECORDS["leap"]), untrained])
    head, _, leap, shadow = [line.strip("| ").split(" | ") for line in lines]
    assert head == ["hand", "heading", "pose", "training", "exam"]
    assert leap[1:] == [
        "96.4 % (93.0 %)",
        "100.0 % (99.0 %)",
        "8.9 min, 184 million steps",
        "192 episodes a row, 64 objects, MJX-Warp, 16 x86_64 cores, NVIDIA H200, congrasp 0.1.0",
    ]
    assert shadow[1:3] == [NONE, NONE]
    # An interrupted training has no known duration
    (*_, last) = hand_tables.exams([trained(RECORDS["leap"], training_seconds=None)])
    assert "| 184 million steps |" in last


def test_notes_and_doubts_are_in_the_section_and_counted_in_the_overview() -> None:
    notes = ("no torque limit: a_joint", "links without <inertial>")
    record = dataclasses.replace(
        RECORDS["leap"],
        imported=dataclasses.replace(RECORDS["leap"].imported, notes=notes),
        findings=[
            Finding("palm", "passed", "near"),
            Finding("open", "doubt", "overlap of 3 mm", "the pose"),
            Finding("ball", "failed", "falls", "close further"),
        ],
    )
    section = "\n".join(hand_tables.sections([record]))
    assert "* Import: no torque limit: a\\_joint\n" in section
    assert "* Import: links without \\<inertial\\>\n" in section
    assert "* open (doubt): overlap of 3 mm. Remedy: the pose" in section
    assert "* ball (failed): falls. Remedy: close further" in section
    assert "near" not in section
    (*_, line) = hand_tables.overview([record])
    assert line.endswith("| 2 | 1 of 3; failed: ball; in doubt: open |")


def test_tables_are_written_between_their_marks() -> None:
    page = "<!-- results hands overview -->\nold\n<!-- end of results -->\n"
    new = fill_tables(page, {}, hands=list(RECORDS.values()))
    assert "old" not in new
    assert new.count("\n| [") == len(RECORDS)
    with pytest.raises(CongraspError, match="'hands rates', which does not exist"):
        fill_tables(page.replace("overview", "rates"), {})


@pytest.fixture
def root(tmp_path):
    """A folder with the records of one hand."""
    shutil.copytree(ROOT / HANDS_FOLDER / "leap", tmp_path / HANDS_FOLDER / "leap")
    (first, *_) = json.loads((ROOT / SOURCES).read_text())
    assert first["name"] == "leap"
    (tmp_path / SOURCES).write_text(json.dumps([first]))
    return tmp_path


def test_the_report_of_a_training_is_read_from_its_folder(root) -> None:
    report = root / HANDS_FOLDER / "leap" / REPORT
    about = {**ABOUT, "hand_sha256": RECORDS["leap"].imported.hand_sha256}
    write_json([row("heading", 0.9, 0.8, 0.95)], report, about)
    (record,) = read_hand_records(root)
    assert [one.constraint for one in record.exam.rows] == ["heading"]
    write_json([], report, {**about, "hand_sha256": "0" * 64})
    with pytest.raises(CongraspError, match=r"report\.json is about another version .* 'leap'"):
        read_hand_records(root)
    write_json([], report, ABOUT)
    with pytest.raises(CongraspError, match="lacks 'hand_sha256'"):
        read_hand_records(root)


def test_a_missing_record_is_an_error_with_its_command(root) -> None:
    (root / HANDS_FOLDER / "leap" / IMPORT).unlink()
    with pytest.raises(CongraspError, match=r"import\.json.*congrasp hands import --json"):
        read_hand_records(root)
    (root / hand_records.SOURCES).write_text('[{"name": 3}]')
    with pytest.raises(CongraspError, match="is not a list of hands"):
        read_hand_records(root)
