"""The link between real processes over Zenoh, which are killed, stopped and lied to (`tests/cluster.py`)."""

import os
import random
import signal
import time

import numpy as np
import pytest

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.wire.codec import Message, encode
from tests.cluster import KEYS, A, B, D, T, assert_books_balance, rollout

pytestmark = pytest.mark.timeout(300)


def actors(status):
    return {role["incarnation"] for role in status["roles"] if role["role"] == "actor"}


def test_actor_killed_while_it_uploads_leaves_nothing_behind(cluster):
    cluster.options["steps"] = 2000  # a rollout has about 2.8 MB, and one is always on its way
    learner = cluster.start_learner()
    for _ in range(2):
        actor = cluster.start_actor()
        before = cluster.wait(lambda status: len(actors(status)) == 1)["counters"]["accepted"]
        cluster.wait(lambda status, before=before: status["counters"]["accepted"] >= before + 4)
        time.sleep(random.uniform(0, 0.05))
        actor.send_signal(signal.SIGKILL)
        status = cluster.wait(lambda status: not actors(status))
        assert status["counters"]["running"] == 0
    assert cluster.status()["counters"]["damaged"] == 0
    final, _ = cluster.stop(learner)
    assert_books_balance(final)
    history = {tuple(identity[1:]) for identity in final["history"]}
    acknowledged = {
        (entry["incarnation"], entry["sequence"]) for entry in cluster.outcomes() if entry["outcome"] == "accepted"
    }
    # All that was acknowledged was learnt from, or waited at the end.
    assert len(acknowledged - history) <= final["counters"]["queued"] + final["counters"]["dropped"]
    assert len({incarnation for incarnation, _ in history}) == 2


def test_learner_started_from_scratch_makes_actors_start_over(cluster):
    learner = cluster.start_learner(run_id="e")
    actor = cluster.start_actor()
    cluster.wait(lambda status: status["version"] >= 3)
    learner.send_signal(signal.SIGKILL)
    learner.wait(5)
    cluster.checkpoint.unlink()
    learner = cluster.start_learner(run_id="f")
    cluster.wait(lambda status: status["version"] >= 3 and status["run_id"] == "f")
    final, _ = cluster.stop(learner)
    assert actor.wait(10) == 0
    assert_books_balance(final)
    assert {"restarted": "f"} in cluster.outcomes()


def test_stopped_actor_is_noticed_and_comes_back(cluster):
    learner = cluster.start_learner()
    actor = cluster.start_actor()
    cluster.wait(lambda status: status["counters"]["accepted"] >= 4)
    actor.send_signal(signal.SIGSTOP)
    status = cluster.wait(lambda status: not actors(status))
    assert status["counters"]["running"] == 0
    actor.send_signal(signal.SIGCONT)
    accepted = status["counters"]["accepted"]
    cluster.wait(lambda status: actors(status) and status["counters"]["accepted"] >= accepted + 4)
    assert_books_balance(cluster.stop(learner)[0])
    assert actor.wait(10) == 0


def test_hostile_messages_harm_nobody_else(cluster):
    learner = cluster.start_learner()
    cluster.start_actor()
    cluster.wait(lambda status: status["counters"]["accepted"] >= 2)
    header = {"actor": "evil", "incarnation": "66", "sequence": 0, "run_id": "e", "ticket": "x"}

    def evil(arrays=None, **meta):
        good = rollout(T, 0, cluster.status()["version"])
        return Message({**good.arrays, **(arrays or {})}, {**good.meta, **header, **meta})

    refused = [
        evil({"reward": np.full((T, B), np.nan, np.float32)}),
        evil({"observation": np.full((T, B, D), np.inf, np.float16)}),
        evil({"action": np.zeros((T, B, A + 1), np.float32)}),
        evil({"optimizer": np.zeros(3)}),
        evil(schema="other"),
        evil(rollout(T + 1, 0, 0).arrays, steps=(T + 1) * B),
        evil(steps=10**9),
        evil(sequence=-1),
        evil(actor="../../x"),
        Message(),
    ]
    for number, message in enumerate(refused):  # whoever is refused again and again is put off: each has a name
        name, meta = f"evil{number}", dict(message.meta)
        meta |= {"actor": name} if meta.get("actor") == "evil" else {}
        answer = cluster.observer.query(KEYS.rollout(name), Message(message.arrays, meta), timeout=5)
        assert answer.meta["outcome"] == "refused"
    session = cluster.observer._session(KEYS.rollout("evil"))
    whole = encode(evil())
    damaged = [b"", b"\xff" * 64, whole[:-7], whole[:-1] + b"\x01", (1 << 40).to_bytes(8, "little") + whole[8:]]
    for payload in damaged:
        reply = next(iter(session.get(KEYS.rollout("evil"), payload=payload, timeout=5.0)))
        assert reply.err is not None
    for key in (KEYS.ticket("evil"), KEYS.config, KEYS.weights, KEYS.status):
        list(cluster.observer._session(key).get(key, payload=os.urandom(100), timeout=5.0))
    with pytest.raises(CongraspError, match="ticket request"):
        cluster.observer.query(KEYS.ticket("evil"), Message(meta={"actor": 1}), timeout=5)
    with pytest.raises(TransportError, match="No response"):
        cluster.observer.query("congrasp/other/rollout", evil(), timeout=5)
    with pytest.raises(TransportError, match="No response"):
        cluster.observer.query("congrasp/chaos/shutdown", Message(), timeout=5)
    replayed = cluster.observer.query(KEYS.rollout("evil"), evil(version=10**6), timeout=5).meta
    assert replayed["outcome"] == "stale"
    ledger = cluster.status()["counters"]
    assert ledger["damaged"] == len(refused) + len(damaged)
    cluster.wait(lambda status: status["counters"]["accepted"] >= ledger["accepted"] + 4)
    final, _ = cluster.stop(learner)
    assert_books_balance(final)
    assert {identity[0] for identity in final["history"]} == {"a"}
