"""Accepted rollouts on disk: what a resumed learner recovers."""

import functools
import os
import threading
import time

import pytest

from congrasp.learner.hub.write_ahead import PART_SUFFIX, WriteAheadLog
from tests.learner.hub_bench import bundle, sequences


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "log"


@pytest.fixture
def log(folder):
    return functools.partial(WriteAheadLog, folder, 1)


def on_disk(folder):
    """Sequences of the rollouts on disk, in the order of their acceptance."""
    return [int(path.stem.split("~")[3]) for path in sorted(folder.glob("*.safetensors"))]


def test_a_resumed_learner_uses_logged_rollouts_oldest_first(bench, log, folder):
    b = bench(version=3, batch=2, log=log(), durable={**bench().rollouts.durable(), "version": 3})
    for i, version in enumerate((3, 2, 3, 2)):
        assert b.send(i, version=version)["outcome"] == "accepted"
        assert on_disk(folder) == list(range(i + 1))  # before it is acknowledged
    assert sequences(b.rollouts.next_batch(2, 1)) == [1, 3]
    b.hub.publish_weights(bundle(4), 4)
    assert b.send(4, version=4)["outcome"] == "accepted"
    b.hub.publish_weights(bundle(5), 5)
    # Two versions from the checkpoint: of no use to a resume
    assert b.send(5, version=5)["outcome"] == "accepted"
    assert on_disk(folder) == [0, 1, 2, 3, 4]

    resumed = bench(batch=2, log=log(), durable={**bench().rollouts.durable(), "version": 3})
    resumed.hub.publish_weights(bundle(7), 7)  # which is 3 under another number
    assert resumed.ledger()["queued"] == 5
    assert not resumed.ticket()["granted"]
    assert resumed.send(1, version=2)["outcome"] == "duplicate"
    batches = []
    for version in (8, 9, 10):
        batches.append(sequences(resumed.rollouts.next_batch(2, 5 if version < 10 else 0.05) or []))
        resumed.hub.publish_weights(bundle(version), version)
    # Of 2 and 4, one update away from 3, only one batch could be used
    assert batches == [
        [1, 3],
        [0, 2],
        [],
    ]
    assert resumed.ledger()["dropped"] == 1
    assert resumed.ticket()["granted"]


def test_the_log_keeps_only_rollouts_queued_at_a_checkpoint(bench, log, folder):
    b = bench(version=5, batch=2, log=log())
    for i in range(3):
        assert b.send(i, version=5)["outcome"] == "accepted"
    assert on_disk(folder) == []  # there is no checkpoint from which these would be fresh
    assert sequences(b.rollouts.next_batch(2, 1)) == [0, 1]
    b.hub.publish_weights(bundle(6), 6)
    durable = b.rollouts.durable()
    assert on_disk(folder) == [2]
    assert b.send(3, version=6)["outcome"] == "accepted"  # while the checkpoint is written
    b.rollouts.note_saved()
    assert on_disk(folder) == [2, 3]

    resumed = bench(version=6, batch=2, log=log(), durable=durable)
    assert sequences(resumed.rollouts.next_batch(2, 1)) == [2, 3]
    resumed.hub.publish_weights(bundle(7), 7)
    resumed.rollouts.durable()
    assert on_disk(folder) == [2, 3]  # the checkpoint might yet fail
    resumed.rollouts.note_saved()
    assert on_disk(folder) == []


def test_rollouts_are_acknowledged_after_they_are_written(bench, log, folder):
    """Neither what is accepted, nor the same that is sent again meanwhile, nor after the end was
    noted.
    """
    written = threading.Event()
    slow = log()
    b = bench(version=0, log=slow)
    add = slow.add
    slow.add = lambda header, message: written.wait(10) and add(header, message)
    answers = []
    first = threading.Thread(target=lambda: answers.append(b.send(0)["outcome"]))
    first.start()
    while b.ledger()["queued"] == 0:
        time.sleep(0.01)
    assert b.send(0)["outcome"] == "retry"
    assert not answers
    written.set()
    first.join(60)
    assert answers == ["accepted"]
    assert b.send(0)["outcome"] == "duplicate"
    assert on_disk(folder) == [0]
    # The disk refuses it, and the learner stops
    slow.add = lambda header, message: b.rollouts.close()
    assert b.send(1)["outcome"] == "retry"


def test_a_discarded_batch_is_not_recovered(bench, log, folder):
    b = bench(version=0, log=log())
    for i in range(3):
        b.send(i)
    b.rollouts.discard(b.rollouts.next_batch(2, 1))
    assert on_disk(folder) == [2]


def test_damaged_torn_and_foreign_files_are_told_apart(bench, log, folder):
    logged = []
    b = bench(version=0, log=log())
    for i in range(4):
        assert b.send(i)["outcome"] == "accepted"
    damaged, renamed = sorted(folder.iterdir())[1:3]
    damaged.write_bytes(damaged.read_bytes()[:-3] + b"xyz")
    renamed.rename(folder / renamed.name.replace("~2.", "~9."))
    (folder / f"000000000009~a~01~5.safetensors{PART_SUFFIX}").write_bytes(
        b"torn, and so never acknowledged"
    )
    # Which would keep a reader waiting for ever
    os.mkfifo(folder / "000000000008~a~01~7.safetensors")
    (folder / "notes.txt").write_text("not ours")
    resumed = bench(version=1, log=log(), on_event=lambda *event: logged.append(event))
    assert sequences(resumed.rollouts.next_batch(2, 1)) == [0, 3]
    assert ("error", "3 accepted rollouts are damaged on disk and were ignored.") in logged
    kinds = sorted(path.suffix for path in folder.iterdir())
    assert kinds == [".aside", ".aside", ".aside", ".safetensors", ".safetensors", ".txt"]
    other = bench(log=log(), run_id="f")
    other.hub.publish_weights(bundle(0, run_id="f"), 0)
    assert not on_disk(folder)
    assert other.ledger()["queued"] == 0


def test_without_writing_existing_rollouts_are_recovered(bench, log, folder):
    b = bench(version=0, log=log())
    b.send(0)
    resumed = bench(version=1, log=log(write=False))
    assert resumed.send(1, version=1)["outcome"] == "accepted"
    assert on_disk(folder) == [0]
    assert sequences(resumed.rollouts.next_batch(2, 1)) == [0, 1]


def test_a_failing_disk_is_logged_once_and_training_continues(bench, tmp_path):
    logged = []
    (tmp_path / "file").touch()
    folder = tmp_path / "file" / "log"
    b = bench(version=0, batch=3, log=WriteAheadLog(folder, 1, log_error=logged.append))
    assert [b.send(i)["outcome"] for i in range(3)] == ["accepted"] * 3
    assert len(logged) == 1
    assert "they do not survive the learner" in logged[0]
    (tmp_path / "file").unlink()
    assert b.send(3)["outcome"] == "accepted"
    assert on_disk(folder) == [3]
