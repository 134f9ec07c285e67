"""A policy server while it compiles."""

import concurrent.futures
import contextlib
import threading

import pytest

from congrasp.common.errors import CongraspError, StartingError, TransportError
from congrasp.common.policy import bundle as bundles
from congrasp.common.transport.ports import free_port
from congrasp.common.transport.zenoh_transport import ZenohTransport
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.serve.inference import PolicyFunction
from congrasp.services.serve.server import PolicyServer
from congrasp.services.serve.sources import follow_file
from tests import task
from tests.waits import eventually


@pytest.fixture
def compiling(tmp_path, monkeypatch):
    """Endpoint of a server that compiles until the event is set."""
    path = tmp_path / "policy.safetensors"
    bundles.save(task.policy(), path)
    compiled = threading.Event()
    warm_up = PolicyFunction.warm_up

    def wait_and_warm_up(self, weights, sizes=(1,)):
        assert compiled.wait(60)
        return warm_up(self, weights, (1,))

    monkeypatch.setattr(PolicyFunction, "warm_up", wait_and_warm_up)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    servers = []
    with ZenohTransport(listen=[endpoint], flows=("policy",)) as transport:
        start = threading.Thread(
            target=lambda: servers.append(PolicyServer(transport, "policy", follow_file(path)))
        )
        start.start()
        yield endpoint, compiled
        compiled.set()
        start.join(60)
        servers[0].close()


def responding(client):
    """Health of a server; None before it responds."""
    with contextlib.suppress(TransportError):
        return client.health()


def test_health_reports_compilation(compiling):
    endpoint, _ = compiling
    with PolicyClient(endpoint) as client:
        health = eventually(lambda: responding(client))
        assert not health["ready"]
        assert health["state"].startswith("compiling, ")


def test_health_responds_while_the_policy_is_loaded():
    """A client that connects at once waits, instead of getting no response."""
    loaded = threading.Event()

    def source(version):
        assert loaded.wait(60)

    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (
        ZenohTransport(listen=[endpoint], flows=("policy",)) as transport,
        concurrent.futures.ThreadPoolExecutor(1) as threads,
    ):
        server = threads.submit(PolicyServer, transport, "policy", source)
        with PolicyClient(endpoint, wait=0.5) as client:
            health = eventually(lambda: responding(client))
            with pytest.raises(StartingError):
                client.metadata()
        loaded.set()
        with pytest.raises(CongraspError, match="no policy to serve"):
            server.result(60)
    assert health["state"].startswith("compiling, ")


def test_first_act_waits_for_the_server(compiling, example):
    endpoint, compiled = compiling
    with PolicyClient(endpoint, wait=60.0) as client:
        client.reset(example.request)
        threading.Timer(1.0, compiled.set).start()
        assert client.act(example.state).version == 0


def test_first_act_waits_no_longer_than_wait(compiling, example):
    endpoint, _ = compiling
    with PolicyClient(endpoint, wait=0.5) as client:
        client.reset(example.request)
        with pytest.raises(StartingError):
            client.act(example.state)
