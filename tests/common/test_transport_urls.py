"""URL and role are all that a process names: flows, ports and certificates follow, whatever carries
the messages.
"""

import contextlib
import json
import multiprocessing
import os
import subprocess
import sys
import threading

import pytest

import tests.socket_transport  # noqa: F401  adds its scheme
from congrasp.actors.link import ActorLink
from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.transport import urls
from congrasp.common.transport.keys import FLOWS, Keys, flow
from congrasp.common.transport.ports import free_port, local_url, rank_url, reachable_url
from congrasp.common.transport.security import RIGHTS, Credentials
from congrasp.common.wire.codec import Message
from congrasp.services.ops.certificates import create_authority, issue
from tests.conftest import ROOT
from tests.rollouts import bundle, learner_hub, rollout
from tests.waits import eventually

KEYS = Keys("test")
TAKER = """
import json, sys
from congrasp.common.transport import ports
ports._FIRST_FREE_PORT = {lowest}
ports._FREE_PORTS = 61  # sixty to choose from, so that one would soon be chosen twice
for line in sys.stdin:
    print(json.dumps([ports.free_port(1) for _ in range(int(line))]), flush=True)
"""


@pytest.fixture
def certs(tmp_path):
    create_authority(tmp_path, run="test")
    for role in ("learner", "actor", "actor", "observer"):
        issue(tmp_path, role)
    return tmp_path


def test_every_role_opens_the_flows_of_all_that_it_may_do():
    for listener, peers in RIGHTS.items():
        for role, rights in peers.items():
            if (listener, role) == ("server", "observer"):  # no command connects so
                continue
            keys = [*rights.ask, *rights.publish, *rights.hear, *rights.show]
            opened = urls.PEER_FLOWS[role]
            assert {flow(f"congrasp/test/{key}") for key in keys} <= set(opened)
            # So that their ports are the same
            assert urls.LISTENER_FLOWS[listener][: len(opened)] == opened


@pytest.mark.parametrize("url", ["carrier-pigeon/loft", "127.0.0.1:7447", ""])
def test_an_unknown_scheme_lists_the_known_ones(url):
    with pytest.raises(
        CongraspError, match=rf"'{url}' is not an endpoint\. Write it like tcp/.*memory, tcp, tls"
    ):
        urls.connect(url, "actor")


def test_ports_follow_from_the_url():
    assert rank_url("tls/[::]:7447", 2) == f"tls/[::]:{7447 + 2 * len(FLOWS)}"
    assert rank_url("socket/anywhere", 0) == "socket/anywhere"
    with pytest.raises(CongraspError, match="is not an endpoint"):
        rank_url("socket/anywhere", 1)
    assert (
        reachable_url("tls/0.0.0.0:7447") == reachable_url("tls/[::]:7447") == "tls/127.0.0.1:7447"
    )
    assert reachable_url("tls/10.0.0.5:7447") == "tls/10.0.0.5:7447"


def test_within_a_process_a_name_is_enough():
    with pytest.raises(TransportError, match="No response from memory/x"):
        urls.connect("memory/x", "client", wait=0.0)
    server = urls.listen("memory/x", "server")
    with pytest.raises(CongraspError, match="memory/x is in use"):
        urls.listen("memory/x", "server")
    with urls.connect("memory/x", "client") as client:
        server.close()
        with pytest.raises(TransportError):
            client.query(KEYS.act, Message(), timeout=1)
        with urls.listen("memory/x", "server") as server:  # one that comes back is found again
            server.serve(KEYS.act, lambda key, message: message)
            assert client.query(KEYS.act, Message(meta={"n": 1}), timeout=5).meta == {"n": 1}


def test_a_connection_waits_for_the_listener(tmp_path):
    for url in ("memory/late", f"socket/{tmp_path}/late"):
        opened = []
        late = threading.Timer(
            0.2, lambda url=url, opened=opened: opened.append(urls.listen(url, "learner"))
        )
        late.start()
        with urls.connect(url, "observer", wait=10.0):
            late.join(10.0)
            opened[0].close()


def test_certificates_follow_from_the_role(certs):
    assert urls.find_credentials(None, "client") is None
    assert urls.find_credentials(certs, "observer") == Credentials(certs / "observer.0", "observer")
    assert urls.name_on_wire("gpu-1", None) == "gpu-1"
    assert urls.name_on_wire("gpu-1", certs / "actor.1") == "1.gpu-1"
    url = local_url()
    with (
        urls.listen(url, "learner", certs=certs) as learner,
        urls.connect(url, "actor", certs=certs / "actor.1") as actor,
    ):
        learner.serve(KEYS.tickets, lambda key, message: message)
        assert actor.query(KEYS.ticket("1.a"), Message(), timeout=5)
        with pytest.raises(TransportError):
            actor.query(KEYS.ticket("0.a"), Message(), timeout=5)
    with pytest.raises(CongraspError, match="has the role actor, not observer"):
        urls.connect(url, "observer", certs=certs / "actor.1")


def test_without_cryptography_a_client_does_not_check_certificates(certs, monkeypatch):
    monkeypatch.setattr(urls.importlib.util, "find_spec", lambda name: None)
    assert urls.find_credentials(str(certs / "actor.1"), "client") == Credentials(
        certs / "actor.1", "client"
    )


def test_beyond_loopback_nothing_listens_unprotected():
    with pytest.raises(CongraspError, match="other machines"):
        urls.listen(f"tcp/0.0.0.0:{free_port()}", "server")
    with urls.listen(f"tcp/0.0.0.0:{free_port()}", "server", insecure=True):
        pass


# --- an actor and a learner over any of them ---


def work(url):
    """What an actor does: takes a ticket and weights, and uploads a rollout."""
    with (
        urls.connect(url, "actor") as transport,
        ActorLink(transport, "test", "a", request_timeout=5.0) as link,
    ):
        assert link.config(10).schema == "s"
        ticket = link.acquire_ticket(5)
        version = link.weights(-1).meta["version"]
        assert link.upload(rollout(3.0, version=version), ticket).result(10) == "accepted"


def in_thread(url):
    thread = threading.Thread(target=work, args=(url,))
    thread.start()
    return thread


def in_process(url):
    process = multiprocessing.get_context("spawn").Process(target=work, args=(url,))
    process.start()
    return process


@pytest.mark.parametrize(
    ("scheme", "start"),
    [("memory", in_thread), ("socket", in_thread), ("socket", in_process), ("tcp", in_process)],
)
def test_a_rollout_reaches_the_learner_over_any_transport(scheme, start, tmp_path):
    url = {"memory": f"memory/{tmp_path}", "socket": f"socket/{tmp_path}/s", "tcp": local_url()}[
        scheme
    ]
    with urls.listen(url, "learner") as transport:
        hub, rollouts = learner_hub(transport, "test")
        hub.publish_weights(bundle(0), 0)
        actor = start(url)
        (message,) = eventually(lambda: rollouts.next_batch(1, 0.5))
        assert (message.arrays["reward"] == 3.0).all()
        assert message.meta["actor"] == "a"
        assert hub.status()["counters"]["accepted"] == 1
        actor.join(10)
        assert not actor.is_alive()
        assert getattr(actor, "exitcode", 0) == 0
        rollouts.close()


def test_a_free_port_is_reserved_while_its_process_lives():
    # Above those that other tests take
    script = TAKER.format(lowest=30_000 + 61 * (os.getpid() % 40))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}

    def taker():
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        return stack.enter_context(
            subprocess.Popen([sys.executable, "-c", script], env=environment, **pipes)
        )

    def take(process, count):
        process.stdin.write(f"{count}\n")
        process.stdin.flush()
        return json.loads(process.stdout.readline())

    with contextlib.ExitStack() as stack:
        one = taker()
        other = taker()
        taken = take(one, 20)
        ports = take(other, 20)
        assert len({*taken, *ports}) == 40
        one.stdin.close()
        assert one.wait(20) == 0
        # Twenty were left: those of the process that ended are free again.
        assert len({*ports, *take(other, 30)}) == 50
        other.stdin.close()
        assert other.wait(20) == 0
