"""The recorder writes what a run publishes, and nothing that happens to it reaches the run."""

import contextlib
import errno
import itertools
import json
import pathlib
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from congrasp.common.hands import get_hand
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.transport.ports import free_port
from congrasp.common.transport.zenoh_transport import ZenohTransport
from congrasp.common.wire.codec import Message
from congrasp.services.record.reader import (
    log_files,
    read_episodes,
    read_metrics,
    read_records,
    read_rollouts,
)
from congrasp.services.record.recorder import Recorder
from congrasp.services.record.writer import Entry, LogWriter
from tests.episodes import episode_message
from tests.recordings import is_complete
from tests.services.record.test_files import doctor
from tests.waits import eventually

KEYS = Keys("r")
METRICS = KEYS.log("metrics", "learner", "0")


def metrics(update: int) -> Message:
    return Message({}, {"time": time.time(), "update": update, "values": {"kl": 0.1}})


@pytest.fixture
def transport() -> MemoryTransport:
    return MemoryTransport(MemoryHub())


def test_everything_a_run_publishes_is_in_the_file(
    transport: MemoryTransport, tmp_path: pathlib.Path
) -> None:
    rollout = Message({"reward": np.ones((4, 2), np.float32)}, {"actor": "a0"})
    absent = {"pose_m": float("nan"), "return": 1.0}
    with Recorder(transport, "r", tmp_path) as recorder:
        for update in range(3):
            transport.publish(METRICS, metrics(update))
        transport.publish(
            KEYS.log("metrics", "actor", "a0"),
            Message({}, {"time": 0.0, "values": {"pace": 5, **absent}}),
        )
        transport.publish(
            KEYS.log("event", "actor", "a0"),
            Message({}, {"time": 0.0, "level": "warning", "text": "hot"}),
        )
        transport.publish(
            KEYS.log("version", "learner", "0"),
            Message({}, {"version": 7, "hash": "ab", "list": [1]}),
        )
        transport.publish(KEYS.log("rollout", "actor", "a0"), rollout)
        sent = Message(episode_message().arrays, {**episode_message().meta, "metrics": absent})
        transport.publish(KEYS.log("episode", "actor", "a0"), sent)
        transport.publish(KEYS.rollout("a"), rollout)  # no log
    assert recorder.messages == 8
    assert recorder.damaged == 0
    assert recorder.dropped == 0
    assert recorder.error == ""
    (path,) = recorder.files
    assert is_complete(path)
    topics: dict[str, list[bytes]] = {}
    for record in read_records(path):
        topics.setdefault(record.topic, []).append(record.data)
    assert set(topics) == {
        "/metrics/learner/0",
        "/metrics/actor/a0",
        "/events/actor/a0",
        "/version/learner/0",
        "/rollout/a0",
        *(
            f"/episode/a0/{part}"
            for part in ("raw", "scene", "surface", "tf", "contacts", "signals")
        ),
        *(f"/episode/a0/hand/{link.name}" for link in get_hand("human").links),
    }
    assert len(topics["/metrics/learner/0"]) == 3
    assert json.loads(topics["/version/learner/0"][0]) == {"version": 7, "hash": "ab"}
    np.testing.assert_array_equal(read_metrics(tmp_path)["learner/0/kl"][0], [0, 1, 2])
    (recorded,) = read_episodes(tmp_path)
    np.testing.assert_array_equal(recorded.link_position, episode_message().arrays["link_position"])
    assert recorded.metrics == {"return": 1.0}
    (read,) = read_rollouts(tmp_path)
    assert dict(read.meta) == dict(rollout.meta)
    assert set(read.arrays) == set(rollout.arrays)
    for name, array in rollout.arrays.items():
        np.testing.assert_array_equal(read.arrays[name], array)


def test_damaged_messages_are_left_out_and_counted(
    transport: MemoryTransport, tmp_path: pathlib.Path
) -> None:
    notes: list[str] = []
    broken = Message(
        {**episode_message().arrays, "link_position": np.zeros(3)}, episode_message().meta
    )
    with Recorder(transport, "r", tmp_path, warn=notes.append) as recorder:
        transport.publish(METRICS, Message({}, {}))
        transport.publish(METRICS, Message({}, {"values": {"kl": "high"}}))
        transport.publish(KEYS.log("episode", "actor", "a0"), broken)
        transport.publish("congrasp/r/log/gossip/actor/a0", Message({}, {}))
        transport.publish("congrasp/r/log/metrics", Message({}, {}))
        transport.publish(METRICS, metrics(0))
    assert recorder.messages == 1
    assert recorder.damaged == 5
    assert len(notes) == 1
    assert METRICS in notes[0]
    assert [record.topic for record in read_records(recorder.files[0])] == ["/metrics/learner/0"]


def test_messages_faster_than_the_disk_are_dropped_and_counted(transport, tmp_path):
    recorder = Recorder(transport, "r", tmp_path, depth=10)
    for update in range(25):
        transport.publish(METRICS, metrics(update))
    recorder.start().close()
    assert recorder.messages == 10
    assert recorder.dropped == 15
    np.testing.assert_array_equal(read_metrics(tmp_path)["learner/0/kl"][0], range(15, 25))


def test_a_full_disk_stops_the_recording_alone(transport, tmp_path, monkeypatch):
    notes: list[str] = []
    seen: list[Entry] = []

    class Sink:
        def write(self, entry: Entry) -> None:
            seen.append(entry)

    flush = LogWriter.flush
    full = False

    def flush_or_fail(self: LogWriter) -> None:
        if full:
            raise OSError(errno.ENOSPC, "No space left on device")
        flush(self)

    monkeypatch.setattr(LogWriter, "flush", flush_or_fail)
    with Recorder(transport, "r", tmp_path, warn=notes.append, sinks=[Sink()]) as recorder:
        transport.publish(METRICS, metrics(0))
        eventually(lambda: bool(recorder.files) and len(list(read_records(recorder.files[0]))) == 1)
        full = True
        eventually(lambda: bool(recorder.error))
        transport.publish(METRICS, metrics(1))
        eventually(lambda: len(seen) == 2)
    assert notes == [recorder.error]
    assert "No space left on device" in recorder.error
    assert "\n" not in recorder.error
    np.testing.assert_array_equal(read_metrics(tmp_path)["learner/0/kl"][0], [0])


def test_files_rotate_while_recording(transport: MemoryTransport, tmp_path: pathlib.Path) -> None:
    with Recorder(transport, "r", tmp_path, max_seconds=0.0) as recorder:
        for update in range(3):
            transport.publish(METRICS, metrics(update))
    assert len(recorder.files) == 3
    assert all(is_complete(path) for path in recorder.files)


@contextlib.contextmanager
def recorder_process(endpoint: str, out: pathlib.Path) -> Iterator[subprocess.Popen[str]]:
    command = [
        sys.executable,
        "-m",
        "congrasp",
        "record",
        "--connect",
        endpoint,
        "--run",
        "r",
        "--out",
        str(out),
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def publish_until(transport: ZenohTransport, done: Callable[[], bool]) -> int:
    """Publishes updates until something has happened; returns how many."""
    update = 0

    def step() -> bool:
        nonlocal update
        transport.publish(METRICS, metrics(update))
        update += 1
        return done()

    eventually(step)
    return update


def recorded(out: pathlib.Path) -> int:
    return (
        sum(len(list(read_records(path))) for path in log_files(out))
        if out.exists() and any(out.iterdir())
        else 0
    )


def steps_in(out: pathlib.Path) -> np.ndarray:
    return read_metrics(out)["learner/0/kl"][0]


def test_another_process_records_over_zenoh_until_ctrl_c(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (
        ZenohTransport(listen=[endpoint]) as transport,
        recorder_process(endpoint, tmp_path / "out") as process,
    ):
        publish_until(transport, lambda: recorded(tmp_path / "out") > 3)
        transport.publish(KEYS.log("episode", "actor", "a0"), episode_message())
        eventually(lambda: bool(list(read_episodes(tmp_path / "out"))))
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=10)
    (path,) = log_files(tmp_path / "out")
    assert is_complete(path)
    assert str(path) in out
    assert process.returncode == 130, errors
    assert "messages recorded" in errors
    assert "Traceback" not in errors


def test_a_killed_recorder_keeps_records_up_to_its_last_flush(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohTransport(listen=[endpoint]) as transport:
        with recorder_process(endpoint, tmp_path / "out"):
            sent = publish_until(transport, lambda: recorded(tmp_path / "out") > 0)
            eventually(lambda: steps_in(tmp_path / "out")[-1] == sent - 1)
        transport.publish(METRICS, metrics(0))
    (path,) = log_files(tmp_path / "out")
    assert not is_complete(path)
    steps = steps_in(tmp_path / "out")
    np.testing.assert_array_equal(steps, range(int(steps[0]), sent))
    assert codes(path) <= CUT


CUT = {
    *(
        "BAD_TRAILING_MAGIC",
        "MISSING_FOOTER",
        "MISSING_DATA_END",
        "MISSING_CHUNK_INDEXES",
        "MISSING_METADATA_INDEXES",
    ),
    *(
        "MISSING_STATISTICS",
        "NO_ATTACHMENTS",
        "TRUNCATED_RECORD",
        "TRUNCATED_FILE",
        "CHUNK_COMPRESSION_INEFFICIENT",
    ),
}
"""What `pymcap-cli doctor` may say about a file whose writer was killed: its end is missing, chunks
of a busy moment are small, and nothing is wrong."""


def codes(path: pathlib.Path) -> set[str]:
    """The codes of what it says."""
    return set(re.findall(r"\b[A-Z]+(?:_[A-Z]+)+\b", doctor(path).stdout))


def test_a_suspended_recorder_does_not_block_the_run(tmp_path: pathlib.Path) -> None:
    """Twenty megabytes are published at it, more than it may keep; when it goes on, it says how
    much it missed.
    """
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    big = Message({"x": np.zeros(250_000, np.float32)}, {"actor": "a"})
    big_size = 1_000_000
    rollouts = KEYS.log("rollout", "actor", "a")

    def sizes() -> list[int]:
        records = itertools.chain.from_iterable(map(read_records, log_files(tmp_path / "out")))
        return [len(record.data) for record in records if record.topic.startswith("/rollout/")]

    with (
        ZenohTransport(listen=[endpoint]) as transport,
        recorder_process(endpoint, tmp_path / "out") as process,
    ):
        publish_until(transport, lambda: recorded(tmp_path / "out") > 3)
        process.send_signal(signal.SIGSTOP)
        for _ in range(20):
            transport.publish(rollouts, big)
        process.send_signal(signal.SIGCONT)
        small = Message({"x": np.zeros(1, np.float32)}, {"actor": "a"})  # by which a gap shows
        eventually(
            lambda: transport.publish(rollouts, small) or min(sizes(), default=big_size) < big_size
        )
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=10)
    lost = re.search(r"lost (\d+)", errors)
    assert lost is not None
    assert sum(size >= big_size for size in sizes()) + int(lost[1]) >= 20
    assert int(lost[1]) > 0
