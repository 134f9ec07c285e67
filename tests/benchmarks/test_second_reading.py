"""The second reading finds what the audit finds, in journals with faults made by hand."""

import pytest

from congrasp.services.ops.audit import FAULTS, audit
from tests.benchmarks.second_reading import read_again
from tests.services.ops.test_audit import learner, life, run_dir, used, whole_run

__all__ = ["run_dir"]  # the fixture

END = {"end": [["a", "1", 5]]}
CASES = {
    "nothing": ([life(), used(0, 1), used(2, 3), used(4), END], {}),
    "lost": ([life(), used(0, 1), used(2), used(4), END], {"lost": 1}),
    "lost between two sessions": ([life(), used(0, 1), used(2, 3), life("y", 4), {"end": []}], {"lost": 2}),
    "killed as it started": ([life(), used(0, 1), used(2, 3), {**life("y", 4), "taken": None}], {}),
    "taken up": (
        [life(), used(0, 1), used(2, 3), life("y", 4) | {"taken": [["a", "1", 4], ["a", "1", 5]]}, used(4, 5)],
        {},
    ),
    "undone, and not taken up": (
        [life(), used(0, 1), used(2, 3), used(4, 5), {"saved": 4}, life("y", 4), {"end": []}],
        {"lost": 2},
    ),
    "undone, as the checkpoint was damaged": (
        [life(), used(0, 1), used(2, 3), {"saved": 3}, life("y", 2), {"end": []}],
        {},
    ),
    "not written": (
        [life(), used(0, 1), used(2, 3), {"unwritten": [["a", "1", 4], ["a", "1", 5]]}, life("y", 4), {"end": []}],
        {},
    ),
    "nothing kept": ([{**life(), "kept": False}, used(0, 1), used(2, 3), life("y", 4), {"end": []}], {}),
    "damaged on disk": (
        [life(), used(0, 1), used(2, 3), life("y", 4) | {"taken": [["a", "1", 4]], "spoilt": [["a", "1", 5]]}, used(4)],
        {},
    ),
    "duplicated": ([life(), used(0, 1), used(2, 3), used(3, version=4), used(4), END], {"duplicated": 1}),
    "unmatched": (
        [life(), used(0, 1), used(2, 3), used(4), {"version": 5, "used": [["a", "1", 77, 0, "c"]]}, END],
        {"unmatched": 1},
    ),
    "corrupted": ([life(), used(0, 1), used(2, 3), used(4, checksum="c9"), END], {"corrupted": 1}),
}


@pytest.mark.parametrize("case", CASES)
def test_both_readings_agree(run_dir, case):
    lines, faults = CASES[case]
    learner(run_dir, *({name: value for name, value in line.items() if value is not None} for line in lines))
    report, second = audit(run_dir), read_again(run_dir)
    assert {name: count for name in FAULTS if (count := report.counts[name])} == faults
    assert {name: count for name in FAULTS if (count := getattr(second, name))} == faults
    assert second.unreadable == report.damaged == 0


def test_a_whole_run_with_resumes_and_its_damage(tmp_path):
    whole_run(tmp_path)
    assert read_again(tmp_path) == (0, 0, 0, 0, 0)
    path = tmp_path / "audit" / "learner-0.jsonl"
    path.write_bytes(path.read_bytes().replace(b'"used"', b'"usep"', 1))
    assert read_again(tmp_path).unreadable == audit(tmp_path).damaged == 1


def test_no_single_damaged_line_is_taken_for_a_loss(tmp_path):
    """Whichever it is: also the one by which a session begins."""
    whole_run(tmp_path)
    for path in (tmp_path / "audit").iterdir():
        data = path.read_bytes()
        for line in data.splitlines():
            path.write_bytes(data.replace(line, line[:-3] + b"#" + line[-2:], 1))
            second = read_again(tmp_path)
            assert second[:4] == (0, 0, 0, 0) and second.unreadable == 1, line
            report = audit(tmp_path)
            assert report.damaged == 1 and not any(report.counts[name] for name in FAULTS), line
        path.write_bytes(data)


def test_a_session_whose_first_line_is_damaged_can_be_read(run_dir):
    learner(run_dir, {"taken": [], "dropped": []}, used(0, 1), used(2, 3), END)
    path = run_dir / "audit" / "learner-0.jsonl"
    path.write_bytes(b"damaged\n" + path.read_bytes())
    assert read_again(run_dir) == (0, 0, 0, 0, 1)
