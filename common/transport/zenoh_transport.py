"""Messages over Zenoh.

One process listens (the learner or a policy server), the others connect to it, and it forwards between them. Each flow
has a session, so a TCP connection, of its own: on one shared link a rollout of some megabytes would delay a ticket, and
a recorder that reads slowly would delay both. Flow number i uses the port i above the one that was given.

Replies longer than a piece are fetched in pieces (`common.transport.pieces`). Everything is received through channels
that own daemon threads drain; a callback would keep the process from ending.
"""

import contextlib
import functools
import logging
import secrets
import struct
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple, Self

import zenoh
from zenoh.handlers import FifoChannel

from congrasp.common.errors import CongraspError, RefusedError, TransportError, error_of
from congrasp.common.transport import pieces, zenoh_session
from congrasp.common.transport.base import Admission, Answerer, Damage, Subscription
from congrasp.common.transport.keys import FLOWS, Flow, account, flow
from congrasp.common.transport.pieces import Outbox, Pace
from congrasp.common.transport.ports import shifted
from congrasp.common.transport.security import Credentials, secured
from congrasp.common.transport.zenoh_session import Sessions, first_line
from congrasp.common.wire.codec import MAX_MESSAGE, Message, decode, encode

_QUEUE = 256  # samples that wait for a thread that only moves them on
_FEW = 4 << 10  # bytes of a query that may be sent twice
_STAMP = struct.Struct("<8sQ")  # sender and count, by which a listener sees gaps
_REVOCATION_SECONDS = 5.0  # between two looks at the list of revoked certificates
_log = logging.getLogger(__name__)


class _Reply(NamedTuple):
    """What came back of a query."""

    payload: bytes
    head: bytes
    """Attachment of the first piece of a longer reply; empty for a whole one."""


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
        longest_rollout: int | None = None,
        revocation_seconds: float = _REVOCATION_SECONDS,
    ):
        """Opens the sessions.

        Args:
          connect: endpoints to connect to, such as `tcp/192.168.0.5:7447`; the first that answers is taken, and found
            again whenever it comes back.
          listen: endpoints to listen on, instead.
          flows: which flows to open; flow i uses the port i above the endpoint's, so both ends must start alike.
          max_message: bytes of the longest message; `zenoh_session.LONGEST` limits some flows to less.
          wait: seconds to wait for somebody to listen at `connect`.
          credentials: everything goes over mutual TLS with these; one that listens allows each role what
            `common.transport.security` gives it, and nothing else.
          longest_rollout: bytes of the longest rollout that one that listens takes; by default `max_message`.
          revocation_seconds: how often it looks whether certificates have been revoked. One that listens then makes
            all connections anew; one that connects is closed if it is connected to the owner of one of these.

        Raises:
          CongraspError: an endpoint or key is malformed, a port is in use, or the certificates are not accepted.
          TransportError: there is no response.
        """
        if bool(connect) == bool(listen):
            raise CongraspError("A transport needs endpoints either to connect to or to listen on.")
        wanted = [secured(one, credentials) for one in (connect or listen)]
        endpoints = {name: [shifted(one, i) for one in wanted] for i, name in enumerate(flows)}
        self._max_message, self._sender = max_message, secrets.token_bytes(8)
        self._identity = str(credentials.identity) if credentials else ""
        self._counts: dict[str, int] = {}
        self._counts_lock = threading.Lock()
        self._outbox, self._pace, self._sessions = Outbox(), Pace(), Sessions()
        self._finalizer = weakref.finalize(self, self._sessions.close)
        deadline, known = time.monotonic() + wait, credentials.revoked() if credentials else frozenset()

        def opened(name: Flow, where: list[str]) -> zenoh.Session:
            longest = longest_rollout if name == "bulk" and longest_rollout else max_message
            config = zenoh_session.configuration(name, where, bool(listen), longest, credentials)
            if listen:
                return zenoh_session.listen(config, where)
            return zenoh_session.connect(config, where, deadline, name, credentials)

        try:
            for name, where in endpoints.items():
                self._sessions.open(name, functools.partial(opened, name, where))
        except BaseException:
            self.close()
            raise
        if listen and credentials:
            follow = zenoh_session.follow_revocations
            self._sessions.start(follow, self._sessions, credentials, known, revocation_seconds)
        elif credentials:
            self._sessions.start(zenoh_session.heed_revocations, self._sessions, credentials, revocation_seconds)

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
        hooks = on_damage or (lambda *_: None), admission or (lambda _: None)
        server = _Server(handler, *hooks, self._max_message, self._outbox)
        works = [functools.partial(_serve, server=server)] * workers
        self._sessions.declare(flow(key), lambda session: session.declare_queryable(key, FifoChannel(depth)), *works)

    def query(self, key: str, request: Message, *, timeout: float) -> Message:
        """See `Transport.query`."""

        def ask(piece: bytes, seconds: float) -> bytes | None:
            try:
                reply = self._ask(key, None, piece, seconds)
            except TransportError:
                return None
            return reply.payload if reply.head else None

        reply = self._first(key, self._encode(request), timeout)
        whole = reply.payload
        if reply.head:
            whole = pieces.fetch(reply.head, whole, ask, self._pace, most=self._max_message, timeout=timeout)
        return decode(whole, max_bytes=self._max_message)

    def _first(self, key: str, payload: bytes, timeout: float) -> _Reply:
        """Asks for a reply, or for its first piece; raises as `query` does.

        What is asked in few words is asked again if a longer piece than the shortest does not come.
        """
        wish = self._pace.wish() if len(payload) <= _FEW else None
        if wish is not None:
            began = time.monotonic()
            try:
                reply = self._ask(key, payload, wish, min(timeout, pieces.TIMEOUT))
            except RefusedError:
                raise
            except TransportError:
                self._pace.lost()
            else:
                self._pace.note(time.monotonic() - began, came=False)
                return reply
        return self._ask(key, payload, None, timeout)

    def _ask(self, key: str, payload: bytes | None, attachment: bytes | None, timeout: float) -> _Reply:
        """Asks once; raises as `query` does."""
        refused: zenoh.ReplyError | None = None
        try:
            with self._sessions.inside():
                replies = self._session(key).get(
                    key,
                    FifoChannel(4),
                    payload=payload,
                    attachment=attachment,
                    timeout=timeout,
                    congestion_control=zenoh.CongestionControl.BLOCK,
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
            raise error_of(str(refused.encoding).partition(";")[2], message.decode(errors="replace"))
        revoked = f", or has revoked the certificate {self._identity}" if self._identity else ""
        raise TransportError(f"No response for {key}.", f"The process that serves it may have ended{revoked}.")

    def publish(self, key: str, message: Message) -> None:
        """See `Transport.publish`; once closed, or while the sessions are opened anew, it does nothing."""
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
                    attachment=_STAMP.pack(self._sender, count),
                )
        except zenoh.ZError:
            if self._sessions.get(name) is session:
                raise

    def subscribe(self, key_expression: str, *, depth: int) -> Subscription:
        """See `Transport.subscribe`."""
        undeclare: list[Callable[[], None]] = []
        subscription = Subscription(depth, lambda: undeclare[0]())
        undeclare.append(
            self._sessions.declare(
                flow(key_expression),
                lambda session: session.declare_subscriber(key_expression, FifoChannel(_QUEUE)),
                functools.partial(_listen_to, subscription=subscription, max_message=self._max_message),
            )
        )
        return subscription

    def declare_alive(self, key: str) -> None:
        """See `Transport.declare_alive`."""
        self._sessions.declare(flow(key), lambda session: session.liveliness().declare_token(key))

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """See `Transport.watch_alive`."""

        def declare(session: zenoh.Session) -> Any:
            return session.liveliness().declare_subscriber(key_expression, FifoChannel(_QUEUE), history=True)

        watch = functools.partial(_watch, on_change=on_change, closed=self._sessions.closed)
        self._sessions.declare(flow(key_expression), declare, watch)

    def close(self) -> None:
        """See `Transport.close`; takes two seconds at most."""
        self._finalizer()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _session(self, key: str) -> zenoh.Session:
        """The session of the flow that a key belongs to."""
        session = self._sessions.get(flow(key))
        if self._sessions.failure:
            raise self._sessions.failure
        if session is None:
            raise TransportError(
                "The transport is closed."
                if self._sessions.closed.is_set()
                else f"The transport has no flow for {key}."
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


def _received(channel: Any) -> Iterator[Any]:
    """What comes out of a channel until it is closed."""
    with contextlib.suppress(zenoh.ZError):
        while True:
            yield channel.recv()


class _Server(NamedTuple):
    """Who answers the queries of a key."""

    handler: Answerer
    on_damage: Damage
    admission: Admission
    max_message: int
    outbox: Outbox


def _serve(queries: Any, server: _Server) -> None:
    """Answers queries, in a thread of its own, until the session closes."""
    for query in _received(queries):
        key = str(query.key_expr)
        wanted = query.attachment.to_bytes() if query.attachment else b""
        if not pieces.is_request(wanted):
            _reply(query, key, functools.partial(_answer, query, key, server), server.outbox, wanted)
        else:
            with contextlib.suppress(zenoh.ZError, CongraspError), query, server.outbox.turn(account(key)) as mine:
                if mine and server.admission(key) is None:
                    query.reply(key, server.outbox.piece(wanted), attachment=wanted)


def _answer(query: Any, key: str, server: _Server) -> Message | Future[Message]:
    """The handler's answer to a query, unless admission or damage keeps it from the handler."""
    if (turned_away := server.admission(key)) is not None:
        return turned_away
    try:
        request = decode(query.payload.to_bytes() if query.payload else b"", max_bytes=server.max_message)
    except CongraspError as error:
        server.on_damage(key, error)
        raise
    return server.handler(key, request)


def _reply(
    query: Any, key: str, outcome: Callable[[], Message | Future[Message]], outbox: Outbox, attachment: bytes
) -> None:
    """Answers a query with what a function returns, once it is there, or with message and code of what it raises.

    The message is the error's payload, and the code the schema of its encoding.
    """
    payload, message, code = b"", "", ""
    try:
        result = outcome()
        if isinstance(result, Future):
            result.add_done_callback(lambda done: _reply(query, key, done.result, outbox, attachment))
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
            with outbox.first(payload, attachment, account(key)) as (piece, head):
                query.reply(key, piece, attachment=head)


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


def _watch(samples: Any, on_change: Callable[[str, bool], None], closed: threading.Event) -> None:
    """Reports liveliness tokens, in a thread of its own, until the session closes.

    When it is opened anew, all that were there are gone first: who has left meanwhile would not be missed otherwise.
    """
    shown: set[str] = set()

    def report(key: str, alive: bool) -> None:
        (shown.add if alive else shown.discard)(key)
        try:
            on_change(key, alive)
        except Exception:
            _log.exception("Could not take notice of %s.", key)

    for sample in _received(samples):
        report(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)
    if not closed.is_set():
        for key in sorted(shown):
            report(key, False)
