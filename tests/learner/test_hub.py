"""The learner's end, over the in-memory transport."""

import functools
import re
import threading
import time

import numpy as np
import pytest

from congrasp.common.errors import CongraspError, RefusedError
from congrasp.common.transport.memory import MemoryTransport
from congrasp.common.wire.codec import Message, encode
from congrasp.learner.hub import hub
from congrasp.learner.hub.admission import Admission
from congrasp.learner.hub.limits import RateLimit
from congrasp.learner.hub.task_ranges import Ranges
from tests.learner.hub_bench import FORM, KEYS, A, B, D, T, bundle, rollout, sequences
from tests.waits import eventually


def test_config_reply(bench):
    reply = bench(config_json='{"name": "x"}').ask(KEYS.config)
    assert reply["config"] == '{"name": "x"}'
    assert reply["run_id"] == "e"
    assert reply["schema"] == "s"
    assert reply["version"] == (-1)
    assert reply["arrays"] == list(FORM.arrays)


def test_no_ticket_or_rollout_before_the_first_weights(bench):
    b = bench()
    assert not b.ticket()["granted"]
    assert b.send()["outcome"] == "retry"
    assert b.peer.query(KEYS.weights, Message(meta={"newer_than": -1}), timeout=60).arrays == {}
    b.hub.publish_weights(bundle(0), 0)
    assert b.ticket()["granted"]
    assert b.send()["outcome"] == "accepted"


def test_tickets_are_limited_and_returnable(bench):
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


def test_tickets_of_a_dead_actor_return(bench):
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


def test_batches_are_in_order_and_waited_for(bench):
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


def test_a_full_learner_defers_rollouts(bench):
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


def test_stale_rollouts_are_refused_or_dropped_from_the_queue(bench):
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


def test_requests_for_another_actor_are_refused(bench):
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


def test_an_actor_cannot_displace_sequences_of_another(bench):
    b = bench(version=9)
    assert b.send(0, version=9, actor="0.a")["outcome"] == "accepted"
    for i in range(1100):  # more starts of an actor than are remembered
        assert b.send(0, actor=f"1.{i % 7}", incarnation=f"{i}")["outcome"] == "stale"
    assert b.send(0, version=9, actor="0.a")["outcome"] == "duplicate"


def test_floods_are_rejected_at_no_cost_to_others(bench, monkeypatch):
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


def test_repeated_refusals_are_deferred_and_counted(bench):
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


def test_values_outside_the_tasks_ranges_are_refused(bench):
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


def test_thousands_of_tokens_are_not_listed(bench):
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
    events_received = 0
    while events.receive(0.05):
        events_received += 1
    assert events_received == 64  # one for each that was listed


def test_a_refused_rollout_redeems_its_ticket(bench):
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


def test_status_lists_queue_roles_and_rates(bench):
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


def test_a_finished_run_grants_and_accepts_nothing(bench):
    b = bench(version=0)
    notices = b.peer.subscribe(KEYS.announcement, depth=4)
    b.hub.finish()
    assert notices.receive(60)[1].meta["finished"]
    reply = b.ticket()
    assert reply["finished"]
    assert not reply["granted"]
    assert b.send(0)["outcome"] == "stale"
    assert b.ledger()["queued"] == 0
