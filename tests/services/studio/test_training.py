"""The training window: curves, a hundred actors, and episodes found by their time."""

import pathlib
import struct
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from mcap.writer import MCAP0_MAGIC

from congrasp.common.errors import CongraspError
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import Message
from congrasp.services.record.reader import Record, read_records
from congrasp.services.record.recorder import Recorder
from congrasp.services.studio import recordings as recordings_module
from congrasp.services.studio.recordings import Recordings
from congrasp.services.studio.training import (
    FIRST,
    Curve,
    Follower,
    TrainingWindow,
    labels_of,
    open_window,
)
from tests import studio as fake
from tests.studio import BEGIN, DIP
from tests.waits import eventually

KEYS = Keys("fake")


def test_a_window_shows_a_hundred_actors_with_their_newest_episodes() -> None:
    window = fake.window(actors=100)
    view = window.view()
    assert len(view["actors"]) == 100
    row = view["actors"][4]
    assert row["id"] == "a004"
    assert row["lag"] == 1
    assert row["steps_per_second"] == 1004.0
    assert row["success"] == 0.0
    assert row["object"] == "thing-4"
    assert row["alive"]
    assert window.episode("a004").object == "thing-4"
    assert view["constraints"]["pose"] == 0.5
    assert view["counters"]["granted"] == 3
    with pytest.raises(CongraspError, match="a999"):
        window.episode("a999")


def test_success_is_shown_for_every_constraint_of_the_learners_metrics() -> None:
    window = fake.window(actors=0)
    key = KEYS.log("metrics", "learner", "0")
    assert list(window.view()["constraints"]) == ["heading", "pose"]
    window.take(
        key,
        Message({}, {"time": BEGIN, "update": 60, "values": {"success/fingers": 0.25}}),
        time.time(),
    )
    assert window.view()["constraints"]["fingers"] == 0.25


def test_an_actors_newer_episode_replaces_the_older_one() -> None:
    window = fake.window(actors=2)
    newer = fake.actor_episode(77)
    window.take(KEYS.log("episode", "actor", "a001"), newer, time.time())
    assert window.episode("a001").object == newer.meta["object"]
    assert [row["episodes"] for row in window.view()["actors"]] == [1, 2]


def test_departed_actors_expire_and_an_absent_learner_is_shown() -> None:
    window = fake.window(actors=3)
    now = time.time()
    window.take_status(fake.status(2), now + 5)
    assert [row["alive"] for row in window.view()["actors"]] == [True, True, False]
    window.take_status(fake.status(2), now + 60)
    assert [row["id"] for row in window.view()["actors"]] == ["a000", "a001"]
    window.take_status(None, now + 61)
    assert window.view()["phase"] == "disconnected"
    assert window.view()["version"] == 12


def test_thinned_curves_keep_every_dip() -> None:
    window = fake.window(actors=0, updates=5000)
    curve = window.view(["episode/success"], points=100)["curves"]["episode/success"]
    assert len(curve["steps"]) <= 100
    assert curve["values"][curve["steps"].index(DIP)] == 0.1
    assert curve["times"][curve["steps"].index(DIP)] == BEGIN + 10 * DIP


def test_a_run_resumed_from_a_checkpoint_overwrites_its_curve() -> None:
    curve = Curve()
    for step, value in ((1, 0.1), (2, 0.2), (3, 0.3), (2, 0.9)):
        curve.add(step, value, 10.0 * step)
    assert curve.steps == [1, 2]
    assert curve.values == [0.1, 0.9]


@pytest.mark.parametrize(
    "message",
    [
        Message({}, {"values": {"x": "high"}, "update": 1}),
        Message({}, {"values": 3}),
        Message({}, {}),
        Message({"link_position": np.zeros((1, 1, 3))}, {}),
    ],
)
def test_damaged_messages_are_counted_and_change_nothing(message: Message) -> None:
    window = TrainingWindow("fake")
    for kind in ("metrics", "event", "episode"):
        window.take(KEYS.log(kind, "learner", "0"), message, 0.0)
    assert window.damaged == 3
    assert window.view()["names"] == {}


def test_a_follower_notices_the_learners_start_and_end() -> None:
    hub = MemoryHub()
    learner = MemoryTransport(hub)
    client = MemoryTransport(hub)
    learner.serve(
        KEYS.status,
        lambda key, request: Message(
            {},
            fake.status(2)
            | {"queue": {"length": 0, "limit": 4}}
            | {
                "counters": dict.fromkeys(
                    (
                        "granted",
                        "running",
                        "redeemed",
                        "returned",
                        "expired",
                        "accepted",
                        "consumed",
                        "dropped",
                        "queued",
                    ),
                    0,
                )
            },
        ),
    )
    window = TrainingWindow("fake")
    follower = Follower(client, window, every=0.05)
    stop = threading.Event()
    try:
        while not (
            window.view()["curves"]
            and window.view()["version"] == 12
            and len(window.view()["actors"]) == 2
        ):
            learner.publish(KEYS.log("metrics", "learner", "0"), fake.metrics(1))
            stop.wait(0.05)
        assert window.view()["phase"] == "training"
        learner.close()
        while window.view()["phase"] != "disconnected":
            stop.wait(0.05)
    finally:
        follower.close()


def test_episodes_around_a_time_come_from_finished_and_from_growing_files(
    tmp_path: pathlib.Path,
) -> None:
    when = BEGIN + 10 * DIP
    fake.record(tmp_path, [(when - 100, 1), (when - 2, 2), (when + 3, 3), (when + 100, 4)])
    recordings = Recordings(tmp_path)
    reach, rows = recordings.around(when, 5.0)
    assert reach == 5.0
    assert [row["actor"] for row in rows] == ["a002", "a003"]
    assert recordings.episode(rows[1]["id"]).object == "thing-3"
    # The same of a file whose writer was killed: it has no index.
    file = next(tmp_path.glob("*.mcap"))
    cut = tmp_path / f"{file.name}.part"
    cut.write_bytes(file.read_bytes()[:-200])
    file.unlink()
    assert [row["actor"] for row in recordings.around(when, 5.0)[1]] == ["a002", "a003"]
    # Where there is none, the nearest are found.
    reach, rows = recordings.around(when - 90, 3.0)
    assert reach == 15.0
    assert [row["actor"] for row in rows] == ["a001"]
    with pytest.raises(CongraspError, match="not in the current list"):
        recordings.episode("nothing")


def test_a_growing_file_is_read_once_a_search(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    fake.record(tmp_path, [(BEGIN, 1)])
    file = next(tmp_path.glob("*.mcap"))
    growing = tmp_path / f"{file.name}.part"
    growing.write_bytes(file.read_bytes()[:-200])
    file.unlink()
    reads = []

    def count_reads(path: pathlib.Path, *arguments: Any) -> Iterator[Record]:
        reads.append(path)
        return read_records(path, *arguments)

    monkeypatch.setattr(recordings_module, "read_records", count_reads)
    caplog.clear()
    reach, rows = Recordings(tmp_path).around(BEGIN + 20, 1.0)
    assert reach == 25.0
    assert [row["actor"] for row in rows] == ["a001"]
    assert reads == [growing]
    assert not caplog.text


def test_only_the_damaged_part_of_a_finished_file_is_lost(
    tmp_path: pathlib.Path, caplog: Any
) -> None:
    fake.record(tmp_path, [(BEGIN + n, n) for n in range(3)])
    file = next(tmp_path.glob("*.mcap"))
    intact = file.read_bytes()
    fake.record(tmp_path, [(BEGIN + 700 + n, n) for n in range(3, 6)])

    def found(place: int) -> list[str]:
        file.write_bytes(intact[:place] + bytes([intact[place] ^ 1]) + intact[place + 1 :])
        return [row["actor"] for row in Recordings(tmp_path).around(BEGIN, 1000.0)[1]]

    everyone = [f"a{n:03d}" for n in range(6)]
    (summary_start,) = struct.unpack_from("<Q", intact, len(intact) - len(MCAP0_MAGIC) - 20)
    assert all(
        found(place) == everyone
        for place in range(summary_start, len(intact) - len(MCAP0_MAGIC), 2411)
    )
    caplog.clear()
    assert found(intact.index(b"zstd") + 400) == everyone[3:]
    assert f"{file} is damaged in 1 place" in caplog.text


def test_of_many_episodes_the_nearest_are_taken(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recordings_module, "MAX_EPISODES", 3)
    fake.record(tmp_path, [(BEGIN + n, n) for n in range(5)])
    _, rows = Recordings(tmp_path).around(BEGIN, 1000.0)
    assert [row["actor"] for row in rows] == ["a000", "a001", "a002"]


def test_curves_and_newest_episodes_are_read_from_recordings(tmp_path: pathlib.Path) -> None:
    transport = MemoryTransport(MemoryHub())
    with Recorder(transport, "fake", tmp_path) as recorder:
        for update in range(40):
            transport.publish(KEYS.log("metrics", "learner", "0"), fake.metrics(update))
        reported = {
            "time": BEGIN,
            "version": 39,
            "values": {"rollouts": 12.0, "steps_per_second": 800.0, "x": 1.0},
        }
        transport.publish(KEYS.log("metrics", "actor", "a003"), Message({}, reported))
        told = {
            "time": BEGIN + 400,
            "level": "info",
            "text": "The run is complete after 40 updates.",
        }
        transport.publish(KEYS.log("event", "learner", "0"), Message({}, told))
        eventually(lambda: recorder.messages >= 42)
    fake.record(tmp_path, [(BEGIN, 3), (BEGIN + 5, 3), (BEGIN + 6, 4)])
    window = TrainingWindow("fake", Recordings(tmp_path))
    window.load()
    assert [row["id"] for row in window.view()["actors"]] == ["a003", "a004"]
    assert window.episode("a004").object == "thing-4"
    curve = window.view(["episode/success"], points=10**6)["curves"]["episode/success"]
    assert curve["values"][DIP] == 0.1
    assert curve["times"][DIP] == BEGIN + 10 * DIP
    # A run that is over is shown whole: its last state, and no learner is missed.
    view = window.view()
    assert view["phase"] == "recorded"
    assert view["last"]["update"] == 39
    assert view["last"]["success"] == 0.78
    assert list(view["curves"]) == list(dict.fromkeys((*FIRST, *view["names"])))
    assert len(view["curves"]) == 6
    assert [event["text"] for event in view["events"]] == ["The run is complete after 40 updates."]
    row = view["actors"][0]
    assert row["version"] == 39
    assert row["rollouts"] == 12.0
    assert row["steps_per_second"] == 800.0


def test_a_window_has_the_name_of_the_run_or_of_the_recordings_folder(
    tmp_path: pathlib.Path,
) -> None:
    fake.record(tmp_path / "mine" / "logs", [(BEGIN, 3)])
    for run, folder, name in (
        ("", tmp_path / "mine" / "logs", "mine"),
        ("r", tmp_path / "mine", "r"),
        ("", None, ""),
    ):
        assert open_window(run, folder).run == name


def test_a_finished_run_stays_finished_when_its_learner_has_gone() -> None:
    window = fake.window(actors=2)
    window.take_status(fake.status(2) | {"finished": True}, time.time())
    window.take_status(None, time.time())
    view = window.view()
    assert view["phase"] == "finished"
    assert len(view["curves"]) == 6
    assert view["version"] == 12


def test_curves_have_the_titles_and_units_of_the_figures_and_their_order() -> None:
    labels = labels_of(
        [
            "term/force_excess",
            "episode/heading_rad",
            "staleness_mean",
            "update_seconds",
            "episode/success",
        ]
    )
    units = {name: label["unit"] for name, label in labels.items()}
    assert units == {
        "episode/success": "share of episodes",
        "staleness_mean": "versions",
        "term/force_excess": "reward",
        "episode/heading_rad": "rad",
        "update_seconds": "s",
    }
    assert list(labels)[:2] == ["episode/success", "staleness_mean"]
    assert not any({"_", "/"} & set(label["title"]) for label in labels.values())
