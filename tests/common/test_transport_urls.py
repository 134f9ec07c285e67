"""URL and role are all that a process names: flows, ports and certificates follow, whatever carries the messages."""

import multiprocessing
import threading
import time

import pytest

import tests.socket_transport  # noqa: F401  adds its scheme
from actors.link import ActorLink
from common.errors import CongraspError, TransportError
from common.transport import ports, urls
from common.transport.keys import FLOWS, Keys, flow
from common.transport.ports import free_port, local_url, rank_url, reachable_url
from common.transport.security import RIGHTS, Credentials
from common.wire.codec import Message
from common.wire.schema import RolloutForm
from learner.hub import LearnerHub
from learner.staleness import StalenessManager
from services.ops.certificates import create_authority, issue
from tests.cluster import A, B, D, T, bundle, rollout

pytestmark = pytest.mark.timeout(60)
KEYS = Keys("test")


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
            assert urls.LISTENER_FLOWS[listener][: len(opened)] == opened  # so that their ports are the same


@pytest.mark.parametrize("url", ["carrier-pigeon/loft", "127.0.0.1:7447", ""])
def test_an_unknown_scheme_is_named_with_those_that_are_known(url):
    with pytest.raises(CongraspError, match=rf"'{url}' is not an endpoint\. Write it like tcp/.*memory, tcp, tls"):
        urls.connect(url, "actor")


def test_ports_follow_from_the_url():
    assert rank_url("tls/[::]:7447", 2) == f"tls/[::]:{7447 + 2 * len(FLOWS)}"
    assert rank_url("socket/anywhere", 0) == "socket/anywhere"
    with pytest.raises(CongraspError, match="is not an endpoint"):
        rank_url("socket/anywhere", 1)
    assert reachable_url("tls/0.0.0.0:7447") == reachable_url("tls/[::]:7447") == "tls/127.0.0.1:7447"
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


def test_who_connects_waits_for_the_listener(tmp_path):
    for url in ("memory/late", f"socket/{tmp_path}/late"):
        opened = []
        late = threading.Timer(0.2, lambda url=url, opened=opened: opened.append(urls.listen(url, "learner")))
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
    with pytest.raises(CongraspError, match="for the role actor, not observer"):
        urls.connect(url, "observer", certs=certs / "actor.1")


def test_a_client_without_cryptography_leaves_the_judgement_to_its_peer(certs, monkeypatch):
    monkeypatch.setattr(urls.importlib.util, "find_spec", lambda name: None)
    assert urls.find_credentials(str(certs / "actor.1"), "client") == Credentials(certs / "actor.1", "client")


def test_beyond_loopback_nothing_listens_unprotected():
    with pytest.raises(CongraspError, match="other machines"):
        urls.listen(f"tcp/0.0.0.0:{free_port()}", "server")
    with urls.listen(f"tcp/0.0.0.0:{free_port()}", "server", insecure=True):
        pass


# --- an actor and a learner over any of them ---


def work(url):
    """What an actor does: takes a ticket and weights, and uploads a rollout."""
    with urls.connect(url, "actor") as transport, ActorLink(transport, "test", "a", request_timeout=5.0) as link:
        assert link.config(10).schema == "s"
        ticket = link.acquire_ticket(5)
        version = link.weights(-1).meta["version"]
        assert link.upload(rollout(T, 3.0, version), ticket).result(10) == "accepted"


def in_thread(url):
    thread = threading.Thread(target=work, args=(url,))
    thread.start()
    return thread


def in_process(url):
    process = multiprocessing.get_context("spawn").Process(target=work, args=(url,))
    process.start()
    return process


@pytest.mark.parametrize(
    ("scheme", "start"), [("memory", in_thread), ("socket", in_thread), ("socket", in_process), ("tcp", in_process)]
)
def test_a_rollout_reaches_the_learner_over_any_transport(scheme, start, tmp_path):
    url = {"memory": f"memory/{tmp_path}", "socket": f"socket/{tmp_path}/s", "tcp": local_url()}[scheme]
    with urls.listen(url, "learner") as transport:
        hub = LearnerHub(
            transport, run="test", config_json="{}", run_id="e", schema="s",
            form=RolloutForm(T, B, D, A, half=True), staleness=StalenessManager(1, 1),
        )  # fmt: skip
        hub.publish_weights(bundle(0, "e"), 0)
        actor, deadline = start(url), time.monotonic() + 30.0
        while (batch := hub.next_batch(1, 0.5)) is None:
            assert time.monotonic() < deadline
        (message,) = batch
        assert (message.arrays["reward"] == 3.0).all() and message.meta["actor"] == "a"
        assert hub.status()["ledger"]["accepted"] == 1
        actor.join(10)
        assert not actor.is_alive() and getattr(actor, "exitcode", 0) == 0
        hub.close()


def _reserve_ports(number: int, ours) -> None:
    ports._COUNT = FEW
    ours.send([free_port(1) for _ in range(number)])
    ours.recv()  # lives until told to end


FEW = 61
"""Ports to choose from, less one: so few that one would be chosen twice."""


def test_no_port_is_given_twice_while_its_process_lives(monkeypatch):
    monkeypatch.setattr(ports, "_COUNT", FEW)
    context = multiprocessing.get_context("spawn")
    theirs, ours = context.Pipe()
    other = context.Process(target=_reserve_ports, args=(20, theirs))
    other.start()
    assert ours.poll(30)
    taken = ours.recv()
    mine = [free_port(1) for _ in range(20)]
    assert len({*taken, *mine}) == 40
    ours.send("end")
    other.join(10)
    assert other.exitcode == 0
    assert len({free_port(1) for _ in range(30)}) == 30  # twenty were left: those of the ended process are free again
