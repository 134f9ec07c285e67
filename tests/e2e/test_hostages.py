"""One who does not read, asks without end, says nothing, sends too much or is slow holds nobody
else up.

The attackers are programs in processes of their own (`tests.benchmarks.attackers`).
"""

import contextlib
import threading
import time

import numpy as np
import psutil
import pytest

from congrasp.actors.link import ActorLink
from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys, below
from congrasp.common.transport.ports import local_url, shifted
from congrasp.common.wire.codec import Message, encode
from tests.benchmarks.attackers import attacked, throttled
from tests.rollouts import bundle, learner_hub, rollout

KEYS = Keys("r")
ANSWER = Message({"q_target": np.zeros(5_000, np.float32)})


@contextlib.contextmanager
def policy_server():
    """Answers of 20 kB, as those to 64 states are."""
    endpoint = local_url()
    with urls.listen(endpoint, "server") as transport:
        transport.serve(below(KEYS.act), lambda key, request: ANSWER, workers=2, depth=64)
        yield endpoint


@contextlib.contextmanager
def learner(parameters):
    """A hub with weights of so many float32."""
    endpoint = local_url()
    with urls.listen(endpoint, "learner") as transport:
        run = learner_hub(transport, "r")
        run.hub.publish_weights(bundle(0, parameters=parameters), 0)
        yield endpoint, run


def _updates(link, run, parameters, count):
    """So many updates of two rollouts each, with the weights of each pulled in full."""
    version = run.rollouts.staleness.version
    for _ in range(count):
        for _ in range(2):
            ticket = link.acquire_ticket(20)
            assert link.upload(rollout(version=version), ticket).result(20) == "accepted"
        assert run.rollouts.next_batch(2, 5)
        version += 1
        run.hub.publish_weights(bundle(version, parameters=parameters), version)
        deadline = time.monotonic() + 20
        next_announcement = time.monotonic() + 2
        while (pulled := link.weights(version - 1)) is None or pulled.meta["version"] != version:
            assert time.monotonic() < deadline, "the weights did not come"
            time.sleep(0.01)
            if time.monotonic() > next_announcement:
                # Announcements may be lost; the ticket that an actor would get says the version
                run.hub.publish_weights(bundle(version, parameters=parameters), version)
                next_announcement += 2
        assert (pulled.arrays["actor/w"] == version).all()


def test_peers_that_read_no_answers_block_no_other(tmp_path):
    """With answers that wait for their readers, both workers of the server would stand still for
    seconds.
    """
    query = tmp_path / "query"
    query.write_bytes(encode(Message()))
    with (
        policy_server() as endpoint,
        urls.connect(endpoint, "client") as client,
        attacked("unread", endpoint, "r", query, count=2),
    ):
        deadline = time.monotonic() + 3.0
        while time.monotonic() < deadline:
            client.query(KEYS.act_for("c"), Message(), timeout=1.5)
            time.sleep(0.01)


def test_endless_requests_for_weights_are_deferred():
    with (
        learner(900_000) as (endpoint, run),
        urls.connect(endpoint, "actor") as transport,
        ActorLink(transport, "r", "a", request_timeout=20.0) as link,
        attacked("greedy", endpoint, "r", count=3),
    ):
        link.config(10)
        _updates(link, run, 900_000, 20)
        assert run.hub.pull_limit.rejected > 0


def test_an_actor_on_a_slow_link_blocks_no_other():
    """300 kB/s: the weights take three seconds, in which the other's updates go on."""
    pulled = []

    def pull(slow):
        with (
            urls.connect(slow, "actor") as transport,
            ActorLink(transport, "r", "slow", request_timeout=5.0) as link,
        ):
            link.config(10)
            pulled.append(link.weights(-1))

    with (
        learner(225_000) as (endpoint, run),
        throttled(endpoint, 300e3) as slow,
        urls.connect(endpoint, "actor") as transport,
        ActorLink(transport, "r", "a", request_timeout=20.0) as link,
    ):
        link.config(10)
        thread = threading.Thread(target=pull, args=(slow,))
        thread.start()
        for _ in range(15):
            _updates(link, run, 225_000, 1)
            time.sleep(0.05)
        thread.join(60)
    (weights,) = pulled
    assert (weights.arrays["actor/w"] == weights.meta["version"]).all()


@pytest.mark.parametrize("flow", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_silent_connections_exclude_no_other(flow):
    """Connections that show nothing for seconds are closed, and hundreds of them are not too
    many.
    """
    with learner(1000) as (endpoint, _), attacked("silent", shifted(endpoint, flow), "r"):
        time.sleep(1.0)
        for _ in range(5):
            with urls.connect(endpoint, "observer", wait=20.0) as transport:
                assert transport.query(KEYS.status, Message(), timeout=10).meta["run"] == "r"


def _grown(honest):
    """Bytes by which this process grows while it does something 150 times."""
    process = psutil.Process()
    most = 0
    before = process.memory_info().rss
    for _ in range(150):
        honest()
        most = max(most, process.memory_info().rss - before)
        time.sleep(0.01)
    return most


def test_too_long_messages_are_refused_before_they_are_in_memory():
    """Four times 60 MB at a time: a policy server is sent no more than two."""
    with policy_server() as endpoint, urls.connect(endpoint, "client") as client:
        ask = lambda: client.query(KEYS.act_for("c"), Message(), timeout=5)  # noqa: E731
        ask()
        with attacked("huge", endpoint, "r"):
            assert _grown(ask) < 100e6


def test_rollouts_that_no_actor_makes_are_refused_before_they_are_in_memory(tmp_path):
    """A learner knows how long its run's rollouts are."""
    endpoint = local_url()
    key = tmp_path / "key"
    key.write_text(KEYS.rollout("huge"))
    with urls.listen(endpoint, "learner", longest_rollout=1 << 20) as transport:
        taken = []
        transport.serve(KEYS.rollouts, lambda key, message: taken.append(key) or Message())
        with (
            urls.connect(endpoint, "actor") as actor,
            attacked("huge", shifted(endpoint, 1), "r", key),
        ):
            send = lambda: actor.query(KEYS.rollout("a"), rollout(), timeout=5)  # noqa: E731
            assert _grown(send) < 100e6
    assert set(taken) == {KEYS.rollout("a")}
