"""Transport over Zenoh.

One process listens (the learner or a policy server); the others connect to it, and it forwards
between them. Each flow has a separate session and thus a separate TCP connection: on one shared
link, a rollout of some megabytes would delay a ticket, and a slow recorder would delay both. Flow
number i uses the port i above the given one.

Long replies are fetched in chunks (`common.transport.chunks`). Everything is received through
channels drained by daemon threads; a callback would keep the process from exiting.
"""

import functools
import secrets
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import zenoh
from zenoh.handlers import FifoChannel

from congrasp.common.errors import (
    CongraspError,
    RefusedError,
    TransportError,
    error_of,
)
from congrasp.common.transport import zenoh_session
from congrasp.common.transport.base import Admission, Answerer, Damage, Subscription, Transport
from congrasp.common.transport.chunks import CHUNK_TIMEOUT_S, Outbox, Pace, fetch
from congrasp.common.transport.keys import FLOWS, Flow, flow
from congrasp.common.transport.ports import shifted
from congrasp.common.transport.security import Credentials, secured
from congrasp.common.transport.zenoh_answers import QueryServer, QueryThreads
from congrasp.common.transport.zenoh_places import keep_places
from congrasp.common.transport.zenoh_senders import Senders, Sources
from congrasp.common.transport.zenoh_session import (
    STAMP,
    Sessions,
    first_line,
    listen_to,
    watch_tokens,
)
from congrasp.common.wire.codec import MAX_MESSAGE, Message, decode, encode

_MAX_QUEUED_SAMPLES = 256  # for a thread that only moves them on
_MAX_REPEATABLE_BYTES = 4 << 10  # of a query that may be sent twice
_REVOCATION_PERIOD_S = 5.0  # between two checks of the list of revoked certificates


class MessageLimits(NamedTuple):
    """Limits of the lengths of messages, in bytes."""

    message: int = MAX_MESSAGE
    """Any message; `zenoh_session.LONGEST` has lower limits for some flows."""
    rollout: int | None = None
    """Rollouts that a listener accepts; by default `message`."""

    def of_flow(self, name: Flow) -> int:
        """Limit of the messages of a flow."""
        if name == "bulk" and self.rollout:
            return self.rollout
        return self.message


_DEFAULT_LIMITS = MessageLimits()


class _Reply(NamedTuple):
    """A reply to a query, or its first chunk."""

    payload: bytes
    head: bytes
    """Attachment of the first chunk of a longer reply; empty for a complete one."""


class ZenohTransport(Transport):
    """A `Transport` over Zenoh sessions."""

    def __init__(
        self,
        *,
        connect: Sequence[str] = (),
        listen: Sequence[str] = (),
        flows: Sequence[Flow] = FLOWS,
        limits: MessageLimits = _DEFAULT_LIMITS,
        wait: float = 10.0,
        credentials: Credentials | None = None,
        revocation_seconds: float = _REVOCATION_PERIOD_S,
    ):
        """Opens the sessions.

        Args:
          connect: endpoints to connect to, such as `tcp/192.168.0.5:7447`. Zenoh opens a session to
            the first, and reopens a lost one to the first of all that responds.
          listen: endpoints to listen on instead.
          flows: flows to open; flow i uses the port i above the endpoint's, so the flows of both
            ends must start alike.
          limits: limits of the lengths of messages.
          wait: seconds to wait for a listener at `connect`.
          credentials: credentials for mutual TLS; a listener restricts each role to its rights in
            `common.transport.security`. None uses plain TCP.
          revocation_seconds: period of the checks for revoked certificates. A listener then reopens
            all connections; a connecting transport closes if its listener's certificate is revoked.

        Raises:
          CongraspError: an endpoint or key is malformed, a port is in use, or the certificates are
            not accepted.
          TransportError: no listener responds.
        """
        if bool(connect) == bool(listen):
            raise CongraspError("A transport needs endpoints either to connect to or to listen on.")
        first_endpoints = [secured(endpoint, credentials) for endpoint in (connect or listen)]
        endpoints: dict[Flow, list[str]] = {}
        for i, name in enumerate(flows):
            endpoints[name] = [shifted(endpoint, i) for endpoint in first_endpoints]
        self._max_message = limits.message
        self._sender = secrets.token_bytes(8)
        self._identity = str(credentials.identity) if credentials else ""
        self._counts: dict[str, int] = {}
        self._counts_lock = threading.Lock()
        self._outbox = Outbox()
        self._pace = Pace()
        self._sessions = Sessions()
        self._sources = Sources()
        self._finalizer = weakref.finalize(self, self._sessions.close)
        deadline = time.monotonic() + wait
        revoked = credentials.revoked() if credentials else frozenset()

        def open_session(name: Flow, addresses: list[str]) -> zenoh.Session:
            config = zenoh_session.configuration(
                name, addresses, bool(listen), limits.of_flow(name), credentials
            )
            if listen:
                return zenoh_session.listen(config, addresses)
            return zenoh_session.connect(config, addresses, deadline, name, credentials)

        try:
            for name, addresses in endpoints.items():
                self._sessions.open(name, functools.partial(open_session, name, addresses))
        except BaseException:
            self.close()
            raise
        if listen:
            keep_places(self._sessions, zenoh_session.max_peers())
        if credentials:
            self._sessions.watch_revocations(
                credentials, revocation_seconds, revoked if listen else None
            )

    def serve(
        self,
        key: str,
        handler: Answerer,
        *,
        workers: int = 1,
        depth: int = 4,
        on_damage: Damage | None = None,
        admission: Admission | None = None,
        fair: bool = False,
    ) -> None:
        """See `Transport.serve`."""
        name = flow(key)
        server = QueryServer(
            handler=handler,
            on_damage=on_damage or (lambda *_: None),
            admission=admission or (lambda _: None),
            max_message=self._max_message,
            outbox=self._outbox,
            senders=Senders(
                lambda: self._sessions.get(name), has_certificates=bool(self._identity)
            ),
        )
        threads = QueryThreads(server, depth)
        work = threads.fair_work if fair else threads.work
        self._sessions.declare(
            name,
            lambda session: session.declare_queryable(key, FifoChannel(depth)),
            *[work] * workers,
        )

    def query(self, key: str, request: Message, *, timeout: float) -> Message:
        """See `Transport.query`."""

        def request_chunk(chunk_request: bytes, seconds: float) -> bytes | None:
            try:
                reply = self._query_once(key, None, chunk_request, seconds)
            except TransportError:
                return None
            return reply.payload if reply.head else None

        reply = self._query_first(key, self._encode(request), timeout)
        payload = reply.payload
        if reply.head:
            payload = fetch(
                reply.head,
                payload,
                request_chunk,
                self._pace,
                max_bytes=self._max_message,
                timeout=timeout,
            )
        return decode(payload, max_bytes=self._max_message)

    def _query_first(self, key: str, payload: bytes, timeout: float) -> _Reply:
        """Queries a reply, or its first chunk; raises like `query`.

        A short query is repeated if a first chunk longer than the default does not arrive.
        """
        is_repeatable = len(payload) <= _MAX_REPEATABLE_BYTES
        first_request = self._pace.first_request() if is_repeatable else None
        if first_request is not None:
            start = time.monotonic()
            try:
                reply = self._query_once(key, payload, first_request, min(timeout, CHUNK_TIMEOUT_S))
            except RefusedError:
                raise
            except TransportError:
                self._pace.reset()
            else:
                self._pace.record(time.monotonic() - start, arrived=False)
                return reply
        return self._query_once(key, payload, None, timeout)

    def _query_once(
        self, key: str, payload: bytes | None, attachment: bytes | None, timeout: float
    ) -> _Reply:
        """Sends one query; raises like `query`."""
        refused: zenoh.ReplyError | None = None
        try:
            with self._sessions.inside():
                session = self.session(key)
                replies = session.get(
                    key,
                    FifoChannel(4),
                    payload=payload,
                    attachment=attachment,
                    timeout=timeout,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                    source_info=self._sources.of_session(session, key),
                )
                for reply in replies:
                    if reply.ok:
                        head = reply.ok.attachment
                        return _Reply(reply.ok.payload.to_bytes(), head.to_bytes() if head else b"")
                    if reply.err:
                        refused = reply.err
        except zenoh.ZError as error:
            raise TransportError(f"The query for {key} failed: {first_line(error)}.") from None
        message = refused.payload.to_bytes() if refused else b""
        if message == b"Timeout":
            raise TransportError(f"No answer for {key} within {timeout:g} s.")
        if refused is not None:
            code = str(refused.encoding).partition(";")[2]
            raise error_of(code, message.decode(errors="replace"))
        revoked = f", or has revoked the certificate {self._identity}" if self._identity else ""
        raise TransportError(
            f"No response for {key}.",
            f"The process that serves it may have ended, or has another name{revoked}.",
        )

    def publish(self, key: str, message: Message) -> None:
        """See `Transport.publish`; does nothing once closed, or while the sessions are being
        reopened.
        """
        payload = self._encode(message)
        name = flow(key)
        with self._counts_lock:
            count = self._counts.get(key, 0)
            self._counts[key] = count + 1
        session = self._sessions.get(name)
        if session is None:
            return
        try:
            with self._sessions.inside():
                session.put(
                    key,
                    payload,
                    congestion_control=zenoh.CongestionControl.DROP,
                    express=name == "control",
                    attachment=STAMP.pack(self._sender, count),
                )
        except zenoh.ZError:
            if self._sessions.get(name) is session:
                raise

    def subscribe(self, key_expression: str, *, depth: int) -> Subscription:
        """See `Transport.subscribe`."""
        undeclare: list[Callable[[], None]] = []
        subscription = Subscription(depth, lambda: undeclare[0]())

        def declare(session: zenoh.Session) -> Any:
            return session.declare_subscriber(key_expression, FifoChannel(_MAX_QUEUED_SAMPLES))

        work = functools.partial(
            listen_to, subscription=subscription, max_message=self._max_message
        )
        undeclare.append(self._sessions.declare(flow(key_expression), declare, work))
        return subscription

    def declare_alive(self, key: str) -> None:
        """See `Transport.declare_alive`."""
        self._sessions.declare(flow(key), lambda session: session.liveliness().declare_token(key))

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """See `Transport.watch_alive`."""

        def declare(session: zenoh.Session) -> Any:
            return session.liveliness().declare_subscriber(
                key_expression, FifoChannel(_MAX_QUEUED_SAMPLES), history=True
            )

        watch = functools.partial(watch_tokens, on_change=on_change, closed=self._sessions.closed)
        self._sessions.declare(flow(key_expression), declare, watch)

    def close(self) -> None:
        """See `Transport.close`; takes at most two seconds."""
        self._finalizer()

    @property
    def closed(self) -> bool:
        """True once the transport is closed, also by a revoked certificate."""
        return self._sessions.closed.is_set()

    def session(self, key: str) -> zenoh.Session:
        """Returns Zenoh's session of a key's flow, for messages that are not encoded here.

        Raises:
          TransportError: the transport is closed, or has no such flow.
          CongraspError: it was closed by a failure.
        """
        session = self._sessions.get(flow(key))
        if self._sessions.failure:
            raise self._sessions.failure
        if session is not None:
            return session
        if self.closed:
            raise TransportError("The transport is closed.")
        raise TransportError(f"The transport has no flow for {key}.")

    def _encode(self, message: Message) -> bytes:
        """Encodes a message; raises a CongraspError if it is too long."""
        payload = encode(message)
        if len(payload) > self._max_message:
            raise CongraspError(
                f"A message has {len(payload)} bytes; the limit is {self._max_message}.",
                "Send fewer environments or steps in one rollout.",
            )
        return payload
