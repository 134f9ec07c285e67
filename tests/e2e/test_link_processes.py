"""The link between real processes over Zenoh, which are killed, stopped and lied to.

Run as a script, this file is the learner or the actor of its own tests. The "policy" is a version number, an "update"
consumes two rollouts, and every rollout carries its sequence number in all its values, so that a torn one shows.
"""

import contextlib
import json
import os
import pathlib
import random
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from actors.link import ActorLink, RunFinished, RunRestarted
from common.errors import CongraspError, TransportError
from common.transport.keys import Keys
from common.transport.zenoh_transport import ZenohTransport
from common.wire.codec import Message, encode
from common.wire.messages import RolloutForm
from learner.hub import LearnerHub
from learner.staleness import StalenessManager

pytestmark = pytest.mark.timeout(60)
ROOT = pathlib.Path(__file__).resolve().parents[2]
KEYS = Keys("chaos")
T, B, D, A = 20, 16, 32, 4
BATCH = 2


def bundle(version, epoch):
    arrays = {f"{kind}/{name}": np.zeros(shape) for kind, shape in (("observation", D), ("value", ()))
              for name in ("mean", "m2")}  # fmt: skip
    arrays |= {"observation/count": np.zeros(()), "value/count": np.zeros(()), "actor/w": np.zeros(1000, np.float32)}
    meta = {"version": version, "epoch": epoch, "schema": "s", "hand": "human", "layout": [], "action_size": A}
    return Message(arrays, {**meta, "format": 1})


def rollout(steps, value, version):
    arrays = {
        "observation": np.full((steps, B, D), value, np.float16),
        "action": np.full((steps, B, A), value, np.float32),
        "log_probability": np.full((steps, B), value, np.float32),
        "reward": np.full((steps, B), value, np.float32),
        "terminal": np.zeros((steps, B), bool),
        "last_observation": np.full((B, D), value, np.float16),
    }
    return Message(arrays, {"version": version, "schema": "s", "steps": steps * B})


# --- the two roles ---


def run_learner(endpoint, epoch, checkpoint, steps):
    """Consumes batches and checkpoints after each, until it is told to stop (SIGTERM) or killed."""
    path = pathlib.Path(checkpoint)
    saved = json.loads(path.read_text()) if path.exists() else {"durable": None, "history": [], "version": 0}
    history, version = saved["history"], saved["version"]
    stopped = []
    signal.signal(signal.SIGTERM, lambda *_: stopped.append(True))
    with ZenohTransport(listen=[endpoint], max_message=64 << 20) as transport:
        hub = LearnerHub(
            transport, run="chaos", config_json="{}", epoch=epoch, schema="s",
            form=RolloutForm(int(steps), B, D, A, half=True), staleness=StalenessManager(1, BATCH),
            durable=saved["durable"],
        )  # fmt: skip
        hub.publish_weights(bundle(version, epoch), version)
        print("ready", flush=True)
        while not stopped:
            batch = hub.next_batch(BATCH, 0.1)
            if batch is None:
                continue
            for message in batch:
                expected = message.meta["sequence"] % 1000
                for name, array in message.arrays.items():
                    assert name == "terminal" or (array == expected).all(), f"torn: {name}"
                history.append([message.meta[name] for name in ("actor", "incarnation", "sequence")])
            version += 1
            hub.publish_weights(bundle(version, epoch), version)
            save(path, {"durable": hub.durable(), "history": history, "version": version})
        hub.finish()
        time.sleep(0.5)  # actors hear of it; what is on its way still comes in
        final = {"history": history, "ledger": hub.status()["ledger"], "durable": None, "version": version}
        save(path.with_suffix(".final"), final)


def save(path, content):
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(content))
    os.replace(temporary, path)


def run_actor(endpoint, name, steps, record):
    """Makes rollouts until the run is finished; writes each outcome down."""
    with (
        open(record, "a", buffering=1) as log,
        ZenohTransport(connect=[endpoint], flows=["control", "bulk", "log"], max_message=64 << 20) as transport,
        ActorLink(transport, "chaos", name, window=2, request_timeout=3.0) as link,
    ):
        made = []
        with contextlib.suppress(RunFinished):
            while True:
                try:
                    work(link, int(steps), made, log)
                except RunRestarted:
                    log.write(json.dumps({"restarted": link.config(20).epoch}) + "\n")
        link.flush(5)


def work(link, steps, made, log):
    link.config(20)
    version = -1
    while True:
        ticket = link.acquire_ticket(1.0)
        if ticket is None:
            continue
        pulled = link.weights(version)
        version = pulled.meta["version"] if pulled else version
        future = link.upload(rollout(steps, len(made) % 1000, version), ticket)
        entry = {"incarnation": link.incarnation, "sequence": len(made)}
        made.append(future)
        future.add_done_callback(
            lambda f, entry=entry: log.write(json.dumps({**entry, "outcome": outcome_of(f)}) + "\n")
        )


def outcome_of(future):
    error = future.exception()
    return "unknown" if error else future.result()


# --- the tests ---


class Cluster:
    """Processes of one test, and a look at the learner from outside."""

    def __init__(self, folder):
        self.folder = folder
        self.endpoint = f"tcp/127.0.0.1:{base_port()}"
        self.checkpoint = folder / "checkpoint"
        self.steps = T
        self.processes = []
        self.observer = None

    def start(self, role, *arguments):
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(
            [sys.executable, __file__, role, self.endpoint, *map(str, arguments)],
            env=environment, stdout=subprocess.PIPE, stderr=(self.folder / f"{role}.err").open("ab"),
        )  # fmt: skip
        self.processes.append(process)
        return process

    def start_learner(self, epoch="e"):
        process = self.start("learner", epoch, self.checkpoint, self.steps)
        assert process.stdout.readline() == b"ready\n", (self.folder / "learner.err").read_text()
        if self.observer is None:
            self.observer = ZenohTransport(connect=[self.endpoint], max_message=64 << 20)
        return process

    def start_actor(self, name="a"):
        return self.start("actor", name, self.steps, self.folder / f"{name}.log")

    def status(self):
        try:
            return self.observer.query(KEYS.status, Message(), timeout=2).meta
        except TransportError:
            return None

    def wait(self, condition, timeout=15.0):
        """Polls the learner's status until it is as wanted."""
        deadline = time.monotonic() + timeout
        while True:
            status = self.status()
            if status and condition(status):
                return status
            errors = "".join(path.read_text() for path in self.folder.glob("*.err"))
            assert time.monotonic() < deadline, f"not in time: {status} {errors}"
            time.sleep(0.02)

    def outcomes(self, name="a"):
        return [json.loads(line) for line in (self.folder / f"{name}.log").read_text().splitlines()]

    def stop(self, learner):
        """Ends the learner gently; returns what it found in its books."""
        learner.terminate()
        assert learner.wait(10) == 0, (self.folder / "learner.err").read_text()
        return json.loads(self.checkpoint.with_suffix(".final").read_text())

    def close(self):
        for process in self.processes:
            process.kill()
            process.communicate()
        if self.observer:
            self.observer.close()


def base_port():
    while True:
        base = random.randrange(15000, 30000)
        with contextlib.suppress(OSError):
            for port in range(base, base + 4):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", port))
            return base


@pytest.fixture
def cluster(tmp_path):
    made = Cluster(tmp_path)
    yield made
    made.close()


def actors(status):
    return {role["incarnation"] for role in status["roles"] if role["role"] == "actor"}


def assert_books_balance(final):
    ledger = final["ledger"]
    assert ledger["accepted"] == ledger["consumed"] + ledger["dropped"] + ledger["queued"]
    assert ledger["granted"] == ledger["running"] + ledger["redeemed"] + ledger["returned"] + ledger["expired"]
    assert ledger["consumed"] == len(final["history"])
    assert len({tuple(identity) for identity in final["history"]}) == len(final["history"])


def test_actor_killed_while_it_uploads_leaves_nothing_behind(cluster):
    cluster.steps = 2000  # a rollout has about 2.8 MB, and one is always on its way
    learner = cluster.start_learner()
    for _ in range(3):
        actor = cluster.start_actor()
        before = cluster.wait(lambda status: len(actors(status)) == 1)["ledger"]["accepted"]
        cluster.wait(lambda status, before=before: status["ledger"]["accepted"] >= before + 4)
        time.sleep(random.uniform(0, 0.05))
        actor.send_signal(signal.SIGKILL)
        status = cluster.wait(lambda status: not actors(status), timeout=5)
        assert status["ledger"]["running"] == 0
    assert cluster.status()["ledger"]["damaged"] == 0
    final = cluster.stop(learner)
    assert_books_balance(final)
    history = {tuple(identity[1:]) for identity in final["history"]}
    acknowledged = {
        (entry["incarnation"], entry["sequence"]) for entry in cluster.outcomes() if entry["outcome"] == "accepted"
    }
    # All that was acknowledged was learnt from, or waited at the end.
    assert len(acknowledged - history) <= final["ledger"]["queued"] + final["ledger"]["dropped"]
    assert len({incarnation for incarnation, _ in history}) == 3


def test_learner_killed_and_restarted_counts_every_rollout_once(cluster):
    learner = cluster.start_learner()
    actor = cluster.start_actor()
    for _ in range(3):
        version = cluster.wait(bool)["version"]
        cluster.wait(lambda status, version=version: status["version"] >= version + 5)
        time.sleep(random.uniform(0, 0.05))
        learner.send_signal(signal.SIGKILL)
        learner.wait(5)
        time.sleep(0.3)
        learner = cluster.start_learner()
    version = cluster.wait(bool)["version"]
    cluster.wait(lambda status: status["version"] >= version + 5)
    assert actor.poll() is None
    final = cluster.stop(learner)
    assert actor.wait(10) == 0, (cluster.folder / "actor.err").read_text()
    assert_books_balance(final)
    outcomes = cluster.outcomes()
    assert sorted(entry["sequence"] for entry in outcomes) == list(range(len(outcomes)))
    by_outcome = {name: set() for name in ("accepted", "duplicate", "stale", "unknown")}
    for entry in outcomes:
        by_outcome[entry["outcome"]].add(entry["sequence"])
    acknowledged, unknown = by_outcome["accepted"] | by_outcome["duplicate"], by_outcome["unknown"]
    assert len(unknown) <= 2  # on their way when the learner ended
    assert {identity[2] for identity in final["history"]} <= acknowledged | unknown
    ledger = final["ledger"]
    counted = sum(ledger[name] for name in ("consumed", "dropped", "queued", "stale", "missing"))
    assert len(outcomes) - len(unknown) <= counted <= len(outcomes)


def test_learner_started_from_scratch_makes_actors_start_over(cluster):
    learner = cluster.start_learner("e")
    actor = cluster.start_actor()
    cluster.wait(lambda status: status["version"] >= 3)
    learner.send_signal(signal.SIGKILL)
    learner.wait(5)
    cluster.checkpoint.unlink()
    learner = cluster.start_learner("f")
    cluster.wait(lambda status: status["version"] >= 3 and status["epoch"] == "f")
    final = cluster.stop(learner)
    assert actor.wait(10) == 0
    assert_books_balance(final)
    assert {"restarted": "f"} in cluster.outcomes()


def test_stopped_actor_is_noticed_and_comes_back(cluster):
    learner = cluster.start_learner()
    actor = cluster.start_actor()
    cluster.wait(lambda status: status["ledger"]["accepted"] >= 4)
    actor.send_signal(signal.SIGSTOP)
    status = cluster.wait(lambda status: not actors(status), timeout=8)
    assert status["ledger"]["running"] == 0
    actor.send_signal(signal.SIGCONT)
    accepted = status["ledger"]["accepted"]
    cluster.wait(lambda status: actors(status) and status["ledger"]["accepted"] >= accepted + 4)
    assert_books_balance(cluster.stop(learner))
    assert actor.wait(10) == 0


def test_hostile_messages_harm_nobody_else(cluster):
    learner = cluster.start_learner()
    cluster.start_actor()
    cluster.wait(lambda status: status["ledger"]["accepted"] >= 2)
    header = {"actor": "evil", "incarnation": "66", "sequence": 0, "epoch": "e", "ticket": "x"}

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
    for message in refused:
        assert cluster.observer.query(KEYS.rollout("evil"), message, timeout=5).meta["outcome"] == "refused"
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
    with pytest.raises(TransportError, match="Nobody"):
        cluster.observer.query("congrasp/other/rollout", evil(), timeout=5)
    with pytest.raises(TransportError, match="Nobody"):
        cluster.observer.query("congrasp/chaos/shutdown", Message(), timeout=5)
    replayed = cluster.observer.query(KEYS.rollout("evil"), evil(version=10**6), timeout=5).meta
    assert replayed["outcome"] == "stale"
    ledger = cluster.status()["ledger"]
    assert ledger["damaged"] == len(refused) + len(damaged)
    cluster.wait(lambda status: status["ledger"]["accepted"] >= ledger["accepted"] + 4)
    final = cluster.stop(learner)
    assert_books_balance(final)
    assert {identity[0] for identity in final["history"]} == {"a"}


if __name__ == "__main__":
    {"learner": run_learner, "actor": run_actor}[sys.argv[1]](*sys.argv[2:])
