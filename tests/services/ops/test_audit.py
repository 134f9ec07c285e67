"""The audit finds what it is there to find: journals of a run in which something went wrong, by hand."""

import pytest

from common.errors import CongraspError
from common.journal import AUDIT, Journal
from services.cli.audit import audit as command
from services.ops.audit import audit

CONTENT = ["c0", "c1", "c2", "c3", "c4", "c5"]


@pytest.fixture
def run_dir(tmp_path):
    """An actor made six rollouts, one in each version; the learner's journal is the test's."""
    actor = Journal(tmp_path / AUDIT / "a.jsonl")
    actor.write(actor="a", incarnation="1")
    for sequence, checksum in enumerate(CONTENT):
        actor.write(made=sequence, version=sequence, checksum=checksum)
        actor.write(answer=sequence, outcome="accepted", life="x")
    return tmp_path


def learner(run_dir, *lines):
    journal = Journal(run_dir / AUDIT / "learner-0.jsonl")
    for line in lines:
        journal.write(**line)


def life(name="x", version=0):
    return {"life": name, "epoch": "e", "version": version, "max_staleness": 1}


def used(*sequences, version=None, checksum=None, lag=0, incarnation="1"):
    rows = [["a", incarnation, n, lag, checksum or CONTENT[n]] for n in sequences]
    return {"version": sequences[0] if version is None else version, "used": rows}


def faults(run_dir):
    report = audit(run_dir)
    return {name: count for name, count in report.counts.items() if count and name not in ("made", "accepted", "used")}


def test_all_is_well(run_dir):
    learner(run_dir, life(), used(0, 1, lag=1), used(2, 3), {"dropped": [["a", "1", 4]]}, {"end": [["a", "1", 5]]})
    report = audit(run_dir)
    assert faults(run_dir) == {"dropped as too old": 1, "waiting": 1}
    assert (report.counts["made"], report.counts["accepted"], report.counts["used"]) == (6, 6, 4)
    assert (report.lag_mean, report.lag_max, report.max_staleness) == (0.5, 1, 1)
    assert not report.faults and command(run_dir) == 0


def test_lost_duplicated_corrupted_and_unmatched(run_dir, capsys):
    learner(
        run_dir, life(), used(0), used(1), used(1, version=2), used(2, checksum="c9"), used(4),
        {"version": 4, "used": [["a", "1", 77, 0, "c"]]}, {"end": [["a", "1", 5]]},
    )  # fmt: skip
    assert faults(run_dir) == {"lost": 1, "duplicated": 1, "corrupted": 1, "unmatched": 1, "waiting": 1}
    assert "a/1/3: accepted, and never seen again" in audit(run_dir).faults
    assert command(run_dir) == 1 and "a/1/3" in capsys.readouterr().out


def test_what_a_resume_undid_is_no_duplicate_and_no_loss(run_dir):
    """The checkpoint is of version 2: uses from there on are undone; 2 and 3 came again, 4 and 5 did not."""
    learner(run_dir, life(), used(0), used(1), used(2), used(3), used(4), life("y", version=2), used(2, 3, version=6))
    assert faults(run_dir) == {"undone": 1, "too old after a restart": 1}


def test_a_rollout_that_was_fresh_after_a_restart_and_did_not_come_is_lost(run_dir):
    learner(run_dir, life(), used(0, 1), used(2, 3), life("y", version=4), {"end": []})
    assert faults(run_dir) == {"lost": 2}


def test_holes_in_a_journal_are_no_losses(run_dir):
    learner(run_dir, life(), used(0), {"dropped": [], "lost": 3}, used(4), {"end": []})
    assert faults(run_dir) == {"not in the journals": 4}
    assert audit(run_dir).holes == 3


def test_journals_that_are_missing_are_named(tmp_path, run_dir):
    with pytest.raises(CongraspError, match=r"no journal of a learner in .*audit"):
        audit(run_dir)
    learner(tmp_path / "other", life())
    with pytest.raises(CongraspError, match="no journal of an actor"):
        audit(tmp_path / "other")
    assert audit(tmp_path / "other", [run_dir / AUDIT / "a.jsonl"]).counts["accepted"] == 6
