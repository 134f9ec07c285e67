"""All transports behave alike, one from outside among them; Zenoh's ends refuse what they should,
and end.
"""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest

from congrasp.common.errors import CongraspError, OverloadedError, RefusedError, TransportError
from congrasp.common.runtime import platforms
from congrasp.common.transport import zenoh_session
from congrasp.common.transport.keys import Keys, check_name, flow, matches, parse_alive
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.transport.ports import free_port
from congrasp.common.transport.zenoh_session import STAMP, LostSamples
from congrasp.common.transport.zenoh_transport import MessageLimits, ZenohTransport
from congrasp.common.wire.codec import Message, encode
from tests.modules import fresh_copy
from tests.socket_transport import SocketListener, SocketTransport
from tests.waits import eventually, together

KEYS = Keys("test")
BUSY_PROCESS = """
    import contextlib, socket, sys, threading, time
    from congrasp.common.transport.keys import Keys
    from congrasp.common.transport.zenoh_transport import ZenohTransport
    from congrasp.common.wire.codec import Message
    keys = Keys("test")
    address = "127.0.0.1", int(sys.argv[1].rpartition(":")[2])
    server = ZenohTransport(listen=[sys.argv[1]])
    client = ZenohTransport(connect=[sys.argv[1]])
    server.serve(keys.act, lambda key, message: message, workers=2)
    server.watch_alive(keys.everyone, lambda key, alive: None)
    client.declare_alive(keys.alive("actor", "a", "01"))
    subscription = server.subscribe(keys.logs, depth=1)
    client.publish(keys.log("event", "actor", "a"), Message())
    client.query(keys.act, Message(), timeout=60)
    def ask():
        while True:
            with contextlib.suppress(Exception):
                client.query(keys.act, Message(), timeout=60)
    for _ in range(3):
        threading.Thread(target=ask, daemon=True).start()
    print("ready", flush=True)
    {end}
"""
SILENT_CONNECTION = (
    "silent = socket.create_connection(address); "
    "later = ZenohTransport(connect=[sys.argv[1]]); "
    "sys.slow = type('Slow', (), {'__del__': lambda slow, sleep=time.sleep: sleep(4)})(); "
    "sys.exit(3)"
)
"""Delays the closing of the listener; it returns while the interpreter shuts down slowly."""


@pytest.fixture(params=["memory", "zenoh", "from outside"])
def pair(request, tmp_path):
    """Two endpoints that see each other; the first is the one that listens."""
    if request.param == "memory":
        hub = MemoryHub()
        ends = MemoryTransport(hub), MemoryTransport(hub)
    elif request.param == "zenoh":
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        ends = ZenohTransport(listen=[endpoint]), ZenohTransport(connect=[endpoint])
    else:
        path = str(tmp_path / "s")
        ends = SocketListener(path), SocketTransport(path, 60.0)
    yield ends
    for end in ends:
        end.close()
        end.close()


def test_flows_and_keys():
    assert KEYS.rollout("a") == "congrasp/test/rollout/a"
    assert [
        flow(key) for key in (KEYS.config, KEYS.ticket("a"), KEYS.status, KEYS.announcement)
    ] == ["control"] * 4
    assert flow(KEYS.everyone) == flow(KEYS.alive("actor", "a", "0f")) == "control"
    assert flow(KEYS.rollout("announce")) == flow(KEYS.weights) == "bulk"
    assert flow(KEYS.logs) == flow(KEYS.log("metrics", "actor", "a")) == "log"
    assert flow(KEYS.act) == flow(KEYS.health) == "policy"
    assert parse_alive(KEYS.alive("actor", "a", "0f")) == ("actor", "a", "0f")
    assert parse_alive(KEYS.config) is None
    with pytest.raises(CongraspError, match=r"'\*\*'"):
        Keys("**")
    with pytest.raises(CongraspError, match="actor"):
        check_name("actor", "a/b")


@pytest.mark.parametrize(
    ("expression", "key", "expected"),
    [
        ("a/b", "a/b", True),
        ("a/b", "a/bc", False),
        ("a/*", "a/b", True),
        ("a/*", "a/b/c", False),
        ("a/**", "a", True),
        ("a/**", "a/b/c", True),
        ("**/c", "a/b/c", True),
        ("a/**/c", "a/c", True),
        ("a/**/c", "a/b/d", False),
        ("a.c", "abc", False),
    ],
)
def test_expressions_match_as_zenoh_matches(expression, key, expected):
    import zenoh

    assert matches(expression, key) is expected
    assert zenoh.KeyExpr(expression).includes(zenoh.KeyExpr(key)) is expected


def test_query_is_answered_with_its_arrays(pair):
    server, client = pair
    server.serve(KEYS.act, lambda key, m: Message({"y": m.arrays["x"] * 2}, {"key": key, **m.meta}))
    for index in range(20):
        x = np.arange(index, dtype=np.float32)
        reply = client.query(KEYS.act, Message({"x": x}, {"n": index}), timeout=60)
        np.testing.assert_array_equal(reply.arrays["y"], 2 * x)
        assert reply.meta == {"key": KEYS.act, "n": index}


def test_both_ends_can_serve(pair):
    server, client = pair
    client.serve(KEYS.act, lambda key, m: Message(meta={"from": "client"}))
    eventually(lambda: _answers(server, KEYS.act))
    assert server.query(KEYS.act, Message(), timeout=60).meta == {"from": "client"}


def _answers(transport, key):
    try:
        return transport.query(key, Message(), timeout=1)
    except TransportError:
        return False


def test_errors_travel_in_words(pair):
    server, client = pair

    def handler(key, message):
        if message.meta["bug"]:
            raise ValueError("secret")
        if message.meta.get("busy"):
            raise OverloadedError("Ask later.")
        raise CongraspError("The hand is unknown.", "Choose another.")

    server.serve(KEYS.act, handler)
    with pytest.raises(RefusedError, match=r"^The hand is unknown\. Choose another\.$"):
        client.query(KEYS.act, Message(meta={"bug": False}), timeout=60)
    with pytest.raises(RefusedError, match="ValueError") as caught:
        client.query(KEYS.act, Message(meta={"bug": True}), timeout=60)
    assert "secret" not in str(caught.value)
    assert type(caught.value) is RefusedError
    with pytest.raises(OverloadedError, match=r"^Ask later\.$"):
        client.query(KEYS.act, Message(meta={"bug": False, "busy": True}), timeout=60)


def test_silence_has_a_deadline(pair):
    server, client = pair
    release = threading.Event()
    server.serve(KEYS.act, lambda key, m: Message(meta={"late": release.wait(20)}))
    start = time.monotonic()
    with pytest.raises(TransportError, match=r"within 0\.3 s") as caught:
        client.query(KEYS.act, Message(), timeout=0.3)
    assert not isinstance(caught.value, RefusedError)
    assert 0.25 < time.monotonic() - start < 15
    with pytest.raises(TransportError, match="No response"):
        client.query(KEYS.health, Message(), timeout=60)
    release.set()


def test_workers_answer_at_the_same_time(pair):
    server, client = pair
    barrier = threading.Barrier(3)
    server.serve(KEYS.act, lambda key, m: Message(meta={"n": barrier.wait(60)}), workers=3)
    seen = together(lambda _: client.query(KEYS.act, Message(), timeout=60).meta["n"], range(3))
    assert sorted(seen) == [0, 1, 2]


def test_query_after_the_server_closed_fails_at_once(pair):
    server, client = pair
    entered = threading.Event()

    def handler(key, message):
        entered.set()
        time.sleep(0.5)
        return Message()

    server.serve(KEYS.act, handler)
    failures = []

    def ask():
        try:
            client.query(KEYS.act, Message(), timeout=30)
        except TransportError as error:
            failures.append(error)

    waiting = [threading.Thread(target=ask, daemon=True) for _ in range(3)]
    for thread in waiting:
        thread.start()
    assert entered.wait(60)
    server.close()
    for thread in waiting:
        thread.join(60)
    assert not any(thread.is_alive() for thread in waiting)
    assert len(failures) >= 2  # one may have been in the handler, whose answer still counts
    with pytest.raises(TransportError):
        client.query(KEYS.act, Message(), timeout=1)
    with pytest.raises(TransportError, match="closed"):
        server.query(KEYS.act, Message(), timeout=1)
    server.publish(KEYS.announcement, Message())


def test_closing_waits_for_handlers_that_still_work(pair):
    server, client = pair
    began = threading.Event()
    ended = threading.Event()

    def handler(key, message):
        began.set()
        time.sleep(0.3)
        ended.set()
        return message

    server.serve(KEYS.act, handler)

    def ask():
        with contextlib.suppress(
            CongraspError
        ):  # its answer may come too late for the closing server
            client.query(KEYS.act, Message(), timeout=60)

    asker = threading.Thread(target=ask, daemon=True)
    asker.start()
    assert began.wait(60)
    server.close()
    assert ended.is_set()
    asker.join(60)


def test_subscription_keeps_the_newest_and_counts_the_rest(pair):
    server, client = pair
    subscription = client.subscribe(KEYS.logs, depth=4)
    sent = 0

    def arrived():
        nonlocal sent
        server.publish(KEYS.log("metrics", "learner", "0"), Message(meta={"n": sent}))
        sent += 1
        return subscription.receive(0.05)

    eventually(arrived)
    server.publish(KEYS.log("metrics", "learner", "0"), Message(meta={"n": -1}))
    last = None
    while last != -1:
        newest = subscription.receive(60)
        assert newest is not None
        last = newest[1].meta["n"]
    dropped = subscription.dropped
    for n in range(10):
        server.publish(KEYS.log("event", "learner", "0"), Message({"x": np.zeros(3)}, {"n": n}))
    eventually(lambda: subscription.dropped - dropped == 6)
    received = [subscription.receive(60) for _ in range(4)]
    assert [message.meta["n"] for _, message in received] == [6, 7, 8, 9]
    assert {key for key, _ in received} == {KEYS.log("event", "learner", "0")}
    assert subscription.receive(0.05) is None
    assert subscription.dropped - dropped == 6


def test_lost_samples_are_those_between_two_counts_of_a_publisher():
    lost_samples = LostSamples()
    stamps = [(b"sender-a", 5), (b"sender-a", 6), (b"sender-a", 9), (b"sender-b", 30)]
    lost = [lost_samples.before("key", STAMP.pack(*stamp)) for stamp in stamps]
    assert lost == [0, 0, 2, 0]
    assert lost_samples.before("key", b"") == 0


def test_invented_keys_are_forgotten():
    lost_samples = LostSamples()
    for number in range(5000):
        lost_samples.before(f"key {number}", STAMP.pack(b"sender-a", 0))
    gap = STAMP.pack(b"sender-a", 5)
    assert lost_samples.before("key 4999", gap) == 4
    assert lost_samples.before("key 0", gap) == 0


def test_closed_subscription_lets_its_reader_go(pair):
    subscription = pair[1].subscribe(KEYS.logs, depth=1)
    threading.Timer(0.2, subscription.close).start()
    start = time.monotonic()
    assert subscription.receive(20) is None
    assert time.monotonic() - start < 15


def test_tokens_list_the_live_peers(pair):
    server, client = pair
    early = KEYS.alive("actor", "a", "01")
    late = KEYS.alive("actor", "b", "02")
    seen = []
    client.declare_alive(early)
    server.watch_alive(KEYS.everyone, lambda key, alive: seen.append((key, alive)))
    eventually(lambda: (early, True) in seen)
    client.declare_alive(late)
    eventually(lambda: (late, True) in seen)
    client.close()
    eventually(lambda: (early, False) in seen and (late, False) in seen)


def test_memory_copies_nothing():
    hub = MemoryHub()
    server = MemoryTransport(hub)
    client = MemoryTransport(hub)
    server.serve(KEYS.act, lambda key, message: message)
    message = Message({"x": object()})
    assert client.query(KEYS.act, message, timeout=60) is message
    server.close()
    client.close()


def test_closed_endpoint_publishes_nothing(pair):
    publisher, subscriber = pair
    subscription = subscriber.subscribe(KEYS.logs, depth=100)
    key = KEYS.log("event", "learner", "0")

    def arrived():
        publisher.publish(key, Message(meta={"closed": False}))
        return subscription.receive(0.05)

    eventually(arrived)
    publisher.close()
    publisher.publish(key, Message(meta={"closed": True}))
    while received := subscription.receive(0.3):
        assert received[1].meta == {"closed": False}


def test_closing_ends_more_workers_than_places():
    hub = MemoryHub()
    server = MemoryTransport(hub)
    server.serve(KEYS.act, lambda key, message: message, workers=3, depth=1)
    name = f"memory-{KEYS.act}"
    workers = [thread for thread in threading.enumerate() if thread.name == name]
    assert len(workers) == 3
    server.close()
    assert not any(thread.is_alive() for thread in workers)


# --- Zenoh only ---


def test_busy_port_is_named():
    base = free_port()
    with (
        ZenohTransport(listen=[f"tcp/127.0.0.1:{base}"]),
        pytest.raises(CongraspError, match=f"port of tcp/127.0.0.1:{base} is in use.*--listen"),
    ):
        ZenohTransport(listen=[f"tcp/127.0.0.1:{base}"])
    with ZenohTransport(listen=[f"tcp/127.0.0.1:{base}"]):
        pass


def test_busy_port_of_a_later_flow_frees_the_earlier_ones():
    base = free_port()
    with socket.socket() as other:
        other.bind(("127.0.0.1", base + 1))
        other.listen()
        with pytest.raises(CongraspError, match=f"{base + 1} is in use"):
            ZenohTransport(listen=[f"tcp/127.0.0.1:{base}"])
    with ZenohTransport(listen=[f"tcp/127.0.0.1:{base}"]):
        pass


@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("tcp/127.0.0.1:65535", "four ports"),
        ("tcp/::1:7447", r"brackets.*tcp/\[::1\]:7447"),
        ("tcp/no-such-host.invalid:7447", "host name 'no-such-host.invalid'"),
    ],
)
def test_unusable_endpoint_names_its_fault(endpoint, words):
    with pytest.raises(CongraspError, match=words):
        ZenohTransport(connect=[endpoint], wait=0.1)


@pytest.mark.parametrize(
    "endpoint",
    ["127.0.0.1:7447", "tcp/127.0.0.1", "tcp/127.0.0.1:99999", ""],
)
def test_malformed_endpoint_is_named(endpoint):
    with pytest.raises(CongraspError, match=r"is not an endpoint.*Write it like tcp/"):
        ZenohTransport(listen=[endpoint])


def test_absent_peer_is_an_error_with_a_deadline():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    start = time.monotonic()
    with pytest.raises(TransportError, match=f"No response from {endpoint}"):
        ZenohTransport(connect=[endpoint], wait=0.2)
    assert time.monotonic() - start < 15


def test_flows_decide_the_ports():
    base = free_port()
    with (
        ZenohTransport(listen=[f"tcp/127.0.0.1:{base}"], flows=["policy"]) as server,
        ZenohTransport(connect=[f"tcp/127.0.0.1:{base}"], flows=["policy"]) as client,
    ):
        server.serve(KEYS.act, lambda key, message: message)
        assert client.query(KEYS.act, Message(meta={"n": 1}), timeout=60).meta == {"n": 1}
        with pytest.raises(TransportError, match="no flow"):
            client.query(KEYS.rollout("a"), Message(), timeout=60)


def test_damaged_and_oversized_messages_are_refused():
    import zenoh

    endpoint = f"tcp/127.0.0.1:{free_port()}"
    damaged = []
    with (
        ZenohTransport(listen=[endpoint], limits=MessageLimits(message=1 << 20)) as server,
        ZenohTransport(connect=[endpoint]) as client,
    ):
        server.serve(
            KEYS.act,
            lambda key, message: message,
            on_damage=lambda key, error: damaged.append(str(error)),
        )
        session = client.session(KEYS.act)
        intact = encode(Message({"x": np.zeros(8)}))
        for payload in (b"", intact[:-1], b"\xff" * 8 + intact[8:], intact[:-1] + b"\x01"):
            reply = next(iter(session.get(KEYS.act, payload=payload, timeout=60)))
            assert reply.err is not None
            assert b"message" in reply.err.payload.to_bytes().lower()
        assert len(damaged) == 4
        assert "checksum" in damaged[3]
        # Zenoh drops what is longer than the receiver takes, and the link goes on.
        assert not [r for r in session.get(KEYS.act, payload=bytes(2 << 20), timeout=0.5) if r.ok]
        assert client.query(KEYS.act, Message(meta={"n": 1}), timeout=60).meta == {"n": 1}
        with pytest.raises(CongraspError, match="the limit is 1048576"):
            server.publish(KEYS.log("rollout", "actor", "a"), Message({"x": np.zeros(1 << 20)}))
        assert isinstance(session, zenoh.Session)


def test_peer_that_comes_back_is_found_again():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    server = ZenohTransport(listen=[endpoint])
    with ZenohTransport(connect=[endpoint]) as client:
        seen = []
        client.declare_alive(KEYS.alive("actor", "a", "01"))
        server.close()
        with pytest.raises(TransportError):
            client.query(KEYS.act, Message(), timeout=1)
        with ZenohTransport(listen=[endpoint]) as server:
            server.serve(KEYS.act, lambda key, message: message)
            server.watch_alive(KEYS.everyone, lambda key, alive: seen.append(alive))
            eventually(lambda: _answers(client, KEYS.act))
            eventually(lambda: seen == [True])


@pytest.mark.parametrize(
    ("end", "code"),
    [
        ("pass", 0),
        ("raise RuntimeError('unhandled')", 1),
        ("server.close(); client.close(); server.close()", 0),
        (SILENT_CONNECTION, 3),
        ("time.sleep(60)", -signal.SIGTERM),
    ],
)
def test_process_always_ends(end, code):
    script = textwrap.dedent(BUSY_PROCESS).replace("{end}", end)
    process = subprocess.Popen(
        [sys.executable, "-c", script, f"tcp/127.0.0.1:{free_port()}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        assert process.stdout.readline() == b"ready\n"
        if code < 0:
            process.send_signal(signal.SIGTERM)
        assert process.wait(30) == code
    finally:
        process.kill()
        process.communicate()


def test_admission_sends_requests_away_unread(pair):
    server, client = pair
    server.serve(
        "congrasp/test/ticket/*",
        lambda key, request: Message(meta={"read": True}),
        admission=lambda key: Message(meta={"later": key}) if key.endswith("/b") else None,
    )
    assert client.query(KEYS.ticket("a"), Message(), timeout=60).meta == {"read": True}
    assert client.query(KEYS.ticket("b"), Message(), timeout=60).meta == {"later": KEYS.ticket("b")}


@pytest.mark.parametrize(
    ("given", "merged"),
    [
        ("(tx: (handover: acc))", "(acc: (worker_threads: 64), tx: (handover: acc))"),
        (
            "AbstractRuntimeParam(tx: (worker_threads: 2))",
            "AbstractRuntimeParam(acc: (worker_threads: 64), tx: (worker_threads: 2))",
        ),
        ("(acc : (worker_threads: 3))", "(acc : (worker_threads: 3))"),
        ("/* mine */ (tx: (worker_threads: 2))", "/* mine */ (tx: (worker_threads: 2))"),
        ("", "(acc: (worker_threads: 64), )"),
    ],
)
def test_listener_threads_are_merged_into_the_users_settings(given, merged):
    code = "import os, congrasp.common.transport.zenoh_session; print(os.environ['ZENOH_RUNTIME'])"
    env = {**os.environ, "ZENOH_RUNTIME": given}
    assert (
        subprocess.check_output([sys.executable, "-c", code], env=env, text=True) == f"{merged}\n"
    )


def test_listener_threads_start_with_the_users_settings():
    script = (
        "import os, sys; from congrasp.common.transport.zenoh_transport import ZenohTransport as "
        "T; "
    )
    script += (
        "T(listen=sys.argv[1:]); print(len(os.listdir('/proc/self/task')), "
        "os.environ['ZENOH_RUNTIME'])"
    )
    command = [sys.executable, "-c", script, f"tcp/127.0.0.1:{free_port()}"]
    env = {**os.environ, "ZENOH_RUNTIME": "(tx: (worker_threads: 2))"}
    threads, settings = subprocess.run(
        command, capture_output=True, env=env, check=True
    ).stdout.split(b" ", 1)
    assert int(threads) > zenoh_session.CLOSERS
    assert b"tx: (worker_threads: 2)" in settings


@pytest.mark.parametrize(
    ("given", "sound"),
    [
        *(
            (text, False)
            for text in (
                "acc",
                "(tx: (worker_threads: 2)",
                "(tx: (worker_threads: two))",
                "(tx: 2)",
            )
        ),
        *(
            (text, False)
            for text in ("(all: ())", "(tx: (handover: all))", "(tx: (threads: 2))", "(tx: (),,)")
        ),
        *((text, False) for text in ("(tx: (), tx: ())", "(tx: (max_blocking_threads: 0))")),
        (
            "#![enable(implicit_some)] ( tx: (worker_threads: 1_0,), /* of\nmine */ rx: (handover: "
            "Some(tx)), )",
            True,
        ),
        ("AbstractRuntimeParam(app: (worker_threads: 2, max_blocking_threads: 9)) // mine", True),
    ],
)
def test_thread_settings_that_panic_zenoh_are_refused(monkeypatch, given, sound):
    monkeypatch.setenv("ZENOH_RUNTIME", given)
    session = fresh_copy(zenoh_session)
    with (
        contextlib.nullcontext()
        if sound
        else pytest.raises(CongraspError, match=r"ZENOH_RUNTIME is '.*Unset it")
    ):
        session.configuration("policy", ["tcp/127.0.0.1:7457"], False, 1 << 20, None)


@pytest.mark.parametrize(("hard", "files", "warnings"), [(1024, 1024, 1), (20_000, 16_384, 0)])
def test_a_listener_raises_its_file_limit_or_warns_once(monkeypatch, caplog, hard, files, warnings):
    """Zenoh panics in a process that has no file left."""
    limits = [(1024, hard)]
    monkeypatch.setattr(platforms.resource, "getrlimit", lambda kind: limits[-1])
    monkeypatch.setattr(platforms.resource, "setrlimit", lambda kind, limit: limits.append(limit))
    session = fresh_copy(zenoh_session)
    for _ in range(2):
        settings = session.configuration("policy", ["tcp/127.0.0.1:7457"], True, 1 << 20, None)
    taken = [
        int(settings.get_json(f"transport/unicast/{name}"))
        for name in ("accept_pending", "max_sessions")
    ]
    assert taken == [files // 4, min(1000, files // 4)]
    assert limits[-1] == (files, hard)
    assert [record.args for record in caplog.records] == [(files, files // 4, 16_384)] * warnings
