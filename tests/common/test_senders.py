"""The client that a query counts for, over real connections."""

import contextlib
import types

import pytest

from congrasp.common.transport.keys import Keys, below
from congrasp.common.transport.ports import free_port
from congrasp.common.transport.senders import Peer, sender
from congrasp.common.transport.urls import find_credentials, name_on_wire
from congrasp.common.transport.zenoh_senders import Senders, Sources
from congrasp.common.transport.zenoh_transport import ZenohTransport
from congrasp.common.wire.codec import Message, encode
from congrasp.services.ops.certificates import create_authority, issue
from tests.bare_zenoh import bare_session

KEYS = Keys("policy")


@pytest.fixture
def listening():
    """Context manager of a listener; yields its port and the senders of its queries."""

    @contextlib.contextmanager
    def listen(credentials=None):
        port = free_port()
        senders = []

        def answer(key, request):
            senders.append(sender(key))
            return Message()

        scheme = "tls" if credentials else "tcp"
        with ZenohTransport(
            listen=[f"{scheme}/0.0.0.0:{port}"], flows=("policy",), credentials=credentials
        ) as transport:
            transport.serve(below(KEYS.act), answer)
            yield port, senders

    return listen


def ask(endpoint, *names, credentials=None):
    """Sends a query under each name, from one connection."""
    with ZenohTransport(
        connect=[endpoint], flows=("policy",), credentials=credentials
    ) as transport:
        for name in names:
            transport.query(KEYS.act_for(name), Message(), timeout=5.0)


def ask_from(address, port, *names):
    """Sends a query under each name, from one connection of an address."""
    with bare_session("client", connect=f"tcp/127.0.0.1:{port}#bind={address}:0") as session:
        for name in names:
            key = KEYS.act_for(name)
            mark = Sources().of_session(session, key)
            list(session.get(key, payload=encode(Message()), timeout=5.0, source_info=mark))


def test_names_and_connections_of_an_address_are_one_account(listening):
    with listening() as (port, senders):
        ask_from("127.0.0.1", port, "a", "b")
        ask_from("127.0.0.1", port, "c")
        ask_from("127.0.0.2", port, "a")
    accounts = [one.account for one in senders]
    assert accounts == ["127.0.0.1", "127.0.0.1", "127.0.0.1", "127.0.0.2"]
    connections = [one.name for one in senders]
    assert connections[0] == connections[1]
    assert len(set(connections)) == 3


def test_foreign_clients_are_one_account(listening):
    with listening() as (port, senders):
        for name in ("a", "b"):
            with bare_session("client", connect=f"tcp/127.0.0.1:{port}") as session:
                query = encode(Message())
                list(session.get(KEYS.act_for(name), payload=query, timeout=5.0))
    assert len(senders) == 2
    assert senders[0].account == senders[1].account


class Connections:
    """Session of a listener with one connection, which counts its listings."""

    def __init__(self):
        self.info = self
        self.listings = 0

    def links(self):
        self.listings += 1
        return [types.SimpleNamespace(zid="real", dst="tcp/10.0.0.7:50000")]


def query_of(source):
    """A query of a source."""
    identity = types.SimpleNamespace(zid=source)
    return types.SimpleNamespace(source_info=types.SimpleNamespace(source_id=identity))


def test_invented_sources_are_few_peers_and_listings():
    connections = Connections()
    senders = Senders(lambda: connections, has_certificates=False)
    invented = set()
    for number in range(5000):
        key = KEYS.act_for(f"name-{number}")
        invented.add(senders.of_query(query_of(f"invented {number}"), key))
        real = senders.of_query(query_of("real"), KEYS.act)
        assert real == Peer("10.0.0.7", "real")
    assert len(invented) <= 64
    assert len({peer.account for peer in invented}) == 1
    assert connections.listings < 2500


def test_names_of_a_certificate_are_one_account(listening, tmp_path):
    create_authority(tmp_path / "certs")
    server = issue(tmp_path / "certs", "server")
    with listening(find_credentials(server, "server")) as (port, senders):
        for _ in range(2):
            folder = issue(tmp_path / "certs", "client")
            names = [name_on_wire(name, folder, "client") for name in ("a", "b")]
            ask(f"tls/127.0.0.1:{port}", *names, credentials=find_credentials(folder, "client"))
    accounts = [one.account for one in senders]
    assert accounts[0] == accounts[1] != accounts[2] == accounts[3]
