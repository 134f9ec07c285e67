"""Senders of queries: which client a query counts for.

A client is its certificate, or its address where there are no certificates: names and connections
are free, so more of them must not give a client more than others get.
"""

import contextlib
import contextvars
from collections.abc import Iterator
from typing import NamedTuple

from congrasp.common.transport.keys import account


class Peer(NamedTuple):
    """Sender of a query."""

    account: str = ""
    """Certificate or address."""
    name: str = ""
    """Connection, or name of a client, within the account."""


_current: contextvars.ContextVar[Peer | None] = contextvars.ContextVar("sender", default=None)


@contextlib.contextmanager
def sent_by(peer: Peer) -> Iterator[None]:
    """Context of the handling of a peer's query, in this thread."""
    token = _current.set(peer)
    try:
        yield
    finally:
        _current.reset(token)


def sender(key: str) -> Peer:
    """Returns the sender of the query that this thread handles.

    Args:
      key: key of the query, which names the sender if the transport does not know it.
    """
    return _current.get() or Peer(account(key), key)
