"""Transport over Zenoh.

One process listens (the learner or a policy server); the others connect to it, and it forwards
between them. Each flow has a separate session and thus a separate TCP connection: on one shared
link, a rollout of some megabytes would delay a ticket, and a slow recorder would delay both. Flow
number i uses the port i above the given one.

Long replies are fetched in chunks (`Outbox`). Everything is received through channels drained by
daemon threads; a callback would keep the process from exiting.
"""

import contextlib
import functools
import logging
import secrets
import struct
import threading
import time
import weakref
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from typing import Any, NamedTuple

import zenoh
from zenoh.handlers import FifoChannel

from congrasp.common.errors import (
    CongraspError,
    OverloadedError,
    RefusedError,
    TransportError,
    error_of,
)
from congrasp.common.transport import zenoh_session
from congrasp.common.transport.base import Admission, Answerer, Damage, Subscription, Transport
from congrasp.common.transport.keys import FLOWS, Flow, flow
from congrasp.common.transport.ports import shifted
from congrasp.common.transport.security import Credentials, secured
from congrasp.common.transport.senders import sent_by
from congrasp.common.transport.zenoh_arrivals import Arrival, Arrivals
from congrasp.common.transport.zenoh_senders import Senders, Sources
from congrasp.common.transport.zenoh_session import (
    STAMP,
    Sessions,
    first_line,
    listen_to,
    received,
    watch_tokens,
)
from congrasp.common.wire.codec import MAX_MESSAGE, Message, decode, encode

_SHORTEST, _FIRST, _LONGEST = 8 << 10, 32 << 10, 4 << 20  # bytes of a chunk
# Seconds of a chunk below which the next is longer, and above which it is shorter
_FAST, _SLOW = (
    0.1,
    0.4,
)
TIMEOUT = 1.0
"""Seconds until a chunk counts as lost."""
_PAUSE = 0.05  # seconds to wait after a chunk that was lost or deferred
_TOKEN = 8
_HEAD = struct.Struct(f"<{_TOKEN}sQ")
_REQUEST = struct.Struct(f"<{_TOKEN}sQI")
_WISH = struct.Struct("<I")

Ask = Callable[[bytes, float], bytes | None]
"""(request, seconds) -> the chunk, or None if it is not available now."""


class Pace:
    """Chunk length of a link: longer while chunks arrive quickly, and kept between replies."""

    def __init__(self) -> None:
        self._length = _FIRST

    def wish(self) -> bytes | None:
        """Attachment of a query that requests a longer first chunk; None before the first long
        reply.
        """
        return _WISH.pack(self._length) if self._length > _FIRST else None

    def lost(self) -> None:
        """Records that a longer first chunk was lost: restarts from the default length."""
        self._length = _FIRST

    def request(self, token: bytes, offset: int) -> bytes:
        """Attachment of a query for a further chunk."""
        return _REQUEST.pack(token, offset, self._length)

    def note(self, seconds: float, *, came: bool) -> None:
        """Records the duration of a chunk and whether it arrived; a deferred one changes
        nothing.
        """
        if seconds > _SLOW:
            self._length = max(_SHORTEST, self._length // 2)
        elif came and seconds < _FAST:
            self._length = min(_LONGEST, 2 * self._length)


class Outbox:
    """Long replies in chunks, fetched one after another by the client at the speed of its link.

    The first chunk is short, or as long as requested by a client that has received chunks of that
    length before. A reply no longer than that is complete. Otherwise its attachment holds a token
    and the total length, and the client queries the rest under the same key, by token, offset and
    length. No message is therefore longer than the client's link transfers in a moment, and a slow
    or stopped client costs the server nothing but dropped chunks.

    A payload sent repeatedly is stored once, and only the last used ones are kept.
    """

    def __init__(self, most: int = 8, at_once: int = 2):
        """Keeps `most` replies, and sends at most `at_once` chunks to one account at a time."""
        self._most, self._at_once = most, at_once
        self._sending: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._kept: OrderedDict[bytes, bytes] = OrderedDict()

    @contextlib.contextmanager
    def first(
        self, payload: bytes, attachment: bytes, account: str
    ) -> Iterator[tuple[bytes, bytes | None]]:
        """Context of sending a reply: yields its first chunk and the chunk's attachment, None if
        the reply is complete.

        Args:
          payload: the whole reply.
          attachment: attachment of the query.
          account: account of the client. Its first chunk is short while others are being sent to
            it.
        """
        longest = min(_WISH.unpack(attachment)[0], _LONGEST) if len(attachment) == _WISH.size else 0
        if len(payload) <= _FIRST or longest <= _FIRST:
            yield self._cut(payload, _FIRST)
            return
        with self.turn(account) as mine:
            yield self._cut(payload, longest if mine else _FIRST)

    def _cut(self, payload: bytes, longest: int) -> tuple[bytes, bytes | None]:
        """Returns the first chunk of a reply and its attachment; stores the reply if that is not
        all of it.
        """
        if len(payload) <= longest:
            return payload, None
        with self._lock:
            token = next((token for token, kept in self._kept.items() if kept is payload), None)
            token = token or secrets.token_bytes(_TOKEN)
            self._kept[token] = payload
            self._kept.move_to_end(token)
            if len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return payload[:longest], _HEAD.pack(token, len(payload))

    @contextlib.contextmanager
    def turn(self, account: str) -> Iterator[bool]:
        """Context of sending a chunk: yields True unless too many are being sent to the account."""
        with self._lock:
            mine = self._sending[account] < self._at_once
            self._sending[account] += mine
        try:
            yield mine
        finally:
            with self._lock:
                self._sending[account] -= mine
                self._sending += Counter()  # drops counts of zero

    def piece(self, request: bytes) -> bytes:
        """Returns the requested chunk; empty if the reply is no longer stored."""
        token, offset, length = _REQUEST.unpack(request)
        with self._lock:
            payload = self._kept.get(token, b"")
            if payload:
                self._kept.move_to_end(token)
        return payload[offset : offset + min(length, _LONGEST)]


def is_request(attachment: bytes) -> bool:
    """True if a query with this attachment requests a further chunk."""
    return len(attachment) == _REQUEST.size


def fetch(head: bytes, first: bytes, ask: Ask, pace: Pace, *, most: int, timeout: float) -> bytes:
    """Fetches the rest of a reply.

    Args:
      head: attachment of the first chunk.
      first: the first chunk.
      ask: queries a chunk.
      pace: pace of the link.
      most: limit of the reply's length in bytes.
      timeout: deadline of each chunk in seconds.

    Returns:
      The whole reply.

    Raises:
      TransportError: the reply is too long or no longer stored, or a chunk did not arrive in time.
    """
    if len(head) != _HEAD.size:
        raise TransportError("A reply has an invalid attachment.")
    token, size = _HEAD.unpack(head)
    if size > most:
        raise TransportError(f"A reply has {size} bytes; the limit is {most}.")
    parts, have, deadline = [first], len(first), time.monotonic() + timeout
    while have < size:
        began = time.monotonic()
        if began >= deadline:
            raise TransportError(f"Only {have} of {size} bytes of a reply arrived in time.")
        piece = ask(pace.request(token, have), min(TIMEOUT, deadline - began))
        ended = time.monotonic()
        pace.note(ended - began, came=piece is not None)
        if piece is None:
            time.sleep(max(0.0, min(_PAUSE, deadline - ended)))
            continue
        if not piece or have + len(piece) > size:
            raise TransportError(
                "The rest of a reply is no longer available.", "Send the query again."
            )
        parts.append(piece)
        have, deadline = have + len(piece), ended + timeout
    return b"".join(parts)


_QUEUE = 256  # samples queued for a thread that only moves them on
_FEW = 4 << 10  # longest query that may be sent twice, bytes
_REVOCATION_SECONDS = 5.0  # between two checks of the list of revoked certificates
_log = logging.getLogger(__name__)


class _Reply(NamedTuple):
    """A reply to a query, or its first chunk."""

    payload: bytes
    head: bytes
    """Attachment of the first chunk of a longer reply; empty for a complete one."""


class ZenohTransport(Transport):
    """A `Transport` over Zenoh sessions."""

    def __init__(  # noqa: PLR0913
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
          connect: endpoints to connect to, such as `tcp/192.168.0.5:7447`; the first that responds
            is used, and reconnected whenever it returns.
          listen: endpoints to listen on instead.
          flows: flows to open; flow i uses the port i above the endpoint's, so the flows of both
            ends must start alike.
          max_message: limit of a message's length in bytes; `zenoh_session.LONGEST` has lower
            limits for some flows.
          wait: seconds to wait for a listener at `connect`.
          credentials: credentials for mutual TLS; a listener restricts each role to its rights in
            `common.transport.security`. None uses plain TCP.
          longest_rollout: longest rollout accepted by a listener, in bytes; by default
            `max_message`.
          revocation_seconds: period of the checks for revoked certificates. A listener then reopens
            all connections; a connecting transport closes if its listener's certificate is revoked.

        Raises:
          CongraspError: an endpoint or key is malformed, a port is in use, or the certificates are
            not accepted.
          TransportError: no listener responds.
        """
        if bool(connect) == bool(listen):
            raise CongraspError("A transport needs endpoints either to connect to or to listen on.")
        wanted = [secured(one, credentials) for one in (connect or listen)]
        endpoints = {name: [shifted(one, i) for one in wanted] for i, name in enumerate(flows)}
        self._max_message, self._sender = max_message, secrets.token_bytes(8)
        self._identity = str(credentials.identity) if credentials else ""
        self._counts: dict[str, int] = {}
        self._counts_lock = threading.Lock()
        self._outbox = Outbox()
        self._pace = Pace()
        self._sessions = Sessions()
        self._sources = Sources()
        self._finalizer = weakref.finalize(self, self._sessions.close)
        deadline, known = (
            time.monotonic() + wait,
            credentials.revoked() if credentials else frozenset(),
        )

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
        if credentials:
            self._sessions.watch_revocations(
                credentials, revocation_seconds, known if listen else None
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
        hooks = on_damage or (lambda *_: None), admission or (lambda _: None)
        senders = Senders(
            lambda: self._sessions.get(flow(key)), has_certificates=bool(self._identity)
        )
        server = _Server(handler, *hooks, self._max_message, self._outbox, senders)
        receiver = _Receiver(server, depth)
        works = [receiver.fair_work if fair else receiver.work] * workers
        self._sessions.declare(
            flow(key), lambda session: session.declare_queryable(key, FifoChannel(depth)), *works
        )

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
            whole = fetch(
                reply.head, whole, ask, self._pace, most=self._max_message, timeout=timeout
            )
        return decode(whole, max_bytes=self._max_message)

    def _first(self, key: str, payload: bytes, timeout: float) -> _Reply:
        """Queries a reply, or its first chunk; raises like `query`.

        A short query is repeated if a first chunk longer than the default does not arrive.
        """
        wish = self._pace.wish() if len(payload) <= _FEW else None
        if wish is not None:
            began = time.monotonic()
            try:
                reply = self._ask(key, payload, wish, min(timeout, TIMEOUT))
            except RefusedError:
                raise
            except TransportError:
                self._pace.lost()
            else:
                self._pace.note(time.monotonic() - began, came=False)
                return reply
        return self._ask(key, payload, None, timeout)

    def _ask(
        self, key: str, payload: bytes | None, attachment: bytes | None, timeout: float
    ) -> _Reply:
        """Sends one query; raises like `query`."""
        refused: zenoh.ReplyError | None = None
        try:
            with self._sessions.inside():
                session = self._session(key)
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
            raise error_of(
                str(refused.encoding).partition(";")[2], message.decode(errors="replace")
            )
        revoked = f", or has revoked the certificate {self._identity}" if self._identity else ""
        raise TransportError(
            f"No response for {key}.", f"The process that serves it may have ended{revoked}."
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
        undeclare.append(
            self._sessions.declare(
                flow(key_expression),
                lambda session: session.declare_subscriber(key_expression, FifoChannel(_QUEUE)),
                functools.partial(
                    listen_to, subscription=subscription, max_message=self._max_message
                ),
            )
        )
        return subscription

    def declare_alive(self, key: str) -> None:
        """See `Transport.declare_alive`."""
        self._sessions.declare(flow(key), lambda session: session.liveliness().declare_token(key))

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """See `Transport.watch_alive`."""

        def declare(session: zenoh.Session) -> Any:
            return session.liveliness().declare_subscriber(
                key_expression, FifoChannel(_QUEUE), history=True
            )

        watch = functools.partial(watch_tokens, on_change=on_change, closed=self._sessions.closed)
        self._sessions.declare(flow(key_expression), declare, watch)

    def close(self) -> None:
        """See `Transport.close`; takes at most two seconds."""
        self._finalizer()

    def _session(self, key: str) -> zenoh.Session:
        """Returns the session of a key's flow."""
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
        """Encodes a message; raises a CongraspError if it is too long."""
        payload = encode(message)
        if len(payload) > self._max_message:
            raise CongraspError(
                f"A message has {len(payload)} bytes; the limit is {self._max_message}.",
                "Send fewer environments or steps in one rollout.",
            )
        return payload


class _Server(NamedTuple):
    """Handler of the queries of a key, with its options."""

    handler: Answerer
    on_damage: Damage
    admission: Admission
    max_message: int
    outbox: Outbox
    senders: Senders


class _Receiver:
    """Work of the threads that answer the queries of a key until the session closes."""

    def __init__(self, server: _Server, depth: int):
        self._server = server
        self._depth = depth
        self._lock = threading.Lock()
        self._channel: Any = None
        self._arrivals: Arrivals | None = None

    def work(self, channel: Any) -> None:
        """Answers queries in the order of their arrival."""
        sender_of = self._server.senders.of_query
        for query in received(channel):
            key = str(query.key_expr)
            _serve(Arrival(query, key, sender_of(query, key)), self._server)

    def fair_work(self, channel: Any) -> None:
        """Answers queries in the order of their senders' turns."""
        with contextlib.suppress(zenoh.ZError):
            for arrival in self._arrivals_of(channel):
                _serve(arrival, self._server)

    def _arrivals_of(self, channel: Any) -> Arrivals:
        """Arrivals of the current session's channel, which all threads share."""
        with self._lock:
            if self._arrivals is None or self._channel is not channel:
                self._channel = channel
                self._arrivals = Arrivals(
                    channel, self._server.senders.of_query, self._refuse, depth=self._depth
                )
            return self._arrivals

    def _refuse(self, query: Any) -> None:
        """Answers a query that has no place."""
        error = OverloadedError(f"Overloaded: {self._depth} queries wait.", "Try again later.")
        _reply_error(query, str(error), error.code)


def _serve(arrival: Arrival, server: _Server) -> None:
    """Answers one query."""
    query, key, peer = arrival
    attachment = query.attachment.to_bytes() if query.attachment else b""
    if not is_request(attachment):
        answer = functools.partial(_answer, query, key, server)
        with sent_by(peer):
            _reply(query, key, answer, server.outbox, attachment, peer.account)
        return
    with (
        contextlib.suppress(zenoh.ZError, CongraspError),
        sent_by(peer),
        query,
        server.outbox.turn(peer.account) as has_turn,
    ):
        if has_turn and server.admission(key) is None:
            query.reply(key, server.outbox.piece(attachment), attachment=attachment)


def _answer(query: Any, key: str, server: _Server) -> Message | Future[Message]:
    """Returns the handler's reply to a query, unless it is rejected or damaged."""
    if (rejected := server.admission(key)) is not None:
        return rejected
    try:
        request = decode(
            query.payload.to_bytes() if query.payload else b"", max_bytes=server.max_message
        )
    except CongraspError as error:
        server.on_damage(key, error)
        raise
    return server.handler(key, request)


def _reply(
    query: Any,
    key: str,
    outcome: Callable[[], Message | Future[Message]],
    outbox: Outbox,
    attachment: bytes,
    account: str,
) -> None:
    """Replies to a query with the result of a function once it is available, or with message and
    code of its error.

    The message is the error's payload, and the code the schema of its encoding.
    """
    payload, message, code = b"", "", ""
    try:
        result = outcome()
        if isinstance(result, Future):
            result.add_done_callback(
                lambda done: _reply(query, key, done.result, outbox, attachment, account)
            )
            return
        payload = encode(result)
    except CongraspError as error:
        message, code = str(error), error.code
    except Exception as error:
        _log.exception("The reply to %s failed.", key)
        message = f"The peer failed on {key}: {type(error).__name__}."
    if message:
        _reply_error(query, message, code)
        return
    with (
        contextlib.suppress(zenoh.ZError),
        query,
        outbox.first(payload, attachment, account) as (piece, head),
    ):
        query.reply(key, piece, attachment=head)


def _reply_error(query: Any, message: str, code: str) -> None:
    """Replies with message and code of an error."""
    encoding = zenoh.Encoding.TEXT_PLAIN.with_schema(code)
    with contextlib.suppress(zenoh.ZError), query:
        query.reply_err(message.encode(errors="replace"), encoding=encoding)
