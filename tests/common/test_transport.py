"""Both transports keep the same promises."""

import socket
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from common.errors import CongraspError, TransportError
from common.transport.base import Transport
from common.transport.keys import alive_key, key, relative
from common.transport.memory import MemoryBroker, MemoryTransport
from common.transport.zenoh_transport import ZenohTransport
from common.wire.codec import Message

pytestmark = pytest.mark.timeout(60)
Pair = tuple[Transport, Callable[[], Transport]]


def free_port() -> int:
    """A port whose successor is free as well."""
    while True:
        with socket.socket() as first, socket.socket() as second:
            first.bind(("127.0.0.1", 0))
            port = first.getsockname()[1]
            try:
                second.bind(("127.0.0.1", port + 1))
            except (OSError, OverflowError):
                continue
            return port


@pytest.fixture(params=["memory", "zenoh"])
def pair(request) -> Iterator[Pair]:
    opened: list[Transport] = []

    def keep(transport: Transport) -> Transport:
        opened.append(transport)
        return transport

    if request.param == "memory":
        broker = MemoryBroker()
        server: Transport = keep(MemoryTransport(broker))
        yield server, lambda: keep(MemoryTransport(broker))
    else:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        server = keep(ZenohTransport(listen=endpoint))
        yield server, lambda: keep(ZenohTransport(connect=endpoint))
    for transport in reversed(opened):
        transport.close()


def _eventually(condition: Callable[[], bool], seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.01)


def test_queries_are_answered_on_both_flows(pair):
    server, connect = pair
    for name in ("config", "rollout"):
        server.serve(key("r", name), lambda k, m: Message({"twice": m.arrays["x"] * 2}, {"key": relative(k)}))
    client = connect()
    for name in ("config", "rollout"):
        reply = client.query(key("r", name), Message({"x": np.arange(3.0)}, {}), timeout=5.0)
        np.testing.assert_array_equal(reply.arrays["twice"], [0.0, 2.0, 4.0])
        assert reply.meta == {"key": name}


def test_a_refusal_arrives_in_words(pair):
    server, connect = pair

    def refuse(k: str, m: Message) -> Message:
        raise CongraspError("The hand 'paw' is unknown.", "Choose human.")

    server.serve(key("r", "config"), refuse)
    with pytest.raises(TransportError, match="'paw' is unknown. Choose human"):
        connect().query(key("r", "config"), Message({}, {}), timeout=5.0)


def test_nobody_there_is_an_error_at_once(pair):
    _, connect = pair
    began = time.monotonic()
    with pytest.raises(TransportError, match="Nobody answers"):
        connect().query(key("r", "config"), Message({}, {}), timeout=30.0)
    assert time.monotonic() - began < 10.0


def test_subscriptions_keep_the_newest_and_count_what_they_drop(pair):
    server, connect = pair
    subscription = server.subscribe(key("r", "log/**"), depth=3)
    client = connect()
    for n in range(10):
        client.publish(key("r", "log/metrics/actor/a"), Message({}, {"n": n}))
        time.sleep(0.02)
    client.publish(key("r", "other"), Message({}, {"n": -1}))
    _eventually(lambda: subscription.dropped == 7)
    got = [subscription.receive(1.0) for _ in range(3)]
    assert [message.meta["n"] for _, message in got] == [7, 8, 9]
    assert subscription.receive(0.05) is None


def test_life_and_death_are_seen(pair):
    server, connect = pair
    seen: list[tuple[str, bool]] = []
    server.watch_alive(alive_key("r", "*", "*", "*"), lambda k, alive: seen.append((k, alive)))
    client = connect()
    token = alive_key("r", "actor", "a", "1")
    client.declare_alive(token)
    _eventually(lambda: (token, True) in seen)
    client.close()
    _eventually(lambda: (token, False) in seen)


def test_closing_twice_is_fine_and_quick(pair):
    server, connect = pair
    client = connect()
    began = time.monotonic()
    client.close()
    client.close()
    assert time.monotonic() - began < 2.0


def test_a_busy_port_is_named():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohTransport(listen=endpoint), pytest.raises(CongraspError, match="busy"):
        ZenohTransport(listen=endpoint)


def test_waiting_for_nobody_ends():
    with pytest.raises(TransportError, match="Nobody listens"):
        ZenohTransport(connect=f"tcp/127.0.0.1:{free_port()}", patience=0.5)


@pytest.mark.parametrize("endpoint", ["127.0.0.1:7447", "tcp/host", "tcp/host:99999", "nonsense"])
def test_malformed_endpoints_are_named(endpoint):
    with pytest.raises(CongraspError, match="endpoint"):
        ZenohTransport(connect=endpoint, patience=0.1)


def test_a_client_outlives_a_restart_of_its_server():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    server = ZenohTransport(listen=endpoint)
    client = ZenohTransport(connect=endpoint)
    server.close()
    with ZenohTransport(listen=endpoint) as again:
        again.serve(key("r", "config"), lambda k, m: Message({}, {"ok": 1}))

        def answered() -> bool:
            try:
                return client.query(key("r", "config"), Message({}, {}), timeout=1.0).meta == {"ok": 1}
            except TransportError:
                return False

        _eventually(answered)
    client.close()


def test_a_slow_handler_meets_the_deadline():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    release = threading.Event()
    with ZenohTransport(listen=endpoint) as server, ZenohTransport(connect=endpoint) as client:
        server.serve(key("r", "config"), lambda k, m: (release.wait(5.0), m)[1])
        with pytest.raises(TransportError, match="within 0.3 s"):
            client.query(key("r", "config"), Message({}, {}), timeout=0.3)
        release.set()


def test_names_that_break_keys_are_refused():
    with pytest.raises(CongraspError, match="cannot be used"):
        key("my run", "config")
