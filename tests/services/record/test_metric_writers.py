"""Metrics of a learner on TensorBoard and Weights & Biases, as their own readers find them."""

import itertools
import pathlib
import struct
from collections.abc import Sequence

import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event, SessionLog

from congrasp.common.config import MetricWriter, RunConfig
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import Message
from congrasp.services.record import metric_writers
from congrasp.services.record.reader import read_metrics
from congrasp.services.record.run_recording import recorded
from tests.episodes import episode_message


def publish(folder: pathlib.Path, names: Sequence[MetricWriter], updates: Sequence[int]) -> None:
    """A run of which a learner, an actor and an episode are recorded."""
    keys = Keys("r")
    config = RunConfig(name="r")
    logs = folder / "logs"
    with (
        MemoryTransport(MemoryHub()) as transport,
        recorded(transport, config, folder, logs, names) as running,
    ):
        for update in updates:
            values = {"episode/success": update / 10, "kl": 0.25, "bad": float("nan")}
            transport.publish(
                keys.log("metrics", "learner", "0"),
                Message({}, {"time": 0.0, "update": update, "values": values}),
            )
        transport.publish(
            keys.log("metrics", "actor", "a"), Message({}, {"time": 0.0, "values": {"pace": 1.0}})
        )
        transport.publish(keys.log("episode", "actor", "a"), episode_message(3))
    assert running.error == ""


def events(folder: pathlib.Path) -> list[list[Event]]:
    """What is in each event file, by the framing that TensorFlow documents: length, its CRC, data,
    its CRC.
    """
    all_events = []
    for path in sorted(folder.iterdir()):
        data = path.read_bytes()
        at = 0
        all_events.append([])
        while at < len(data):
            (length,) = struct.unpack_from("<Q", data, at)
            all_events[-1].append(Event.FromString(data[at + 12 : at + 12 + length]))
            at += 16 + length
    return all_events


def test_tensorboard_has_the_learners_metrics_and_a_resumed_run_replaces_them(
    tmp_path: pathlib.Path,
) -> None:
    publish(tmp_path, ["tensorboard"], range(5))
    assert [path.name for path in (tmp_path / "tensorboard").iterdir()] == ["learner-0"]
    (first,) = events(tmp_path / "tensorboard" / "learner-0")
    assert first[0].file_version == "brain.Event:2"
    scalars = {}
    for event in first:
        for value in event.summary.value:
            scalars[event.step, value.tag] = value.simple_value
    assert set(scalars) == set(itertools.product(range(5), ("episode/success", "kl")))
    assert scalars[3, "episode/success"] == pytest.approx(0.3)
    assert first[1].step == 0
    assert first[1].session_log.status == SessionLog.START
    publish(tmp_path, ["tensorboard"], range(3, 6))
    second = [
        event for event in events(tmp_path / "tensorboard" / "learner-0") if event[1].step == 3
    ]
    assert len(second) == 1
    assert second[0][1].session_log.status == SessionLog.START
    # The MCAP has the same, whatever the writer does.
    np.testing.assert_array_equal(read_metrics(tmp_path / "logs")["learner/0/kl"][0], range(6))


def test_weights_and_biases_offline(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_API_KEY", "")
    publish(tmp_path, ["wandb-offline"], range(3))
    (file,) = (tmp_path / "wandb").glob("offline-run-*/run-*.wandb")
    data = file.read_bytes()
    for text in (b"episode/success", b"kl", b"congrasp", b"0.25", b"environments"):
        assert text in data, text
    assert data.count(b"episode/success") >= 3
    assert b"pace" not in data
    assert not (tmp_path / "tensorboard").exists()


def test_a_failing_metric_writer_does_not_stop_the_recording(tmp_path, monkeypatch, capsys):
    def refuse(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(metric_writers.TensorBoard, "write", refuse)
    publish(tmp_path, ["tensorboard"], range(4))
    assert len(read_metrics(tmp_path / "logs")["learner/0/kl"][0]) == 4
    assert capsys.readouterr().err.count("tensorboard receives no more metrics") == 1
