"""Threads that answer the queries of a key over Zenoh.

Each query is decoded, handled and answered in chunks (`Outbox`), or with message and code of an
error.
"""

import contextlib
import functools
import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple

import zenoh

from congrasp.common.errors import CongraspError, OverloadedError
from congrasp.common.transport.base import Admission, Answerer, Damage
from congrasp.common.transport.chunks import Outbox, is_request
from congrasp.common.transport.senders import sent_by
from congrasp.common.transport.zenoh_arrivals import Arrival, Arrivals
from congrasp.common.transport.zenoh_senders import Senders
from congrasp.common.transport.zenoh_session import received
from congrasp.common.wire.codec import Message, decode, encode

_log = logging.getLogger(__name__)


class QueryServer(NamedTuple):
    """Handler of a key's queries, and what answering them needs."""

    handler: Answerer
    on_damage: Damage
    admission: Admission
    max_message: int
    """Limit of a query's length in bytes."""
    outbox: Outbox
    senders: Senders


class QueryThreads:
    """Work of the threads that answer the queries of a key until the session closes."""

    def __init__(self, server: QueryServer, depth: int):
        """Creates the work of any number of threads.

        Args:
          server: handler of the queries.
          depth: queries of one sender that may wait; further ones are rejected.
        """
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
            sender = sender_of(query, key)
            _serve(Arrival(query, key, sender), self._server)

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


def _serve(arrival: Arrival, server: QueryServer) -> None:
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
            query.reply(key, server.outbox.chunk(attachment), attachment=attachment)


def _answer(query: Any, key: str, server: QueryServer) -> Message | Future[Message]:
    """Returns the handler's reply to a query, unless it is rejected or damaged."""
    rejection = server.admission(key)
    if rejection is not None:
        return rejection
    payload = query.payload.to_bytes() if query.payload else b""
    try:
        request = decode(payload, max_bytes=server.max_message)
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
    try:
        result = outcome()
        if isinstance(result, Future):
            result.add_done_callback(
                lambda done: _reply(query, key, done.result, outbox, attachment, account)
            )
            return
        payload = encode(result)
    except CongraspError as error:
        _reply_error(query, str(error), error.code)
        return
    except Exception as error:
        _log.exception("The reply to %s failed.", key)
        _reply_error(query, f"The peer failed on {key}: {type(error).__name__}.", "")
        return
    with (
        contextlib.suppress(zenoh.ZError),
        query,
        outbox.first_chunk(payload, attachment, account) as (chunk, head),
    ):
        query.reply(key, chunk, attachment=head)


def _reply_error(query: Any, message: str, code: str) -> None:
    """Replies with message and code of an error."""
    encoding = zenoh.Encoding.TEXT_PLAIN.with_schema(code)
    with contextlib.suppress(zenoh.ZError), query:
        query.reply_err(message.encode(errors="replace"), encoding=encoding)
