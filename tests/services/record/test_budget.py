"""What one peer's logs can cost a recorder and a live viewer: names, schemas, bytes and time, and
no traceback.
"""

import itertools
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.files import hand_text
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message
from congrasp.services.record.budget import LogBudget, Publisher
from congrasp.services.record.converter import Converter
from congrasp.services.record.live import LiveServer
from tests.episodes import episode_message
from tests.waits import Clock

KEYS = Keys("r")
ROOT = pathlib.Path(__file__).resolve().parents[3]
RECORDER = """
import pathlib, resource, sys
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import Message
from congrasp.services.record.recorder import Recorder

transport, keys, out = MemoryTransport(MemoryHub()), Keys("r"), pathlib.Path(sys.argv[1])
with Recorder(transport, "r", out, warn=lambda text: None) as recorder:
    transport.publish(keys.log("metrics", "learner", "0"), Message({}, {"values": {"loss": 1.0}}))
    while not recorder.messages:
        pass
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for i in range(150):
        values = {f"made/up/{i}/{j}": 1.0 for j in range(2000)}
        transport.publish(keys.log("metrics", "actor", "1.b"), Message({}, {"values": values}))
    while recorder.messages + recorder.damaged < 151:
        pass
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10)
"""


def metrics(**values):
    return Message({}, {"time": 1.0, "values": values})


def test_new_metric_names_are_bounded():
    convert = Converter()
    evil = KEYS.log("metrics", "actor", "1.b")
    honest = KEYS.log("metrics", "actor", "0.a")
    schemas = set()
    for i in range(150):
        (entry,) = convert(evil, metrics(**{f"made/up/{i}/{j}": 1.0 for j in range(100)}), i)
        schemas.add(entry.channel.schema)
        (entry,) = convert(honest, metrics(loss=float(i)), i)
        assert f'"loss":{float(i)}' in entry.data.decode()
    assert len(schemas) <= 32
    assert sum(map(len, schemas)) < 500_000


@pytest.mark.slow
def test_a_recorder_keeps_its_size(tmp_path):
    """150 log messages of new names made the recorder of an earlier version grow by 1.8 GB."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", RECORDER, str(tmp_path)]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=100, check=True
    )
    assert int(done.stdout) < 150  # MiB, of which the messages that wait have some
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 30 << 20


def admit_64_names(budget):
    """Admits as many names of one identity as it may have."""
    for i in range(64):
        budget.admit(Publisher("actor", f"1.{i}"))


def test_names_of_one_identity_are_limited_until_they_have_been_silent():
    clock = Clock()
    forgotten = []
    budget = LogBudget(forgotten.append, clock)
    admit_64_names(budget)
    with pytest.raises(CongraspError, match="More than 64 names of one certificate"):
        budget.admit(Publisher("actor", "1.new"))
    budget.admit(Publisher("actor", "0.a"))
    budget.admit(Publisher("learner", "0"))
    clock.now = 50.0
    budget.admit(Publisher("actor", "1.0"))
    clock.now = 61.0
    budget.admit(Publisher("actor", "1.new"))
    assert forgotten == [Publisher("actor", "1.1")]


def test_bytes_are_limited_by_identity():
    clock = Clock()
    budget = LogBudget(lambda publisher: None, clock)
    for name in ("1.a", "1.b"):
        budget.admit(Publisher("actor", name))
        budget.charge(Publisher("actor", name), 130 << 20)
    with pytest.raises(CongraspError, match="more than 16 MiB of logs a second"):
        budget.admit(Publisher("actor", "1.c"))
    budget.admit(Publisher("actor", "0.a"))
    clock.now = 1.0  # 16 of the 4 MiB that are owed
    budget.admit(Publisher("actor", "1.c"))


def test_a_message_beyond_the_bytes_replaces_no_name():
    clock = Clock()
    forgotten = []
    budget = LogBudget(forgotten.append, clock)
    admit_64_names(budget)
    clock.now = 61.0
    budget.charge(Publisher("actor", "1.0"), 300 << 20)
    with pytest.raises(CongraspError, match="MiB"):
        budget.admit(Publisher("actor", "1.new"))
    assert forgotten == []


def test_silent_identities_are_replaced():
    clock = Clock()
    forgotten = []
    budget = LogBudget(forgotten.append, clock)
    for i in range(1024):
        budget.admit(Publisher("actor", f"{i}.a"))
    budget.charge(Publisher("actor", "1.a"), 1500 << 20)
    with pytest.raises(CongraspError, match="1024"):
        budget.admit(Publisher("actor", "new.a"))
    clock.now = 61.0
    budget.admit(Publisher("actor", "new.a"))
    assert forgotten == [Publisher("actor", "0.a")]
    with pytest.raises(CongraspError, match="1024"):  # the next one still owes bytes
        budget.admit(Publisher("actor", "newer.a"))


def _odd(tmp_path):
    pipe = tmp_path / "pipe.json"
    file = tmp_path / "known.json"
    os.mkfifo(pipe)
    file.write_text(hand_text(get_hand("human")))
    long = ["x" * 300_000, "{" * 100_000]
    texts = ["", *long, "\x1b[31m\n", "\ud800", str(pipe), str(file), "../../x", '{"format": 1}']
    return [None, True, -1, 2**70, 1e300, [], ["human"], {}, {"a": {"b": [None]}}, *texts]


def test_odd_values_in_every_entry_of_every_log_message_are_one_line(tmp_path):
    """Nothing but a CongraspError of one short line, no file is opened (a pipe would wait for
    ever), nothing hangs.
    """
    convert = Converter()
    intact = episode_message()
    messages = {
        "metrics": metrics(loss=1.0),
        "event": Message({}, {"time": 1.0, "level": "info", "text": "x"}),
        "version": Message({}, {"version": 1, "run_id": "e", "schema": "s"}),
        "episode": intact,
        "rollout": Message({"reward": np.zeros((2, 2), np.float32)}, {"actor": "a"}),
    }
    refused = 0
    for (kind, message), odd in itertools.product(messages.items(), _odd(tmp_path)):
        for name in message.meta:
            changed = Message(message.arrays, {**message.meta, name: odd})
            try:
                convert(KEYS.log(kind, "actor", "a"), changed, 10**18)
            except CongraspError as error:
                refused += 1
                assert len(str(error)) < 500, (kind, name, odd)
                assert str(error).isprintable(), (kind, name, odd)
    assert refused > 100


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"object_position": np.zeros((2001, 3))}, "shape"),
        ({"visual_faces": np.array([[0, 1, 10**6]])}, "vertices that do not exist"),
        ({"goal/heading_direction": np.zeros(20_000)}, "more than 10000 values"),
        ({f"reward/{i}": np.zeros(12) for i in range(200)}, "more than 128 rewards"),
        ({"link_position": np.zeros((12, 3, 3), np.float32)}, "has shape"),
        ({"more": np.zeros(3)}, "unknown array 'more'"),
    ],
)
def test_episodes_that_are_none_are_refused(change, why):
    message = episode_message()
    with pytest.raises(CongraspError, match=why):
        Converter()(
            KEYS.log("episode", "actor", "a"),
            Message({**message.arrays, **change}, message.meta),
            10**18,
        )


def test_an_actor_cannot_send_its_episodes_far_ahead_of_time():
    convert = Converter()
    message = episode_message()
    long = Message(message.arrays, {**message.meta, "control_dt": 1.0})  # 12 s
    for _ in range(6):
        assert convert(KEYS.log("episode", "actor", "1.b"), long, 10**18)
    with pytest.raises(CongraspError, match="still playing for 72 s"):
        convert(KEYS.log("episode", "actor", "1.b"), long, 10**18)
    assert convert(KEYS.log("episode", "actor", "0.a"), message, 10**18)


def test_a_live_view_bounds_its_queue(monkeypatch):
    monkeypatch.setattr("congrasp.services.record.live.MAX_QUEUED_BYTES", 1 << 20)
    convert = Converter()
    with LiveServer(0) as server:
        # To be sent in a hundred years
        entries = convert(KEYS.log("episode", "actor", "1.b"), episode_message(), 2**62)
        for _ in range(200):
            for entry in entries:
                server.write(entry)
        assert server.queued_bytes <= 1 << 20
        assert sum(server.left_out.values()) > 0
