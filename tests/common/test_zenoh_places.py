"""Places of a listener's connections: one address cannot keep the others out."""

import contextlib
import multiprocessing
import socket

import pytest

from congrasp.common.transport import zenoh_places, zenoh_session
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import free_port
from congrasp.common.transport.zenoh_places import Connection, ConnectionPlaces
from congrasp.common.transport.zenoh_transport import ZenohTransport
from congrasp.common.wire.codec import Message
from tests.bare_zenoh import bare_session

KEYS = Keys("policy")
PLACES = 16


def of(account: str, count: int, first_port: int = 1) -> list[Connection]:
    """Connections of an account."""
    ports = range(first_port, first_port + count)
    return [Connection(account, account, port) for port in ports]


@pytest.mark.parametrize(
    ("counts", "ended"),
    [
        ({"a": 90}, {}),  # 90 of 100 places
        ({"a": 91}, {"a": 16}),
        ({"a": 80, "b": 12}, {"a": 17}),
        ({"a": 50, "b": 45}, {"a": 13, "b": 7}),
        ({str(number): 1 for number in range(100)}, {}),
        ({str(number): 10 for number in range(10)}, {}),
        ({"a": 40, **{str(number): 1 for number in range(60)}}, {"a": 25}),
    ],
)
def test_the_account_with_the_most_loses_connections(counts, ended):
    current: list[Connection] = []
    for account, count in counts.items():
        current += of(account, count)
    excess = ConnectionPlaces(100).excess(current)
    accounts = [connection.account for connection in excess]
    assert {account: accounts.count(account) for account in set(accounts)} == ended


def test_the_newest_connections_are_ended():
    places = ConnectionPlaces(100)
    old = of("a", 75)
    new = of("a", 20, first_port=1000)
    assert not places.excess(old)
    assert set(places.excess([*new, *old])) == set(new)


def test_fewer_places_are_taken_after_an_excess(monkeypatch):
    """For a while connections in excess of 75 places are ended, then of 90 again."""
    places = ConnectionPlaces(100)
    assert len(places.excess(of("a", 91))) == 16
    assert places.is_guarded
    assert len(places.excess(of("a", 80))) == 5
    monkeypatch.setattr(zenoh_places, "GUARD_S", 0.0)
    assert len(places.excess(of("a", 80))) == 5
    assert not places.is_guarded
    assert not places.excess(of("a", 80))


def _serve_beside_a_crowd():
    """A crowd of one address takes all places and reconnects whenever it loses a connection."""
    zenoh_session.max_peers = lambda: PLACES
    zenoh_places.PERIOD_S = 0.2
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(ZenohTransport(listen=[endpoint], flows=("policy",)))
        server.serve(KEYS.health, lambda key, message: Message({}, {"ready": True}))
        for _ in range(PLACES):
            crowd = bare_session("client", connect=f"{endpoint}#bind=127.0.0.2:0")
            stack.callback(crowd.close)
        client = ZenohTransport(connect=[endpoint], flows=("policy",), wait=90.0)
        stack.enter_context(client)
        assert client.query(KEYS.health, Message(), timeout=60.0).meta == {"ready": True}


def test_a_client_of_another_address_is_served_when_full():
    """In a process of its own, whose limits this test changes."""
    process = multiprocessing.get_context("spawn").Process(target=_serve_beside_a_crowd)
    process.start()
    process.join(240)
    process.kill()
    assert process.exitcode == 0


def test_only_connections_of_the_network_are_ended():
    """A process also holds sockets without an address, such as those of an event loop."""
    with contextlib.ExitStack() as stack:
        for end in socket.socketpair():
            stack.enter_context(end)
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        client = stack.enter_context(socket.create_connection(listener.getsockname()))
        accepted, _ = listener.accept()
        stack.enter_context(accepted)
        other = stack.enter_context(socket.create_connection(listener.getsockname()))
        address, port = client.getsockname()
        zenoh_places.end_connections([Connection(address, address, port)])
        client.settimeout(10)
        assert client.recv(1) == b""
        other.sendall(b"1")
        other_accepted, _ = listener.accept()
        stack.enter_context(other_accepted)
        assert other_accepted.recv(1) == b"1"
