"""Senders of Zenoh queries: their certificate, or the address of their connection.

A query does not show the connection that it arrived on. The clients of this project therefore add
the identifier of their session, which is random and which no other client learns; the listener
looks up the address of its connection. Clients that do not add it, or invent one, share one
account; in it, their names share a fixed number of peers, since names are free.
"""

import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from congrasp.common.transport.keys import account
from congrasp.common.transport.senders import Peer

_UNKNOWN = "unknown address"
_UNKNOWN_PEERS = 64
"""Number of peers to which the names of unknown senders are assigned at random."""
_LISTINGS_PER_S = 100.0
"""Limit of the listings of connections, which every invented identifier would cause; as many may
follow one another at once.
"""


class Sources:
    """Marks that the queries of this process carry, one for each of its sessions."""

    def __init__(self) -> None:
        self._marks: dict[str, zenoh.SourceInfo] = {}

    def of_session(self, session: zenoh.Session, key: str) -> zenoh.SourceInfo:
        """Returns the mark of a session.

        Args:
          session: the session.
          key: any key that it may query.
        """
        identifier = str(session.zid())
        if identifier not in self._marks:
            querier = session.declare_querier(key)
            self._marks[identifier] = zenoh.SourceInfo(querier.id, 0)
            querier.undeclare()
        return self._marks[identifier]


class Senders:
    """Senders of the queries that a listener receives."""

    def __init__(self, session: Callable[[], zenoh.Session | None], *, has_certificates: bool):
        """Creates the table.

        Args:
          session: returns the session of the listener; None while it is being reopened.
          has_certificates: its clients have certificates, whose numbers begin their names.
        """
        self._session = session
        self._has_certificates = has_certificates
        self._addresses: dict[str, str] = {}
        self._lock = threading.Lock()
        self._listings_left = _LISTINGS_PER_S
        self._listed_at = time.monotonic()

    def of_query(self, query: Any, key: str) -> Peer:
        """Returns the sender of a query."""
        if self._has_certificates:
            return Peer(account(key), key)
        source = query.source_info
        if source is None:
            return _unknown(key)
        connection = str(source.source_id.zid)
        address = self._address_of(connection)
        if address is None:
            return _unknown(key)
        return Peer(address, connection)

    def _address_of(self, connection: str) -> str | None:
        """Address of a connection; None if there is no such connection, or it is a new one and too
        many identifiers without a connection came before.
        """
        address = self._addresses.get(connection)
        if address is not None:
            return address
        with self._lock:
            self._list()
            return self._addresses.get(connection)

    def _list(self) -> None:
        """Lists the current connections, within the limit of `_LISTINGS_PER_S`."""
        now = time.monotonic()
        regained = (now - self._listed_at) * _LISTINGS_PER_S
        self._listings_left = min(_LISTINGS_PER_S, self._listings_left + regained)
        self._listed_at = now
        if self._listings_left < 1.0:
            return
        self._listings_left -= 1.0
        session = self._session()
        links = session.info.links() if session else []
        self._addresses = {str(link.zid): host(link.dst) for link in links}


def _unknown(key: str) -> Peer:
    """Returns the peer of a query whose connection is unknown, by the random hash of its key."""
    return Peer(_UNKNOWN, str(hash(key) % _UNKNOWN_PEERS))


def host(locator: str) -> str:
    """Returns the host of a locator such as tcp/10.0.0.7:7457."""
    return locator.partition("/")[2].partition("?")[0].rpartition(":")[0]
