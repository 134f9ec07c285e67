"""Several processes that serve one policy."""

import contextlib
import dataclasses
import json
import pathlib
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import NamedTuple

import psutil
import pytest

from congrasp.common.errors import TransportError
from congrasp.common.policy import bundle as bundles
from congrasp.common.transport import urls
from congrasp.common.transport.ports import free_port, local_url, shifted
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.ops.certificates import create_authority, issue
from congrasp.services.ops.lifetime import command
from tests import task
from tests.children import following
from tests.rollouts import learner_hub
from tests.services.ops.test_metrics import scrape
from tests.waits import eventually

pytestmark = pytest.mark.timeout(300)

WORKERS = 2
WAIT_S = 120.0


class Served(NamedTuple):
    """A server with workers."""

    endpoint: str
    process: subprocess.Popen[bytes]
    log: pathlib.Path
    metrics_port: int

    def worker(self, number):
        """Process of a worker; None while there is none."""
        for child in psutil.Process(self.process.pid).children():
            with contextlib.suppress(psutil.NoSuchProcess):
                words = child.cmdline()
                if "--worker" in words and words[words.index("--worker") + 1] == str(number):
                    return child
        return None


@contextlib.contextmanager
def serving(folder, **options) -> Iterator[Served]:
    """Context with a server."""
    port = free_port()
    metrics_port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    arguments = command(
        "serve", workers=WORKERS, listen=endpoint, metrics_port=metrics_port, **options
    )
    log = folder / "serve.log"
    program = [sys.executable, "-P", "-m", "congrasp", *arguments]
    with log.open("wb") as output:
        process = subprocess.Popen(
            program, stdout=output, stderr=subprocess.STDOUT, env=following()
        )
    try:
        yield Served(endpoint, process, log, metrics_port)
    finally:
        process.terminate()
        process.wait(30)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policy")
    path = folder / "policy.safetensors"
    bundles.save(task.heading_policy(), path)
    with serving(folder, policy=path) as server:
        yield server


@pytest.fixture
def served(server):
    """The module's server, all of whose workers are ready."""
    for number in range(WORKERS):
        ready_health(server, number)
    return server


@pytest.fixture
def client_of(served, example, monkeypatch):
    """Makes clients whose order begins with a certain worker, at the start of an episode."""
    with contextlib.ExitStack() as clients:

        def connect(number):
            monkeypatch.setattr(
                "secrets.SystemRandom.sample",
                lambda _, endpoints, k: [*endpoints[number:], *endpoints[:number]],
            )
            client = clients.enter_context(PolicyClient(served.endpoint, wait=WAIT_S))
            client.reset(example.request)
            return client

        yield connect


def health_of_worker(served, number, **options):
    """Health of a worker; None if it does not respond."""
    endpoint = shifted(served.endpoint, number)
    with (
        contextlib.suppress(TransportError),
        PolicyClient(endpoint, wait=WAIT_S, **options) as client,
    ):
        health = client.health()
        if health["worker"] == number:
            return health


def ready_health(served, number):
    """Health of a worker, once it is ready."""

    def health():
        health = health_of_worker(served, number)
        if health and health["ready"]:
            return health

    return eventually(health)


def answered(served, number):
    """Number of queries that a worker has answered."""
    return ready_health(served, number)["answered"]


@contextlib.contextmanager
def without_worker(served, number) -> Iterator[None]:
    """Context in which a worker is killed, and not replaced before its end."""
    restarter = psutil.Process(served.process.pid)
    restarter.suspend()
    try:
        killed = served.worker(number)
        killed.kill()
        eventually(lambda: killed.status() == psutil.STATUS_ZOMBIE)
        yield
    finally:
        restarter.resume()


def act_again(client, state):
    """Queries until there is an answer."""

    def answer():
        with contextlib.suppress(TransportError):
            return client.act(state)

    return eventually(answer)


@pytest.mark.parametrize("number", range(WORKERS))
def test_each_worker_answers_its_clients(served, client_of, example, number):
    before = [answered(served, worker) for worker in range(WORKERS)]
    client = client_of(number)
    for _ in range(3):
        client.act(example.state)
    added = [answered(served, worker) - before[worker] for worker in range(WORKERS)]
    assert added == [3 * (worker == number) for worker in range(WORKERS)]


def test_metadata_of_a_client_does_not_depend_on_workers(client_of):
    metadata = client_of(1).metadata()
    assert "workers" not in metadata


def test_health_of_workers_is_their_sum(served, exit_code_of, capsys):
    each = [answered(served, worker) for worker in range(WORKERS)]
    assert exit_code_of(["query", "--health", "--connect", served.endpoint]) == 0
    health = json.loads(capsys.readouterr().out)
    assert health["answered"] == sum(each)
    assert health["workers_ready"] == WORKERS


def test_each_worker_has_its_metrics(served, client_of, example):
    for number in range(WORKERS):
        client_of(number).act(example.state)
        metrics = scrape(served.metrics_port + number)
        counted = metrics["congrasp_policy_queries_total", "answered"]
        assert counted == answered(served, number)


@pytest.mark.parametrize("number", range(WORKERS))
def test_a_killed_worker_is_replaced(served, client_of, example, number, exit_code_of, capsys):
    """Meanwhile the other worker answers a connected and a new client, whose orders both begin with
    the killed one.
    """
    connected = client_of(number)
    connected.act(example.state)
    other = 1 - number
    with without_worker(served, number):
        act_again(connected, example.state)
        before = answered(served, other)
        client_of(number).act(example.state)
        assert answered(served, other) == before + 1
        assert exit_code_of(["query", "--health", "--connect", served.endpoint]) == 0
        health = json.loads(capsys.readouterr().out)
        assert health["workers_ready"] == WORKERS - 1
    eventually(lambda: served.worker(number))
    line = f"The worker {number} was killed by SIGKILL. Restarting it."
    assert line in served.log.read_text()


def test_workers_with_certificates_follow_a_learner(tmp_path):
    policy = dataclasses.replace(task.policy(), version=1)
    message = policy.to_message()
    certs = tmp_path / "certs"
    create_authority(certs, run="safe")
    for role in ("learner", "server", "client"):
        issue(certs, role)
    learner = local_url()
    with urls.listen(learner, "learner", certs=certs) as transport:
        hub, _ = learner_hub(
            transport, "safe", schema=policy.spec.schema, run_id=message.meta["run_id"]
        )
        hub.publish_weights(message, 1)
        with serving(tmp_path, connect=learner, run="safe", certs=certs) as server:
            for number in range(WORKERS):
                eventually(lambda n=number: health_of_worker(server, n, certs=certs))

            def servers():
                return [role for role in hub.status()["roles"] if role["role"] == "server"]

            eventually(lambda: len(servers()) == WORKERS)


def test_ctrl_c_ends_all_workers(tmp_path):
    with serving(tmp_path) as server:
        workers = [eventually(lambda n=n: server.worker(n)) for n in range(WORKERS)]
        with PolicyClient(server.endpoint, wait=WAIT_S) as client:
            client.health()
        server.process.send_signal(signal.SIGINT)
        assert server.process.wait(30) == 128 + signal.SIGINT
        assert not any(worker.is_running() for worker in workers)


def test_bad_input_of_workers_ends_the_server(tmp_path):
    policy = tmp_path / "damaged.safetensors"
    policy.write_bytes(b"damaged")
    with serving(tmp_path, policy=policy) as server:
        assert server.process.wait(WAIT_S) == 2
    assert "damaged.safetensors" in server.log.read_text()


def test_workers_end_if_the_learner_is_missing(tmp_path):
    learner = local_url()
    with serving(tmp_path, connect=learner, patience=0.1) as server:
        assert server.process.wait(WAIT_S) == TransportError.exit_code
    assert learner in server.log.read_text()
