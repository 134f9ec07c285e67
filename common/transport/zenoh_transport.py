"""Messages over Zenoh.

One process listens (the learner or a policy server), the others connect to it, and it forwards between them. Each flow
has a session, so a TCP connection, of its own: on one shared link a rollout of some megabytes would delay a ticket, and
a recorder that reads slowly would delay both. Flow number i uses the port i above the one that was given.

Everything is received through channels that own daemon threads drain; a callback would keep the process from ending.
"""

import contextlib
import functools
import json
import logging
import re
import secrets
import struct
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from typing import Any, Self

import zenoh
from zenoh.handlers import FifoChannel

from common.errors import CongraspError, TransportError, error_of
from common.transport.base import Admission, Answerer, Damage, Subscription, join
from common.transport.keys import FLOWS, Flow, flow
from common.transport.ports import shifted
from common.transport.security import Credentials, refusal, secured
from common.wire.codec import MAX_MESSAGE, Message, decode, encode

_LEASE_MS: dict[Flow, int] = {"control": 2500, "bulk": 10000, "log": 10000, "policy": 2500}
_BLOCK_US: dict[Flow, int] = {"control": 2_000_000, "bulk": 5_000_000, "log": 1_000_000, "policy": 2_000_000}
_OVERHEAD = 64 << 10  # bytes that Zenoh may add to a message
_ATTEMPT = 1.0  # seconds of one attempt to connect; signals are seen between two
_CLOSE = 0.5  # seconds that closing may take
_QUEUE = 256  # samples that wait for a thread that only moves them on
_STAMP = struct.Struct("<8sQ")  # sender and count, by which a listener sees gaps
_log = logging.getLogger(__name__)


class ZenohTransport:
    """A `Transport` over Zenoh sessions."""

    def __init__(
        self,
        *,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        flows: Sequence[Flow] = FLOWS,
        max_message: int = MAX_MESSAGE,
        wait: float = 10.0,
        credentials: Credentials | None = None,
    ):
        """Opens the sessions.

        Args:
          connect: endpoints to connect to, such as `tcp/192.168.0.5:7447`; the first that answers is taken, and found
            again whenever it comes back.
          listen: endpoints to listen on, instead.
          flows: which flows to open; flow i uses the port i above the endpoint's, so both ends must start alike.
          max_message: bytes of the longest message.
          wait: seconds to wait for somebody to listen at `connect`.
          credentials: everything goes over mutual TLS with these; one that listens allows each role what
            `common.transport.security` gives it, and nothing else.

        Raises:
          CongraspError: an endpoint or key is malformed, a port is in use, or the certificates are not accepted.
          TransportError: there is no response.
        """
        if bool(connect) == bool(listen):
            raise CongraspError("A transport needs endpoints either to connect to or to listen on.")
        wanted = [secured(one, credentials) for one in (connect or listen)]
        endpoints = {name: [shifted(one, i) for one in wanted] for i, name in enumerate(flows)}
        self._max_message = max_message
        self._sender = secrets.token_bytes(8)
        self._counts: dict[str, int] = {}
        self._counts_lock = threading.Lock()
        self._declared: list[Any] = []
        self._work = _Work()
        self._finalizer = weakref.finalize(self, self._work.close)
        deadline = time.monotonic() + wait
        try:
            for name, where in endpoints.items():
                secure = credentials.settings(name, listens=bool(listen)) if credentials else {}
                config = _config(name, where, bool(listen), max_message, secure)
                self._work.sessions[name] = (
                    _listen(config, where) if listen else _connect(config, where, deadline, credentials)
                )
        except BaseException:
            self.close()
            raise

    def serve(
        self,
        key: str,
        handler: Answerer,
        *,
        workers: int = 1,
        depth: int = 4,
        on_damage: Damage | None = None,
        admission: Admission | None = None,
    ) -> None:
        """See `Transport.serve`."""
        queryable = self._session(key).declare_queryable(key, FifoChannel(depth))
        self._declared.append(queryable)
        hooks = on_damage or (lambda *_: None), admission or (lambda _: None)
        for _ in range(workers):
            self._work.start(_serve, queryable.handler, handler, *hooks, self._max_message)

    def query(self, key: str, request: Message, *, timeout: float) -> Message:
        """See `Transport.query`."""
        payload = self._encode(request)
        refused: zenoh.ReplyError | None = None
        try:
            with self._work.inside():
                replies = self._session(key).get(
                    key,
                    FifoChannel(4),
                    payload=payload,
                    timeout=timeout,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                )
                for reply in replies:
                    if reply.ok:
                        return decode(reply.ok.payload.to_bytes(), max_bytes=self._max_message)
                    if reply.err:
                        refused = reply.err
        except zenoh.ZError as error:
            raise TransportError(f"The query for {key} failed: {_first_line(error)}.") from None
        message = refused.payload.to_bytes() if refused else b""
        if message == b"Timeout":
            raise TransportError(f"No answer for {key} within {timeout:g} s.")
        if refused is not None:
            raise error_of(str(refused.encoding).partition(";")[2], message.decode(errors="replace"))
        raise TransportError(f"No response for {key}.", "The process that serves it may have ended.")

    def publish(self, key: str, message: Message) -> None:
        """See `Transport.publish`; once closed it does nothing."""
        payload = self._encode(message)
        with self._counts_lock:
            count = self._counts.get(key, 0)
            self._counts[key] = count + 1
        try:
            with self._work.inside():
                self._session(key).put(
                    key,
                    payload,
                    congestion_control=zenoh.CongestionControl.DROP,
                    express=flow(key) == "control",
                    attachment=_STAMP.pack(self._sender, count),
                )
        except (zenoh.ZError, TransportError):
            if self._finalizer.alive:
                raise

    def subscribe(self, key_expression: str, *, depth: int) -> Subscription:
        """See `Transport.subscribe`."""
        subscriber = self._session(key_expression).declare_subscriber(key_expression, FifoChannel(_QUEUE))
        self._declared.append(subscriber)

        def undeclare() -> None:
            with contextlib.suppress(zenoh.ZError):
                subscriber.undeclare()

        subscription = Subscription(depth, undeclare)
        self._work.start(_listen_to, subscriber.handler, subscription, self._max_message)
        return subscription

    def declare_alive(self, key: str) -> None:
        """See `Transport.declare_alive`."""
        self._declared.append(self._session(key).liveliness().declare_token(key))

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """See `Transport.watch_alive`."""
        liveliness = self._session(key_expression).liveliness()
        subscriber = liveliness.declare_subscriber(key_expression, FifoChannel(_QUEUE), history=True)
        self._declared.append(subscriber)
        self._work.start(_watch, subscriber.handler, on_change)

    def close(self) -> None:
        """See `Transport.close`; takes half a second at most."""
        self._finalizer()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _session(self, key: str) -> zenoh.Session:
        """The session of the flow that a key belongs to."""
        name = flow(key)
        session = self._work.sessions.get(name)
        if session is None:
            raise TransportError(
                f"The transport has no flow for {key}." if self._finalizer.alive else "The transport is closed."
            )
        return session

    def _encode(self, message: Message) -> bytes:
        """A message as bytes; a CongraspError if it is too long."""
        payload = encode(message)
        if len(payload) > self._max_message:
            raise CongraspError(
                f"A message of {len(payload)} bytes is longer than the {self._max_message} that are allowed.",
                "Send fewer environments or steps in one rollout.",
            )
        return payload


class _Work:
    """The sessions, and the threads that are inside them.

    A thread that is inside Zenoh when the interpreter ends aborts the process, so closing waits for all of them.
    """

    def __init__(self) -> None:
        self.sessions: dict[Flow, zenoh.Session] = {}
        self._threads: list[threading.Thread] = []
        self._inside = 0
        self._changed = threading.Condition()

    def start(self, function: Callable[..., None], *arguments: Any) -> None:
        """Runs a function in a daemon thread of its own; it returns when the sessions are closed."""
        thread = threading.Thread(target=function, args=arguments, daemon=True, name=f"zenoh-{function.__name__}")
        thread.start()
        self._threads = [*(one for one in self._threads if one.is_alive()), thread]

    @contextlib.contextmanager
    def inside(self) -> Iterator[None]:
        """Around a call that a thread of the caller makes."""
        with self._changed:
            self._inside += 1
        try:
            yield
        finally:
            with self._changed:
                self._inside -= 1
                self._changed.notify_all()

    def close(self) -> None:
        """Closes the sessions, and waits a moment for the threads."""
        sessions = list(self.sessions.values())
        self.sessions.clear()
        deadline = time.monotonic() + _CLOSE
        for session in sessions:
            try:
                self.start(session.close)
            except RuntimeError:  # the interpreter is ending and starts no threads
                session.close()
        join(self._threads, deadline)
        with self._changed:
            self._changed.wait_for(lambda: not self._inside, max(0.0, deadline - time.monotonic()))


def _config(
    name: Flow, endpoints: list[str], listens: bool, max_message: int, extra: Mapping[str, Any]
) -> zenoh.Config:
    """Zenoh's configuration of one flow's session."""
    settings = {
        "mode": "peer" if listens else "client",
        "listen/endpoints": endpoints if listens else [],
        "connect/endpoints": [] if listens else endpoints,
        "connect/timeout_ms": int(1000 * _ATTEMPT),
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,  # leaks in the receiver (zenoh #2787)
        "transport/link/tx/lease": _LEASE_MS[name],
        "transport/link/tx/queue/congestion_control/block/wait_before_close": _BLOCK_US[name],
        "transport/link/rx/max_message_size": max_message + _OVERHEAD,
        **extra,
    }
    config = zenoh.Config()
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise CongraspError(f"Zenoh does not take the setting {key}: {_first_line(error)}.") from None
    return config


def _listen(config: zenoh.Config, endpoints: list[str]) -> zenoh.Session:
    """A session that listens; a CongraspError if its port is in use."""
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join(endpoints)
        if "in use" in str(error):
            raise CongraspError(
                f"The port of {where} is in use.",
                f"Stop what listens there, or choose another ({', '.join(FLOWS)} take a port each, from it on).",
            ) from None
        raise CongraspError(f"Cannot listen on {where}: {_first_line(error)}.") from None


def _connect(
    config: zenoh.Config, endpoints: list[str], deadline: float, credentials: Credentials | None
) -> zenoh.Session:
    """A session that is connected; a TransportError if nobody listens until the deadline."""
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            refusals = [refusal(one, credentials) for one in endpoints]
            if all(refusals) and refusals[0]:
                raise refusals[0] from None
            if time.monotonic() >= deadline:
                where = ", ".join(endpoints)
                remedy = "Start the learner or the server there, or correct the address."
                if "Unable to connect" in str(error):
                    raise TransportError(f"No response from {where}.", remedy) from None
                raise TransportError(f"Cannot connect to {where}: {_first_line(error)}.", remedy) from None


def _first_line(error: Exception) -> str:
    """Zenoh's words without the places in its source."""
    return re.split(r" at /|\n", str(error))[0][:200].rstrip(". ")


def _received(channel: Any) -> Iterator[Any]:
    """What comes out of a channel until it is closed."""
    with contextlib.suppress(zenoh.ZError):
        while True:
            yield channel.recv()


def _serve(queries: Any, handler: Answerer, on_damage: Damage, admission: Admission, max_message: int) -> None:
    """Answers queries, in a thread of its own, until the session closes."""
    for query in _received(queries):
        key = str(query.key_expr)
        _reply(query, key, functools.partial(_ask, query, key, handler, on_damage, admission, max_message))


def _ask(
    query: Any, key: str, handler: Answerer, on_damage: Damage, admission: Admission, max_message: int
) -> Message | Future[Message]:
    """The handler's answer to a query, unless admission or damage keeps it from the handler."""
    if (turned_away := admission(key)) is not None:
        return turned_away
    try:
        request = decode(query.payload.to_bytes() if query.payload else b"", max_bytes=max_message)
    except CongraspError as error:
        on_damage(key, error)
        raise
    return handler(key, request)


def _reply(query: Any, key: str, outcome: Callable[[], Message | Future[Message]]) -> None:
    """Answers a query with what a function returns, once it is there, or with message and code of what it raises.

    The message is the error's payload, and the code the schema of its encoding.
    """
    payload, message, code = b"", "", ""
    try:
        result = outcome()
        if isinstance(result, Future):
            result.add_done_callback(lambda done: _reply(query, key, done.result))
            return
        payload = encode(result)
    except CongraspError as error:
        message, code = str(error), error.code
    except Exception as error:
        _log.exception("The answer to %s failed.", key)
        message = f"The peer failed on {key}: {type(error).__name__}."
    with contextlib.suppress(zenoh.ZError), query:
        if message:
            encoding = zenoh.Encoding.TEXT_PLAIN.with_schema(code)
            query.reply_err(message.encode(errors="replace"), encoding=encoding)
        else:
            query.reply(key, payload)


def _listen_to(samples: Any, subscription: Subscription, max_message: int) -> None:
    """Moves samples to a subscription, with the number of those lost before each."""
    last: dict[str, tuple[bytes, int]] = {}
    for sample in _received(samples):
        key, lost = str(sample.key_expr), 0
        stamp = sample.attachment.to_bytes() if sample.attachment else b""
        if len(stamp) == _STAMP.size:
            sender, count = _STAMP.unpack(stamp)
            known_sender, known_count = last.get(key, (sender, count - 1))
            lost = max(0, count - known_count - 1) if sender == known_sender else 0
            last[key] = sender, count
        subscription.push(key, functools.partial(_decoded, sample.payload, max_message), lost)


def _decoded(payload: zenoh.ZBytes, max_message: int) -> Message:
    """A message of a payload."""
    return decode(payload.to_bytes(), max_bytes=max_message)


def _watch(samples: Any, on_change: Callable[[str, bool], None]) -> None:
    """Reports liveliness tokens, in a thread of its own, until the session closes."""
    for sample in _received(samples):
        try:
            on_change(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)
        except Exception:
            _log.exception("Could not take notice of %s.", sample.key_expr)
