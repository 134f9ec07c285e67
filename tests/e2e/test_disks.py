"""A disk that is full or slow under a run: training goes on and says so in one line, and nothing is
lost.
"""

import dataclasses
import threading

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.io.journal import AUDIT, Journal, read_journal
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import Message
from congrasp.learner.process import Outputs, run_learner
from congrasp.learner.run_directory import LOGS, create_run
from congrasp.services.ops.audit import compare as audit
from congrasp.services.ops.status import ask
from congrasp.services.record.reader import read_metrics
from congrasp.services.record.recorder import Recorder
from tests.benchmarks.faults import fill, small_disk
from tests.learner.made_up_actor import MadeUpActor
from tests.learner.test_process import CONFIG
from tests.waits import eventually


@pytest.fixture
def disk(tmp_path):
    """A file system of 800 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    with small_disk(str(place), 800 << 10) as there:
        if not there:
            pytest.skip("file systems cannot be mounted here")
        yield place


def publish_noise(transport):
    """More metrics than fit into what is left of a page."""
    noise = {str(i): value for i, value in enumerate(np.random.default_rng().normal(size=500))}
    meta = {"time": 0.0, "update": 8, "values": noise}
    transport.publish(Keys(CONFIG.name).log("metrics", "test", "0"), Message(meta=meta))


def test_training_continues_on_a_full_disk(disk, tmp_path):
    config = dataclasses.replace(CONFIG, updates=12, checkpoint_every=2)
    run_dir = disk / "run"
    create_run(run_dir, config)
    hub = MemoryHub()
    journal = tmp_path / "actor.jsonl"
    actor = MadeUpActor(MemoryTransport(hub), journal=lambda run_id: Journal(journal))
    lines = []
    complaints = []
    filler = []
    warnings = []
    with MemoryTransport(hub) as transport:
        recorder = Recorder(transport, config.name, run_dir / LOGS, warn=complaints.append)

        def on_update(values):
            if values["update"] == 4:
                eventually(lambda: recorder.files and "learner/0/kl" in read_metrics(run_dir))
                filler.append(fill(disk))
            if values["update"] == 6:
                warnings.extend(ask(transport, config.name)["warnings"])
            if values["update"] == 8:
                eventually(lambda: publish_noise(transport) or recorder.error)
                filler[0].unlink()

        last = run_learner(
            run_dir,
            config,
            transport,
            stop_event=threading.Event(),
            outputs=Outputs(
                recorder=recorder,
                on_update=on_update,
                on_event=lambda level, text: lines.append((level, text)),
            ),
        )
    actor.join(10.0)
    assert last.version == 12
    assert actor.ended == "The run is finished."
    errors = [text for level, text in lines if level == "error"]
    # Although every update tries again
    (error,) = (text for text in errors if "checkpoint_" in text)
    assert "checkpoint_000000004.safetensors could not be written" in error
    assert "A kill now would lose 2 update(s), those since update 2." in error
    (warning,) = (text for text in warnings if "checkpoint_000000005" in text)
    assert "A kill now would lose 3 update(s), those since update 2." in warning
    assert ("info", "Checkpoints can be written again; the newest is of update 8.") in lines
    assert not any("\n" in text for text in errors)
    assert complaints == [recorder.error]
    assert "No space left" in recorder.error
    assert (run_dir / "checkpoints" / "latest").resolve().name == "checkpoint_000000012.safetensors"
    assert int((run_dir / "version").read_text()) == 12
    assert len(read_metrics(run_dir)["learner/0/kl"][0]) >= 1  # what was recorded before
    report = audit(run_dir, [journal])
    assert not report.faults
    assert report.holes or report.counts["used"] == 24


def test_a_journal_counts_lines_lost_on_a_full_disk(disk):
    complaints = []
    journal = Journal(disk / AUDIT / "x.jsonl", complaints.append)
    journal.write(line=0)
    filler = fill(disk)
    for line in range(1, 400):
        journal.write(line=line)
    assert len(complaints) == 1
    assert "No space left" in complaints[0]
    filler.unlink()
    journal.write(line=400)
    journal.write(line=401)
    journal_lines = read_journal(disk / AUDIT / "x.jsonl")
    *before, after, last = journal_lines.intact
    assert [entry["line"] for entry in before] == [*range(len(before))]
    assert after == {"line": 400}
    assert last == {"line": 401}
    assert journal_lines.lost == 400 - len(before)
    assert journal_lines.damaged == 0


def test_a_failed_last_checkpoint_is_an_error(disk):
    config = dataclasses.replace(CONFIG, updates=3, checkpoint_every=2)
    create_run(disk / "run", config)
    hub = MemoryHub()
    MadeUpActor(MemoryTransport(hub))
    with (
        MemoryTransport(hub) as transport,
        pytest.raises(CongraspError, match=r"000000003\..*could not be") as caught,
    ):
        run_learner(
            disk / "run",
            config,
            transport,
            stop_event=threading.Event(),
            outputs=Outputs(on_update=lambda values: values["update"] == 3 and fill(disk)),
        )
    assert "\n" not in str(caught.value)
    assert (
        disk / "run" / "checkpoints" / "latest"
    ).resolve().name == "checkpoint_000000002.safetensors"
