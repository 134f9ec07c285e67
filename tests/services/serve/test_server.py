"""The live policy: answers, refusals, and swaps of weights, over both ends of the real wire."""

import concurrent.futures
import contextlib
import dataclasses
import os
import pathlib
import threading
from unittest import mock

import numpy as np
import pytest

from congrasp.common.errors import (
    CongraspError,
    OverloadedError,
    RefusedError,
    StartingError,
    TransportError,
)
from congrasp.common.policy import bundle as bundles
from congrasp.common.transport.keys import Keys, below
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.transport.ports import free_port
from congrasp.common.transport.zenoh_transport import ZenohTransport
from congrasp.common.wire.codec import Message
from congrasp.services.cli.query import Query
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.ops.metrics import ServerMetrics
from congrasp.services.ops.metrics_endpoint import serve_metrics
from congrasp.services.serve.inference import Inference, PolicyFunction
from congrasp.services.serve.load import Load, Target, measure
from congrasp.services.serve.server import (
    PEER_LIMIT,
    QUEUE_LIMIT,
    Answer,
    PolicyServer,
    join_parts,
    parse_timeout,
)
from congrasp.services.serve.sources import follow_file, follow_run
from congrasp.services.train.command import untrained
from tests import task
from tests.services.ops.test_metrics import scrape
from tests.waits import eventually

pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def metrics():
    """What the server is watched by."""
    return ServerMetrics()


@pytest.fixture(scope="module")
def served(tmp_path_factory, metrics, example):
    """A server over Zenoh that follows a policy file, and the start of an episode."""
    path = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    bundles.save(task.policy(), path)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohTransport(listen=[endpoint], flows=("policy",)) as transport:
        server = PolicyServer(
            transport, "policy", follow_file(path), on_answer=metrics.answer, on_batch=metrics.batch
        )
        metrics.health = server.health
        yield path, endpoint, example
        server.close()


def test_answers_are_targets_within_limits_and_continue_from_the_last(served):
    _, endpoint, episode = served
    with PolicyClient(endpoint) as client:
        client.reset(episode.request)
        first, second = (client.act(episode.state) for _ in range(2))
        health = client.health()
        assert health["ready"]
        assert health["hand"] == "human"
        assert health["queue_limit"] == QUEUE_LIMIT
        assert health["peer_limit"] == PEER_LIMIT
        assert health["states_per_second"] > 100
    assert first.q_target.shape == (20,)
    assert first.u_target.shape == (6,)
    assert first.action.shape == (26,)
    assert first.version == 0
    assert first.active == ("The heading guides the wrist.",)
    # Targets integrate the action on the previous targets: q_tgt = q_tgt_prev + 0.1 a, within the
    # limits.
    expected = first.q_target + 0.1 * second.action[:20]
    np.testing.assert_allclose(second.q_target[3:7], expected[3:7], atol=1e-4)


def test_answers_refusals_and_batches_are_counted(served, metrics):
    _, endpoint, episode = served
    port = free_port()
    with PolicyClient(endpoint) as client, serve_metrics(port, "127.0.0.1", metrics):
        before = scrape(port)
        client.reset(episode.request)
        for _ in range(3):
            client.act(episode.state)
        client.reset(dataclasses.replace(episode.request, constraints={"levitation": {}}))
        with pytest.raises(TransportError):
            client.act(episode.state)
        after = scrape(port)
    grown = {name: value - before[name] for name, value in after.items()}
    assert (
        grown["congrasp_policy_queries_total", "answered"]
        == 3
        == grown["congrasp_policy_seconds_count",]
    )
    assert grown["congrasp_policy_queries_total", "refused"] == 1
    assert grown["congrasp_policy_batch_count",] == 3 == grown["congrasp_policy_batch_sum",]
    assert after["congrasp_policy_ready",] == 1
    assert after["congrasp_policy_version",] == 0


def test_swapping_weights_fails_no_query(served, monkeypatch):
    path, endpoint, episode = served
    monkeypatch.setattr("congrasp.services.serve.server.FOLLOW_PERIOD_S", 0.001)
    policy = task.policy()
    swapped = threading.Event()

    def ask(_):
        versions = []
        with PolicyClient(endpoint, timeout=5.0) as client:
            client.reset(episode.request)
            while not swapped.is_set():
                versions.append(client.act(episode.state).version)
            versions.append(client.act(episode.state).version)
        return versions

    with concurrent.futures.ThreadPoolExecutor(4) as pool, PolicyClient(endpoint) as watcher:
        versions_of_clients = pool.map(ask, range(4))
        try:
            for version in range(1, 101):
                bundles.save(dataclasses.replace(policy, version=version), path)
                eventually(lambda version=version: watcher.health()["version"] == version, 0.0)
        finally:
            swapped.set()
        for versions in versions_of_clients:
            assert versions == sorted(versions)
            assert versions[-1] == 100
            assert len(set(versions)) > 10


def test_a_latency_test_sends_no_more_than_its_rate(served):
    _, endpoint, episode = served
    target = Target(endpoint, "policy", timeout=5.0)
    result = measure(target, episode, Load(repeat=6, concurrency=2, rate=10.0))
    assert result["failed"] == result["overloaded"] == 0
    assert result["answers_per_s"] <= 6 / 0.25  # the last is sent after two and a half periods


@pytest.mark.parametrize("beside_others", [False, True])
def test_several_states_equal_single_queries_and_keep_the_episode(
    served, beside_others, monkeypatch
):
    """Beside other clients the eleven are inferred in three parts."""
    _, endpoint, episode = served
    monkeypatch.setattr("congrasp.services.serve.batching.ALONE_S", 1e6 if beside_others else 0.0)
    if beside_others:
        with PolicyClient(endpoint, timeout=5.0) as other:
            other.reset(episode.request)
            other.act(episode.state)
    poses = [episode.state["q"] + 0.01 * i for i in range(11)]
    states = [{**episode.state, "q": pose, "q_target": pose} for pose in poses]
    alone = []
    with PolicyClient(endpoint, timeout=5.0) as client:
        for state in states:
            client.reset(episode.request)
            alone.append(client.act(state))
        client.reset(episode.request)
        together = client.act_each(states)
        first = client.act(states[0])
    for one, other in zip([*together, first], [*alone, alone[0]], strict=True):
        assert one.version == other.version
        assert one.active == other.active
        for name in ("action", "q_target", "u_target"):
            np.testing.assert_allclose(
                getattr(one, name), getattr(other, name), atol=1e-5, err_msg=name
            )
    assert np.abs(together[0].q_target - together[10].q_target).max() > 0.01


def part_of_answer(policy: object, value: float) -> Answer:
    return Answer(Inference(np.full((2, 3), value), [["x"]] * 2), policy, 0.25, 0.5)


def test_parts_are_joined_only_if_one_policy_answered_all():
    old = object()
    new = object()
    assert join_parts([part_of_answer(old, 1.0), part_of_answer(new, 2.0)]) is None
    joined = join_parts([part_of_answer(new, 1.0), part_of_answer(new, 2.0)])
    np.testing.assert_array_equal(joined.inference.vectors[:, 0], [1.0, 1.0, 2.0, 2.0])
    assert joined.inference.active == [["x"]] * 4
    assert joined.policy is new
    assert joined.queue_s == 0.25
    assert joined.infer_s == 1.0


def test_bad_lists_of_states_are_refused(served):
    _, endpoint, episode = served
    good = episode.state
    bad = {**episode.state, "object_quaternion": np.array([0.0, 0.0, 0.0, 2.0])}
    with PolicyClient(endpoint, timeout=60.0) as client:
        client.reset(episode.request)
        with pytest.raises(
            RefusedError, match=r"'object_quaternion' of state 2 has length 2\.000, not 1"
        ):
            client.act_each([good, good, bad])
        with pytest.raises(CongraspError, match="65 states"):
            client.act_each([good] * 65)
        with pytest.raises(CongraspError, match="no state"):
            client.act_each([])
        assert len(client.act_each([good] * 64)) == 64


def test_queries_beyond_the_queue_are_refused_at_once(served, metrics, monkeypatch):
    _, endpoint, episode = served
    entered = threading.Semaphore(0)
    go = threading.Event()
    infer = PolicyFunction.__call__

    def hold(self, weights, queries):
        entered.release()
        assert go.wait(60)
        return infer(self, weights, queries)

    monkeypatch.setattr(PolicyFunction, "__call__", hold)

    def ask(client: PolicyClient) -> int:
        client.reset(episode.request)
        return client.act(episode.state).version

    with contextlib.ExitStack() as stack:
        clients = [
            stack.enter_context(PolicyClient(endpoint, timeout=50.0))
            for _ in range(QUEUE_LIMIT + 2)
        ]
        pool = stack.enter_context(concurrent.futures.ThreadPoolExecutor(len(clients)))
        stack.callback(go.set)
        futures = [pool.submit(ask, clients[0])]
        assert entered.acquire(timeout=60)
        futures += [pool.submit(ask, client) for client in clients[1:-1]]
        eventually(lambda: clients[-1].health()["queue"] >= QUEUE_LIMIT)
        with pytest.raises(OverloadedError, match="Overloaded"):
            ask(clients[-1])
        assert metrics.outcomes["overloaded"] == 1
        assert not any(future.done() for future in futures)
        go.set()
        assert len({future.result(60) for future in futures}) == 1


def test_a_mismatched_newer_policy_is_refused(served):
    path, endpoint, _ = served
    with PolicyClient(endpoint) as client:
        version = client.health()["version"]
        for other, words in (
            (dataclasses.replace(task.TASK, dynamic_center=False), "another task"),
            (dataclasses.replace(task.TASK, trajectory_points=3), "not for hand"),
        ):
            policy = untrained(dataclasses.replace(task.CONFIG, task=other))
            bundles.save(dataclasses.replace(policy, version=99), path)
            eventually(lambda words=words: words in client.health()["trouble"])
            assert client.health()["version"] == version


def test_following_a_run_pulls_only_what_is_newer():
    keys = Keys("r")
    policy = task.policy()
    with MemoryTransport(MemoryHub()) as transport:
        pull = follow_run(transport, "r", "s")
        with pytest.raises(TransportError):
            pull(-1)

        def weights(key: str, request: Message) -> Message:
            current = request.meta["newer_than"] == policy.version
            return Message({}, {"version": policy.version}) if current else policy.to_message()

        transport.serve(below(keys.weights), weights)
        assert pull(-1).version == policy.version
        assert pull(policy.version) is None


def test_a_server_outlives_restarts_of_its_learner(monkeypatch):
    """Its policy stays until the learner answers again with a newer one."""
    monkeypatch.setattr("congrasp.services.serve.server.FOLLOW_PERIOD_S", 0.001)
    monkeypatch.setattr(PolicyFunction, "warm_up", lambda function, weights: {1: 0.01})
    first = task.policy()
    newer = dataclasses.replace(first, version=first.version + 1)
    served_while_lost: list[int] = []

    def pull(version):
        if version < 0:
            return first
        if len(served_while_lost) < 20:
            served_while_lost.append(version)
            raise TransportError("No response.")
        return newer if version == first.version else None

    with MemoryTransport(MemoryHub()) as transport:
        server = PolicyServer(transport, "p", pull)
        eventually(lambda: server.health()["version"] == newer.version)
        assert served_while_lost == 20 * [first.version]
        server.close()


@pytest.fixture
def quick_start(monkeypatch):
    """Servers look for newer policies often, and compile nothing."""
    monkeypatch.setattr("congrasp.services.serve.server.FOLLOW_PERIOD_S", 0.001)
    monkeypatch.setattr(PolicyFunction, "warm_up", lambda function, weights: {1: 0.01})


def test_a_server_outlives_any_error_of_its_source(quick_start):
    """Its health reports the error until the source works again."""
    first = task.policy()
    outcome: list[object] = [ZeroDivisionError("reason")]

    def pull(version):
        if version < 0:
            return first
        if isinstance(outcome[0], Exception):
            raise outcome[0]
        return outcome[0]

    with MemoryTransport(MemoryHub()) as transport:
        server = PolicyServer(transport, "p", pull)
        eventually(lambda: "reason" in server.health()["trouble"])
        outcome[0] = None
        eventually(lambda: server.health()["trouble"] == "")
        outcome[0] = dataclasses.replace(first, version=first.version + 1)
        eventually(lambda: server.health()["version"] == first.version + 1)
        server.close()


def test_a_policy_file_that_was_missing_for_a_while_is_no_trouble(quick_start, tmp_path):
    path = tmp_path / "policy.safetensors"
    bundles.save(task.policy(), path)
    with MemoryTransport(MemoryHub()) as transport:
        server = PolicyServer(transport, "p", follow_file(path))
        path.rename(tmp_path / "aside")
        eventually(lambda: "cannot be read" in server.health()["trouble"])
        (tmp_path / "aside").rename(path)
        eventually(lambda: server.health()["trouble"] == "")
        server.close()


def test_a_policy_file_is_read_again_after_a_failure(tmp_path, monkeypatch):
    """Its time of change is the same: only the reading failed."""
    path = tmp_path / "policy.safetensors"
    bundles.save(task.policy(), path)
    read = follow_file(path)
    version = read(-1).version
    os.utime(path, (1.0, 1.0))
    with monkeypatch.context() as patch:
        patch.setattr(bundles, "load", mock.Mock(side_effect=CongraspError("disk")))
        with pytest.raises(CongraspError, match="disk"):
            read(version)
    assert read(version).version == version
    assert read(version) is None


def test_queries_to_a_compiling_server_are_refused_and_counted(monkeypatch):
    compiling = threading.Event()
    done = threading.Event()

    def warm_up(function, weights):
        compiling.set()
        assert done.wait(60)
        return {1: 0.01}

    monkeypatch.setattr(PolicyFunction, "warm_up", warm_up)
    outcomes = []
    with (
        MemoryTransport(MemoryHub()) as transport,
        concurrent.futures.ThreadPoolExecutor(1) as pool,
    ):
        starting = pool.submit(
            PolicyServer,
            transport,
            "p",
            lambda version: task.policy(),
            on_answer=lambda outcome, seconds: outcomes.append(outcome),
        )
        assert compiling.wait(60)
        with pytest.raises(RefusedError, match="compiling"):
            transport.query(Keys("p").act_for("peer"), Message({}, {}), timeout=10.0)
        done.set()
        starting.result(60).close()
    assert outcomes == ["refused"]


def test_query_command_waits_for_compilation(monkeypatch, capsys):
    asked = threading.Event()
    done = threading.Event()
    health = PolicyServer.health

    def warm_up(function, weights):
        assert done.wait(60)
        return {1: 0.01}

    def noted_health(server):
        asked.set()
        return health(server)

    monkeypatch.setattr(PolicyFunction, "warm_up", warm_up)
    monkeypatch.setattr(PolicyServer, "health", noted_health)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (
        ZenohTransport(listen=[endpoint], flows=("policy",)) as transport,
        concurrent.futures.ThreadPoolExecutor(2) as pool,
    ):
        starting = pool.submit(
            PolicyServer,
            transport,
            "policy",
            lambda version: task.policy() if version < 0 else None,
        )
        with (
            PolicyClient(endpoint, wait=1.0) as client,
            pytest.raises(StartingError, match="compiling"),
        ):
            client.wait_until_ready()
        asked.clear()
        querying = pool.submit(Query(endpoint, timeout=60.0))
        assert asked.wait(60)
        done.set()
        assert querying.result(120) == 0
        starting.result(60).close()
    assert "q_target" in capsys.readouterr().out


def test_a_failed_start_leaves_no_thread(quick_start, monkeypatch):
    monkeypatch.setattr(PolicyFunction, "warm_up", mock.Mock(side_effect=ZeroDivisionError))
    before = threading.enumerate()
    with MemoryTransport(MemoryHub()) as transport:
        with pytest.raises(ZeroDivisionError):
            PolicyServer(transport, "p", lambda version: task.policy())
        started = [thread.name for thread in threading.enumerate() if thread not in before]
        assert not {"batcher", "follow"} & set(started)
        with pytest.raises(RefusedError, match="The policy server is closed"):
            transport.query(Keys("p").health, Message({}, {"metadata": True}), timeout=10.0)


@pytest.mark.parametrize("timeout", [True, 0.0, -1, 61, float("nan"), "1", None])
def test_a_timeout_that_is_no_duration_is_refused(timeout):
    with pytest.raises(CongraspError, match="'timeout' is"):
        parse_timeout(timeout)


def test_a_server_needs_a_readable_policy(tmp_path: pathlib.Path):
    with MemoryTransport(MemoryHub()) as transport:
        with pytest.raises(CongraspError, match="cannot be read"):
            PolicyServer(transport, "p", follow_file(tmp_path / "none.safetensors"))
        broken = tmp_path / "broken.safetensors"
        broken.write_bytes(b"PK\x03\x04 not a policy")
        with pytest.raises(CongraspError, match="damaged"):
            PolicyServer(transport, "p", follow_file(broken))
        with pytest.raises(CongraspError, match="no policy to serve"):
            PolicyServer(transport, "p", lambda version: None)
        health = transport.query(Keys("p").health, Message({}, {}), timeout=0.5).meta
    assert health == {"ready": False, "state": "closed"}


def test_an_invalid_name_is_refused_before_loading():
    with pytest.raises(CongraspError, match="'a/b' cannot be the name of a run"):
        PolicyServer(mock.Mock(), "a/b", mock.Mock(side_effect=AssertionError))
