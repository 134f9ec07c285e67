"""The learner's end, over the in-memory transport."""

import functools
import os
import re
import threading
import time

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from congrasp.common.errors import CongraspError, RefusedError
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import Message, encode
from congrasp.common.wire.messages import RolloutForm
from congrasp.learner.hub import hub
from congrasp.learner.hub.admission import Admission
from congrasp.learner.hub.limits import RateLimit
from congrasp.learner.hub.queue import Sequences
from congrasp.learner.hub.staleness import StalenessManager
from congrasp.learner.hub.task_ranges import Ranges
from congrasp.learner.hub.write_ahead import PART, WriteAheadLog
from tests import rollouts
from tests.waits import eventually

KEYS = Keys("test")
T = 3
B = 2
D = 5
A = 4
FORM = RolloutForm(T, B, D, A, half=True)


def rollout(sequence=0, version=0, **meta):
    arrays = {**FORM.zeros(), "reward": np.full((T, B), sequence, np.float32)}
    header = {
        "actor": "a",
        "incarnation": "01",
        "sequence": sequence,
        "version": version,
        "run_id": "e",
        "schema": "s",
    }
    return Message(arrays, {**header, "steps": T * B, **meta})


bundle = functools.partial(rollouts.bundle, form=FORM)


class Bench:
    """A hub, which has published weights where a version is given, and a peer of it."""

    def __init__(self, *, version=None, max_staleness=1, batch=2, **options):
        self.memory = MemoryHub()
        self.server = MemoryTransport(self.memory)
        self.peer = MemoryTransport(self.memory)
        self.staleness = StalenessManager(max_staleness, batch)
        self.hub, self.rollouts = rollouts.learner_hub(
            self.server, "test", form=FORM, staleness=self.staleness, **options
        )
        if version is not None:
            self.hub.publish_weights(bundle(version), version)

    def ask(self, key, meta=None, arrays=None):
        return self.peer.query(key, Message(arrays or {}, meta or {}), timeout=60).meta

    def send(self, *args, **options):
        message = rollout(*args, **options)
        return self.peer.query(KEYS.rollout(message.meta["actor"]), message, timeout=60).meta

    def ticket(self, name="t", **meta):
        return self.ask(
            KEYS.ticket("a"), {"actor": "a", "incarnation": "01", "ticket": name, **meta}
        )

    def ledger(self):
        return self.ask(KEYS.status)["counters"]


@pytest.fixture
def bench():
    benches = []

    def make(**options):
        benches.append(Bench(**options))
        return benches[-1]

    yield make
    for one in benches:
        one.peer.close()
        one.server.close()


def sequences(batch):
    return [message.meta["sequence"] for message in batch]


def test_config(bench):
    reply = bench(config_json='{"name": "x"}').ask(KEYS.config)
    assert reply["config"] == '{"name": "x"}'
    assert reply["run_id"] == "e"
    assert reply["schema"] == "s"
    assert reply["version"] == (-1)
    assert reply["arrays"] == list(FORM.arrays)


def test_nothing_is_granted_or_taken_before_the_first_weights(bench):
    b = bench()
    assert not b.ticket()["granted"]
    assert b.send()["outcome"] == "retry"
    assert b.peer.query(KEYS.weights, Message(meta={"newer_than": -1}), timeout=60).arrays == {}
    b.hub.publish_weights(bundle(0), 0)
    assert b.ticket()["granted"]
    assert b.send()["outcome"] == "accepted"


def test_tickets_run_out_and_return(bench):
    b = bench(version=0, max_staleness=0, batch=1)
    assert b.ticket("t")["granted"]
    assert b.ticket("t")["granted"]
    assert b.rollouts.decided(("a", "01")).granted == 1
    assert not b.ticket("u")["granted"]
    b.ticket("t", give_back=True)
    assert b.ticket("u")["granted"]
    with pytest.raises(RefusedError, match="'ticket' is 7, not str"):
        b.ticket(7)
    with pytest.raises(RefusedError, match="name of an actor"):
        b.ask(KEYS.ticket("a"), {"actor": "*", "incarnation": "1", "ticket": "t"})


def test_death_returns_tickets_and_is_told(bench):
    logged = []
    b = bench(version=0, max_staleness=0, batch=1, on_event=lambda *event: logged.append(event))
    events = b.peer.subscribe(KEYS.logs, depth=8)
    actor = MemoryTransport(b.memory)
    actor.declare_alive(KEYS.alive("actor", "a", "01"))
    assert b.ticket()["granted"]
    assert _roles(b) == {("learner", "0"), ("actor", "a")}
    actor.close()
    key, event = events.receive(60)
    assert key == KEYS.log("event", "learner", "0")
    assert event.meta["text"] == "The actor a left; 1 of its tickets returned."
    assert logged == [("info", event.meta["text"])]
    assert b.ledger()["returned"] == 1
    assert b.ticket("u")["granted"]
    assert _roles(b) == {("learner", "0")}


def _roles(b):
    time.sleep(0.05)
    return {(role["role"], role["id"]) for role in b.ask(KEYS.status)["roles"]}


def test_batches_come_in_order_and_wait(bench):
    b = bench(version=0)
    assert b.rollouts.next_batch(2, 0.05) is None
    assert b.send(0)["outcome"] == b.send(1)["outcome"] == b.send(2)["outcome"] == "accepted"
    batch = b.rollouts.next_batch(2, 1)
    assert sequences(batch) == [0, 1]
    np.testing.assert_array_equal(batch[1].arrays["reward"], np.ones((T, B), np.float32))
    assert b.rollouts.next_batch(2, 0.05) is None
    threading.Timer(0.1, b.send, [3]).start()
    assert sequences(b.rollouts.next_batch(2, 10)) == [2, 3]
    assert b.ledger() | {"capacity": 0} == {
        "granted": 0,
        "redeemed": 0,
        "returned": 0,
        "expired": 0,
        "accepted": 4,
        "consumed": 4,
        "dropped": 0,
        "stale": 0,
        "duplicate": 0,
        "damaged": 0,
        "undone": 0,
        "running": 0,
        "queued": 0,
        "capacity": 0,
        "missing": 0,
        "rejected": 0,
    }


def test_full_learner_says_when_to_come_again(bench):
    b = bench(version=0, batch=1)
    assert [b.send(i)["outcome"] for i in range(2)] == ["accepted"] * 2
    reply = b.send(2)
    assert reply["outcome"] == "retry"
    assert reply["retry_after"] > 0
    assert b.rollouts.next_batch(1, 1)
    b.hub.publish_weights(bundle(1), 1)
    assert b.send(2)["outcome"] == "accepted"
    limited = bench(version=0, batch=10, limit=1)
    assert [limited.send(i)["outcome"] for i in range(2)] == ["accepted", "retry"]


def test_too_old_is_refused_on_arrival_and_dropped_in_the_queue(bench):
    b = bench()
    events = b.peer.subscribe(KEYS.logs, depth=8)
    b.hub.publish_weights(bundle(0), 0)
    b.send(0, version=0)
    b.hub.publish_weights(bundle(1), 1)
    b.send(1, version=1)
    b.hub.publish_weights(bundle(2), 2)
    reply = b.send(2, version=0)
    assert reply["outcome"] == "stale"
    assert "version 0" in reply["why"]
    assert "at 2" in reply["why"]
    assert b.send(3, version=3)["outcome"] == "stale"
    assert b.send(4, run_id="other")["outcome"] == "stale"
    b.send(5, version=2)
    assert sequences(b.rollouts.next_batch(2, 1)) == [1, 5]
    texts = [events.receive(60)[1].meta["text"] for _ in range(2)]
    assert "refused" in texts[0]
    assert texts[1] == "Dropped as too old at version 2: 1 of a."
    ledger = b.ledger()
    assert ledger["stale"] == 3
    assert ledger["dropped"] == 1
    assert ledger["consumed"] == 2
    assert ledger["accepted"] == 3


def test_nobody_speaks_for_another(bench):
    b = bench(version=0)
    assert b.ticket("t")["granted"]
    request = {"actor": "a", "incarnation": "01", "ticket": "t", "give_back": True}
    with pytest.raises(RefusedError, match=r"Actor 'a' published on .*/ticket/b'"):
        b.ask(KEYS.ticket("b"), request)
    reply = b.peer.query(KEYS.rollout("b"), rollout(), timeout=60).meta
    assert reply["outcome"] == "refused"
    assert "the key of another actor" in reply["why"]
    ledger = b.ledger()
    # A's ticket is still a's
    assert ledger["running"] == 1
    assert ledger["damaged"] == 1
    assert ledger["accepted"] == 0


def test_nobody_makes_the_learner_forget_what_another_sent(bench):
    b = bench(version=9)
    assert b.send(0, version=9, actor="0.a")["outcome"] == "accepted"
    for i in range(1100):  # more starts of an actor than are remembered
        assert b.send(0, actor=f"1.{i % 7}", incarnation=f"{i}")["outcome"] == "stale"
    assert b.send(0, version=9, actor="0.a")["outcome"] == "duplicate"


def test_floods_are_rejected_and_cost_the_others_nothing(bench, monkeypatch):
    # No token returns
    monkeypatch.setattr(hub, "RateLimit", functools.partial(RateLimit, clock=lambda: 0.0))
    b = bench(version=0)
    events = b.peer.subscribe(KEYS.logs, depth=8)
    outcomes = [
        b.send(0, actor="1.b", run_id="of another training")["outcome"] for _ in range(2500)
    ]
    stale = outcomes.count("stale")
    assert outcomes == ["stale"] * stale + ["retry"] * (2500 - stale)
    assert 1990 <= stale <= 2000
    reply = b.ask(KEYS.ticket("1.c"), {"actor": "1.c", "incarnation": "01", "ticket": "t"})
    assert not reply["granted"]
    assert reply["retry_after"] > 0
    assert b.ticket()["granted"]
    assert b.send(0)["outcome"] == "accepted"
    ledger = b.ledger()
    assert ledger["rejected"] == 2500 - stale + 1
    assert ledger["stale"] == stale
    texts = []
    while received := events.receive(0.1):
        texts.append(received[1].meta["text"])
    assert any("useless requests of 1.b" in text for text in texts)


def test_who_is_refused_again_and_again_is_put_off_and_counted(bench):
    b = bench(version=0)
    b.peer.declare_alive(KEYS.alive("actor", "1.b", "01"))
    answers = [b.send(0, actor="1.b", steps=1) for _ in range(4)]
    assert [answer["outcome"] for answer in answers] == ["refused", "refused", "retry", "retry"]
    assert 0.5 < answers[-1]["retry_after"] <= 1.0
    reply = b.ask(KEYS.ticket("1.c"), {"actor": "1.c", "incarnation": "01", "ticket": "t"})
    # Another name of the same certificate
    assert not reply["granted"]
    assert reply["retry_after"] > 0.5
    assert b.ticket()["granted"]
    assert b.send(0)["outcome"] == "accepted"
    time.sleep(1.0)
    assert b.send(0, actor="1.b", steps=1)["outcome"] == "refused"
    assert 1.5 < b.send(0, actor="1.b", steps=1)["retry_after"] <= 2.0
    (role,) = [role for role in b.ask(KEYS.status)["roles"] if role["id"] == "1.b"]
    assert role["refused"] == 3
    assert b.ledger()["damaged"] == 3


def test_values_beyond_the_task_are_refused_with_the_range(bench):
    ranges = Ranges(
        np.array([1.0, 1.0, 1.0, 400.0, 2.0]), 65.0, 1e3, {"episode/success": (0.0, 1.0)}
    )
    b = bench(version=0, admission=Admission(lambda: ranges))
    fine = {
        "observation": np.tile(np.float16([-1, 1, 0, 400, 2]), (T, B, 1)),
        "reward": np.full((T, B), -65, np.float32),
        "action": np.full((T, B, A), 1e3, np.float32),
        "episode/success": np.ones(1, np.float32),
    }
    beyond = {
        "observation": (
            np.tile(np.float16([0, 0, 0, 400, 2.002]), (T, B, 1)),
            r"'observation\[4\]' holds 2.002",
        ),
        "last_observation": (
            np.full((B, D), -65504, np.float16),
            r"'last_observation\[0\]' holds 6.55e\+04",
        ),
        "reward": (
            np.full((T, B), 1e19, np.float32),
            r"'reward' holds 1e\+19, which is not within the task's limits -65 and 65",
        ),
        "action": (np.full((T, B, A), -3e38, np.float32), r"'action' holds -3e\+38"),
        "log_probability": (np.full((T, B), 100, np.float32), "'log_probability' holds 100"),
        "episode/success": (np.full(1, 1.5, np.float32), "'episode/success' holds 1.5"),
        "episode/made_up": (np.ones(1, np.float32), "'episode/made_up', which is not a metric"),
    }
    for number, (name, (array, why)) in enumerate(beyond.items()):
        good = rollout(0, actor=f"{number}.x")
        bad = Message({**good.arrays, name: array}, good.meta)
        reply = b.peer.query(KEYS.rollout(f"{number}.x"), bad, timeout=60).meta
        assert reply["outcome"] == "refused", reply["why"]
        assert re.search(why, reply["why"]), reply["why"]
    good = rollout(0)
    assert b.peer.query(
        KEYS.rollout("a"), Message({**good.arrays, **fine}, good.meta), timeout=60
    ).meta["outcome"] == ("accepted")


def test_tokens_by_the_thousand_cost_the_others_nothing(bench):
    b = bench()
    events = b.peer.subscribe(KEYS.logs, depth=1000)
    b.peer.declare_alive(KEYS.alive("actor", "0.a", "01"))
    flood = MemoryTransport(b.memory)
    for i in range(3000):
        flood.declare_alive(KEYS.alive("actor", f"1.{i}", "01"))
    eventually(lambda: b.ask(KEYS.status)["unlisted"] == 3000 - 64)
    status = b.ask(KEYS.status)
    names = [role["id"] for role in status["roles"]]
    assert status["unlisted"] == 3000 - 64
    assert len(names) == 66
    assert "0.a" in names
    assert len(encode(Message(meta=status))) < 32_000
    flood.close()
    eventually(lambda: not b.ask(KEYS.status)["unlisted"])
    assert [role["id"] for role in b.ask(KEYS.status)["roles"] if role["role"] == "actor"] == [
        "0.a"
    ]
    told = 0
    while events.receive(0.05):
        told += 1
    assert told == 64  # one for each that was listed


def test_refusal_ends_the_ticket(bench):
    b = bench(version=0)
    assert b.ticket("t")["granted"]
    assert b.send(0, ticket="t", steps=1)["outcome"] == "refused"
    assert b.ledger()["running"] == 0
    assert b.ledger()["redeemed"] == 1


def test_weights_are_pulled_by_version(bench):
    b = bench()
    notices = b.peer.subscribe(KEYS.announcement, depth=4)
    b.hub.publish_weights(bundle(0), 0)
    assert notices.receive(60)[1].meta == {
        "version": 0,
        "run_id": "e",
        "session_id": b.rollouts.session_id,
        "finished": False,
    }
    pulled = b.peer.query(KEYS.weights, Message(meta={"newer_than": -1}), timeout=60)
    assert pulled.meta == bundle(0).meta
    assert pulled.arrays["actor/w"][0] == 0
    assert b.ask(KEYS.weights, {"newer_than": 0})["version"] == 0
    assert not b.peer.query(KEYS.weights, Message(meta={"newer_than": 0}), timeout=60).arrays
    b.hub.publish_weights(bundle(1), 1)
    assert (
        b.peer.query(KEYS.weights, Message(meta={"newer_than": 0}), timeout=60).meta["version"] == 1
    )
    # A learner that resumed from a checkpoint has an older version, or another one of the same
    # number.
    assert (
        b.peer.query(KEYS.weights, Message(meta={"newer_than": 7}), timeout=60).meta["version"] == 1
    )
    assert b.peer.query(
        KEYS.weights, Message(meta={"newer_than": 1, "session_id": "before"}), timeout=60
    ).arrays


def test_only_weights_of_this_run_are_published(bench):
    b = bench()
    with pytest.raises(CongraspError, match="not version 1 of run id e"):
        b.hub.publish_weights(bundle(0), 1)
    with pytest.raises(CongraspError, match="run id"):
        b.hub.publish_weights(bundle(0, run_id="other"), 0)
    bad = bundle(0)
    with pytest.raises(CongraspError, match="not finite"):
        b.hub.publish_weights(Message({**bad.arrays, "actor/w": np.full(3, np.nan)}, bad.meta), 0)
    assert b.ask(KEYS.config)["version"] == -1


def test_status_names_everything(bench):
    b = bench(version=0)
    b.peer.declare_alive(KEYS.alive("actor", "a", "01"))
    b.send(0)
    time.sleep(0.05)
    status = b.ask(KEYS.status)
    assert status["run"] == "test"
    assert status["version"] == 0
    assert status["queue"] == {"length": 1, "limit": 64}
    rates = {"rollouts_per_second": 1.0, "steps_per_second": T * B}
    assert {
        "role": "actor",
        "id": "a",
        "incarnation": "01",
        "rollouts": 1,
        "version": 0,
        "lag": 0,
        "refused": 0,
        **rates,
    } in status["roles"]
    assert status["rates"] == rates


def test_finished_run_says_so(bench):
    b = bench(version=0)
    notices = b.peer.subscribe(KEYS.announcement, depth=4)
    b.hub.finish()
    assert notices.receive(60)[1].meta["finished"]
    reply = b.ticket()
    assert reply["finished"]
    assert not reply["granted"]
    assert b.send(0)["outcome"] == "stale"
    assert b.ledger()["queued"] == 0


def test_resumed_hub_knows_what_was_learnt_and_counts_what_was_undone(bench):
    b = bench(version=3, batch=3)
    for i in range(5):
        assert b.send(i, version=3)["outcome"] == "accepted"
    assert sequences(b.rollouts.next_batch(3, 1)) == [0, 1, 2]  # 3 and 4 wait
    b.hub.publish_weights(bundle(4), 4)
    durable = b.rollouts.durable()
    assert b.send(5, version=4)["outcome"] == "accepted"  # and then the learner is killed

    resumed = bench(batch=3, durable=durable)
    assert resumed.send(2, version=4)["outcome"] == "retry"  # its weights are not there yet
    resumed.hub.publish_weights(bundle(4), 4)
    assert resumed.rollouts.session_id != b.rollouts.session_id
    assert resumed.ledger()["accepted"] == resumed.ledger()["consumed"] == 3
    assert resumed.send(2, version=3)["outcome"] == "duplicate"
    # The actor goes on where it was: 3, 4 and 5 were acknowledged, and are gone with the killed
    # learner.
    assert resumed.send(7, version=4)["outcome"] == "accepted"
    assert resumed.send(6, version=4)["outcome"] == "accepted"
    assert resumed.send(6, version=4)["outcome"] == "duplicate"
    ledger = resumed.ledger()
    assert ledger["accepted"] == 5
    assert ledger["consumed"] == 3
    assert ledger["queued"] == 2
    assert ledger["missing"] == 3
    again = bench(version=5, batch=3, durable=resumed.rollouts.durable())
    assert again.send(8, version=5)["outcome"] == "accepted"
    # 6 and 7 were waiting as well
    assert again.ledger()["missing"] == 5
    assert again.ledger()["accepted"] == 4
    with pytest.raises(CongraspError, match="run id e, not f"):
        bench(run_id="f", durable=durable)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 40), st.booleans()), max_size=120))
def test_deduplication_is_exact_within_its_window(arrivals):
    decisions = Sequences()
    decided = {}
    for sequence, accepted in arrivals:
        assert (sequence in decisions) == (sequence in decided)
        assert (sequence in decisions.refused) == (decided.get(sequence) is False)
        if sequence not in decided:
            decisions.add(_header(sequence), accepted)
            decided[sequence] = accepted
        assert decisions.missing == max(decided) + 1 - len(decided)
    assert decisions.rollouts == sum(decided.values())


def test_deduplication_stays_small_whatever_is_missing():
    decisions = Sequences(granted=20_000)
    for sequence in range(1, 20_000, 2):
        decisions.add(_header(sequence), sequence % 3 > 0)
        assert len(decisions.ahead) <= 64
        assert len(decisions.refused) <= 64
    assert 19_999 in decisions
    assert 20_001 not in decisions
    assert decisions.missing == 10_000


def test_made_up_sequence_numbers_do_not_blow_up_what_is_missing(bench):
    b = bench(version=0, batch=100)
    assert b.send(0, version=0)["outcome"] == "accepted"
    made_up = [number * 10**12 for number in range(1, 71)]
    for sequence in made_up:
        assert b.send(sequence, version=7)["outcome"] == "stale"  # of a version that there will be
    assert b.ledger()["missing"] <= 64 + 71  # what may overtake, and tickets
    assert b.send(made_up[-1], version=0)["outcome"] == "stale"  # still
    # Whose size is bounded though sequence 0 waits
    resumed = bench(batch=100, durable=b.rollouts.durable())
    assert resumed.ledger()["missing"] <= 2 * 64 + 71


def test_what_a_killed_learner_decided_after_its_checkpoint_is_missing(bench):
    b = bench(version=5, batch=2)
    assert b.send(0, version=0)["outcome"] == "stale"
    assert b.send(2, version=5)["outcome"] == b.send(3, version=5)["outcome"] == "accepted"
    assert sequences(b.rollouts.next_batch(2, 1)) == [2, 3]
    b.hub.publish_weights(bundle(6), 6)
    assert b.ledger()["missing"] == 1
    durable = b.rollouts.durable()
    # Overtaken by 2 and 3, and lost with this learner
    assert b.send(1, version=6)["outcome"] == "accepted"
    assert b.ledger()["missing"] == 0
    resumed = bench(version=6, batch=2, durable=durable)
    assert resumed.send(0, version=6)["outcome"] == "stale"  # as before
    assert resumed.send(4, version=6)["outcome"] == "accepted"
    ledger = resumed.ledger()
    assert ledger["consumed"] == 2
    assert ledger["queued"] == 1
    assert ledger["stale"] == 1
    assert ledger["missing"] == 1


def _header(sequence):
    from congrasp.common.wire.messages import RolloutHeader

    return RolloutHeader("a", "01", sequence, 0, "e", "s", 1)


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "log"


@pytest.fixture
def log(folder):
    return functools.partial(WriteAheadLog, folder, 1)


def on_disk(folder):
    """Sequences of the rollouts on disk, in the order of their acceptance."""
    return [int(path.stem.split("~")[3]) for path in sorted(folder.glob("*.safetensors"))]


def test_a_resumed_learner_takes_up_what_was_accepted_and_uses_the_oldest_first(bench, log, folder):
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


def test_the_log_keeps_what_waits_at_a_checkpoint_and_nothing_else(bench, log, folder):
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


def test_nothing_is_acknowledged_before_it_is_written(bench, log, folder):
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


def test_a_batch_that_nothing_can_be_learnt_from_is_not_taken_up_again(bench, log, folder):
    b = bench(version=0, log=log())
    for i in range(3):
        b.send(i)
    b.rollouts.discard(b.rollouts.next_batch(2, 1))
    assert on_disk(folder) == [2]


def test_a_resume_tells_damaged_torn_and_strange_files_apart(bench, log, folder):
    logged = []
    b = bench(version=0, log=log())
    for i in range(4):
        assert b.send(i)["outcome"] == "accepted"
    damaged, renamed = sorted(folder.iterdir())[1:3]
    damaged.write_bytes(damaged.read_bytes()[:-3] + b"xyz")
    renamed.rename(folder / renamed.name.replace("~2.", "~9."))
    (folder / f"000000000009~a~01~5.safetensors{PART}").write_bytes(
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


def test_without_a_log_nothing_is_written_but_what_is_there_is_taken_up(bench, log, folder):
    b = bench(version=0, log=log())
    b.send(0)
    resumed = bench(version=1, log=log(write=False))
    assert resumed.send(1, version=1)["outcome"] == "accepted"
    assert on_disk(folder) == [0]
    assert sequences(resumed.rollouts.next_batch(2, 1)) == [0, 1]


def test_a_disk_that_refuses_is_said_once_and_training_goes_on(bench, tmp_path):
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
