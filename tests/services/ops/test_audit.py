"""The audit finds what it is there to find: journals of a run in which something went wrong, by
hand.
"""

import errno
import itertools
import json
import os
import pathlib
import shutil
import tempfile
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.errors import CongraspError
from congrasp.common.io import journal as journal_module
from congrasp.common.io.journal import AUDIT, Journal
from congrasp.common.io.opening import open_to_append
from congrasp.learner.run_directory import note_version
from congrasp.services.cli.audit import audit as command
from congrasp.services.ops.audit import compare as audit

CONTENT = ["c0", "c1", "c2", "c3", "c4", "c5"]


@pytest.fixture
def run_dir(tmp_path):
    """An actor made six rollouts, one in each version; the learner's journal is the test's."""
    actor = Journal(tmp_path / AUDIT / "a.jsonl")
    actor.write(actor="a", incarnation="1")
    for sequence, checksum in enumerate(CONTENT):
        actor.write(made=sequence, version=sequence, checksum=checksum)
        actor.write(answer=sequence, outcome="accepted", session_id="x")
    return tmp_path


def learner(run_dir, *lines):
    journal = Journal(run_dir / AUDIT / "learner-0.jsonl")
    for line in lines:
        journal.write(**line)


def life(name="x", version=0):
    return {
        "session_id": name,
        "run_id": "e",
        "version": version,
        "max_staleness": 1,
        "kept": True,
        "taken": [],
    }


def used(*sequences, version=None, checksum=None, lag=0, incarnation="1"):
    rows = [["a", incarnation, n, lag, checksum or CONTENT[n]] for n in sequences]
    return {"version": sequences[0] if version is None else version, "used": rows}


def faults(run_dir):
    report = audit(run_dir)
    return {
        name: count
        for name, count in report.counts.items()
        if count and name not in ("made", "accepted", "used")
    }


def test_a_pipe_in_the_folder_does_not_block(run_dir):
    learner(run_dir, life(), used(0, 1))
    os.mkfifo(run_dir / AUDIT / "b.jsonl")
    with pytest.raises(CongraspError, match=r"b\.jsonl is not a regular file"):
        audit(run_dir)
    with pytest.raises(CongraspError, match=r"b\.jsonl is not a regular file"):
        Journal(run_dir / AUDIT / "b.jsonl")


def test_all_is_well(run_dir):
    learner(
        run_dir,
        life(),
        used(0, 1, lag=1),
        used(2, 3),
        {"dropped": [["a", "1", 4]]},
        {"end": [["a", "1", 5]]},
    )
    report = audit(run_dir)
    assert faults(run_dir) == {"dropped": 1, "waiting": 1}
    assert report.counts["made"] == 6
    assert report.counts["accepted"] == 6
    assert report.counts["used"] == 4
    assert report.lag_mean == 0.5
    assert report.lag_max == 1
    assert report.max_staleness == 1
    assert not report.faults
    assert command(run_dir) == 0


def test_lost_duplicated_corrupted_and_unmatched(run_dir, capsys):
    learner(
        run_dir,
        life(),
        used(0),
        used(1),
        used(1, version=2),
        used(2, checksum="c9"),
        used(4),
        {"version": 4, "used": [["a", "1", 77, 0, "c"]]},
        {"end": [["a", "1", 5]]},
    )
    assert faults(run_dir) == {
        "lost": 1,
        "duplicated": 1,
        "corrupted": 1,
        "unmatched": 1,
        "waiting": 1,
    }
    assert "a/1/3: accepted, but missing afterwards" in audit(run_dir).faults
    assert command(run_dir) == 1
    assert "a/1/3" in capsys.readouterr().out


def test_rollouts_undone_by_a_resume_are_not_faults(run_dir):
    """The checkpoint is of version 2: uses from there on are undone; 2 and 3 came again, 4 and 5
    did not.
    """
    learner(
        run_dir,
        life(),
        used(0),
        used(1),
        used(2),
        used(3),
        used(4),
        life("y", version=2),
        used(2, 3, version=6),
    )
    assert faults(run_dir) == {"undone": 1, "too old after a restart": 1}


def test_a_fresh_rollout_missing_after_a_restart_is_lost(run_dir):
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


def test_empty_and_malformed_journals_are_damage_and_no_traceback(run_dir, capsys):
    path = run_dir / AUDIT / "learner-0.jsonl"
    for content in (
        b"",
        b"\n\n",
        b"\x00" * 70,
        b"[1]\n7\nnull\n",
        b"\xff\xfe\n",
        b"[" * 9000 + b"\n",
        b"9" * 5000 + b"\n",
    ):
        path.write_bytes(content)
        assert faults(run_dir) == {"not in the journals": 6}
        assert command(run_dir) == (6 if content.endswith(b"\n") and content.strip(b"\n") else 7)
    odd = (
        {"session_id": "x"},
        {"used": 7, "version": 0},
        {"used": [[1]], "version": 0},
        {"end": [["a", "1", 10**30]]},
    )
    path.write_text("".join(f"{json.dumps(line)}\n" for line in odd))
    (run_dir / AUDIT / "b.jsonl").write_text('{"actor": 5}\n{"made": [1]}\n{"answer": 0}\n')
    assert faults(run_dir) == {"not in the journals": 6}
    assert audit(run_dir).damaged == 7
    assert command(run_dir) == 6
    assert "damaged lines" in capsys.readouterr().out


def test_loss_surplus_and_damage_have_exit_codes_of_their_own(run_dir, tmp_path):
    forged = {"version": 4, "used": [["a", "1", 77, 0, "c"]]}
    for number, (lines, code) in enumerate(
        [([], 1), ([used(4), forged], 5), ([used(4, checksum="c9")], 6), ([used(4)], 0)]
    ):
        other = tmp_path / str(number)
        shutil.copytree(run_dir / AUDIT, other / AUDIT)
        learner(other, life(), used(0, 1), used(2, 3), *lines, {"end": [["a", "1", 5]]})
        assert command(other) == code


class FullOnce:
    """A journal's file on a disk that is full at the first line."""

    def __init__(self, file):
        self.file = file
        self.is_full = True

    def write(self, line):
        if self.is_full:
            self.is_full = False
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.file.write(line)

    def close(self):
        self.file.close()


def test_a_torn_line_counts_among_the_lost_lines(run_dir, monkeypatch):
    """The disk was full for two lines of an actor's journal, and took a part of the first."""
    learner(run_dir, life(), used(0, 1), used(2, 3), used(4, 5), {"end": []})
    path = run_dir / AUDIT / "a.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[:5], lines[5][:20]]))
    monkeypatch.setattr(
        journal_module, "open_to_append", lambda path: FullOnce(open_to_append(path))
    )
    journal = Journal(path)
    journal.write(answer=0)
    journal.write(answer=1, outcome="accepted", session_id="x", actor="a", incarnation="1")
    report = audit(run_dir)
    assert report.holes == 2
    assert report.damaged == 0
    assert report.faults == []
    assert report.counts["used, not in the journals"] == 4


def test_an_unfinished_last_line_is_not_damage(run_dir):
    """Its writer comes back: its next line counts the unfinished one, and what it told is not
    judged.
    """
    learner(run_dir, life(), used(0, 1), used(2, 3), used(4, 5), {"end": []})
    path = run_dir / AUDIT / "a.jsonl"
    path.write_bytes(path.read_bytes()[:-30])
    assert audit(run_dir).holes == 1
    assert audit(run_dir).damaged == 0
    Journal(path).write(actor="a", incarnation="2")
    report = audit(run_dir)
    assert report.holes == 1
    assert report.damaged == 0
    assert report.exit_code == 0
    assert report.counts["accepted"] == 5


def test_lines_of_older_versions_are_read_and_reported_as_unchecked(run_dir, capsys):
    learner(run_dir, life(), used(0, 1), used(2, 3), used(4, 5), {"end": []})
    for path in (run_dir / AUDIT).glob("*.jsonl"):
        path.with_name(f"{path.name}.end").unlink()
        lines = [json.loads(line) for line in path.read_text().split("\n") if line]
        texts = []
        for line in lines:
            entry = {k: v for k, v in line.items() if k not in ("after", "crc32")}
            texts.append(json.dumps(entry)[:-1])
        path.write_text(
            "".join(f'{text}, "crc32": "{zlib.crc32(text.encode()):08x}"}}\n' for text in texts)
        )
    Journal(run_dir / AUDIT / "a.jsonl").write(actor="a", incarnation="2")
    report = audit(run_dir)
    assert report.counts["used"] == 6
    assert report.unchecked == 18
    assert report.damaged == 0
    assert report.missing == 0
    assert command(run_dir) == 0
    assert any(
        "older versions" in line and "18" in line for line in capsys.readouterr().out.split("\n")
    )


@pytest.mark.parametrize("which", ["a.jsonl", "learner-0.jsonl"])
def test_removed_lines_and_emptied_journals_are_reported(tmp_path, which, capsys):
    whole_run(tmp_path)
    assert command(tmp_path) == 0
    path = tmp_path / AUDIT / which
    lines = path.read_bytes().splitlines(keepends=True)
    for first, end in [*itertools.pairwise(range(len(lines))), (0, 3), (2, len(lines) - 1)]:
        path.write_bytes(b"".join(lines[:first] + lines[end:]))
        capsys.readouterr()
        assert audit(tmp_path).missing == 1, (
            first,
            end,
        )
        assert audit(tmp_path).faults == [], (
            first,
            end,
        )
        assert command(tmp_path) == 7, (
            first,
            end,
        )
        assert "Lines are missing at 1 place(s)" in (printed := capsys.readouterr().out)
        assert "cannot be judged" in printed
    path.write_bytes(b"")
    assert audit(tmp_path).missing == 1
    assert command(tmp_path) == 7


def whole_run(folder):
    """Two incarnations of an actor, two sessions of the learner with a resume between them, and no
    fault.
    """
    actor = Journal(folder / AUDIT / "a.jsonl")
    for incarnation in "12":
        who = {"actor": "a", "incarnation": incarnation}
        actor.write(**who)
        for sequence, checksum in enumerate(CONTENT[:4]):
            actor.write(**who, made=sequence, version=sequence, checksum=checksum)
            actor.write(
                **who,
                answer=sequence,
                outcome="accepted",
                session_id="x" if incarnation == "1" else "y",
            )
            if incarnation == "1" and sequence >= 2:
                actor.write(**who, answer=sequence, outcome="accepted", session_id="y")
    learner(
        folder,
        life(),
        used(0),
        used(1),
        used(2),
        used(3),
        life("y", version=2),
        used(2, version=5),
        used(3, version=6),
        {"dropped": [["a", "2", 0]]},
        used(1, 2, version=7, incarnation="2"),
        {"end": [["a", "2", 3]]},
    )


def recomputed(line):
    """A line with another number and the checksum that belongs to it."""
    entry = json.loads(line)
    entry.pop("crc32")
    entry["forged"] = 1
    text = json.dumps(entry)[:-1]
    return f'{text}, "crc32": "{zlib.crc32(text.encode()):08x}"}}\n'.encode()


TAMPERED = {
    "first removed": lambda lines: lines[1:],
    "one removed": lambda lines: lines[:3] + lines[4:],
    "last removed": lambda lines: lines[:-1],
    "83 % removed": lambda lines: lines[: len(lines) // 6],
    "swapped": lambda lines: [*lines[:2], lines[3], lines[2], *lines[4:]],
    "last swapped": lambda lines: [*lines[:-2], lines[-1], lines[-2]],
    "edited": lambda lines: [*lines[:2], recomputed(lines[2]), *lines[3:]],
    "last edited": lambda lines: [*lines[:-1], recomputed(lines[-1])],
    "repeated": lambda lines: [*lines, lines[-1]],
}


@pytest.mark.parametrize("which", ["a.jsonl", "learner-0.jsonl"])
@pytest.mark.parametrize("case", TAMPERED)
@pytest.mark.parametrize("is_resumed", [False, True])
def test_a_tampered_journal_fails(tmp_path, which, case, is_resumed):
    whole_run(tmp_path)
    path = tmp_path / AUDIT / which
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(TAMPERED[case](lines)))
    if is_resumed and which == "a.jsonl":
        Journal(path).write(actor="a", incarnation="3")
    elif is_resumed:
        learner(tmp_path, life("z", version=7), {"end": []})
    report = audit(tmp_path)
    assert report.missing
    assert command(tmp_path) == 7


def test_a_journal_may_be_one_line_ahead_of_its_note(tmp_path):
    whole_run(tmp_path)
    for path in (tmp_path / AUDIT).glob("*.jsonl"):
        note = path.with_name(f"{path.name}.end")
        before = note.read_bytes()
        Journal(path).write(actor="a", incarnation="3", dropped=[])
        note.write_bytes(before)
    assert command(tmp_path) == 0
    for path in (tmp_path / AUDIT).glob("*.jsonl"):
        Journal(path).write(actor="a", incarnation="4", dropped=[])
    assert command(tmp_path) == 0


def shortened(folder):
    """A run without notes of its journals, whose learner's journal lacks its second half."""
    whole_run(folder)
    for note in (folder / AUDIT).glob("*.end"):
        note.unlink()
    path = folder / AUDIT / "learner-0.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:3]))


@pytest.mark.parametrize("kind", ["version", "checkpoint", "accepted"])
def test_a_journal_is_compared_with_the_run(tmp_path, kind):
    shortened(tmp_path)
    if kind == "version":
        note_version(tmp_path, 8)
    elif kind == "checkpoint":
        folder = tmp_path / "checkpoints"
        folder.mkdir()
        (folder / "checkpoint_000000008.safetensors").write_bytes(b"of a later update")
    else:
        (tmp_path / "accepted" / "0").mkdir(parents=True)
    assert command(tmp_path) == 7


def test_a_waiting_rollout_has_a_file(run_dir):
    learner(run_dir, life(), used(0, 1), {"saved": 5})
    folder = run_dir / "accepted" / "0"
    folder.mkdir(parents=True)
    assert faults(run_dir) == {"not in the journals": 2, "waiting": 2}
    for sequence in (4, 5):
        (folder / f"{sequence:012d}~a~1~{sequence}.safetensors").write_bytes(b"")
    assert faults(run_dir) == {"waiting": 4}


garbage = st.one_of(
    st.binary(max_size=40),
    st.sampled_from([b"{}", b"null", b"[]", b'{"made": 1}', b'{"end": [[1]]}']),
)
injuries = st.one_of(
    st.tuples(st.just("cut"), st.floats(0, 1), st.none()),
    st.tuples(st.just("flip"), st.floats(0, 1), st.integers(0, 7)),
    st.tuples(st.just("line"), st.floats(0, 1), garbage),
    st.tuples(st.just("zero"), st.floats(0, 1), st.integers(1, 600)),
)


def injure(data, injury):
    """The bytes of a journal with one injury at a relative place."""
    kind, place, what = injury
    at = min(int(place * len(data)), len(data) - 1)
    if kind == "cut":
        return data[:at]
    if kind == "flip":
        return data[:at] + bytes([data[at] ^ 1 << what]) + data[at + 1 :]
    if kind == "zero":
        return data[:at] + bytes(min(what, len(data) - at)) + data[at + what :]
    start = data.rfind(b"\n", 0, at) + 1
    return data[:start] + what + b"\n" + data[start:]


@settings(max_examples=400, deadline=None)
@given(
    which=st.sampled_from(["a.jsonl", "learner-0.jsonl"]),
    wounds=st.lists(injuries, min_size=1, max_size=3),
)
def test_damage_is_never_a_traceback_and_never_called_a_loss(which, wounds):
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        whole_run(folder)
        assert audit(folder).faults == []
        assert audit(folder).damaged == 0
        path = folder / AUDIT / which
        data = path.read_bytes()
        for wound in wounds:
            data = injure(data, wound) if data else data
        path.write_bytes(data)
        report = audit(folder)
        assert not report.counts["lost"]
        assert not report.counts["duplicated"]
        assert not report.counts["corrupted"]
        # Where a journal's end was cut off between two lines, nothing shows that there were more.
        assert not report.faults or any(kind == "cut" for kind, *_ in wounds)
        if [kind for kind, *_ in wounds] == ["flip"]:
            assert report.damaged + report.holes > 0
