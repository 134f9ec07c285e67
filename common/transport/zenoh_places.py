"""Places for the connections of a listener, which its peers' certificates or addresses share.

Zenoh limits the number of connected peers, but not those of one address. When nearly all places are
taken, the address with the most connections loses its newest ones, so that one client cannot keep
the others out.
"""

import collections
import contextlib
import itertools
import math
import os
import socket
import threading
import time
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import zenoh

from congrasp.common.transport.zenoh_senders import host
from congrasp.common.transport.zenoh_session import Sessions

PERIOD_S = 1.0
"""Time between two checks of a listener."""
GUARD_S = 10.0
"""Time after the last connection in excess in which the checks are frequent: a crowd that
reconnects at once would leave the free places to others only for a moment.
"""
_GUARD_PERIOD_S = 0.05
"""Shortest time between two frequent checks."""
_GUARD_SHARE = 0.1
"""Largest share of the time that frequent checks take."""
_FULL = 0.9
"""Share of the places above which connections are ended."""
_LEFT = 0.75
"""Share of the places that may be taken afterwards."""
_SMALL_ACCOUNT = 0.125
"""Share of the places up to which an account loses none."""
_DESCRIPTORS = "/dev/fd"
"""Folder of the open files of this process; Windows has none."""
_NETWORK_FAMILIES = (socket.AF_INET, socket.AF_INET6)
"""Families of the sockets whose ends are a host and a port; event loops and child processes use
others.
"""


class Connection(NamedTuple):
    """Connection of a peer to a listener."""

    account: str
    """Certificate or address of the peer."""
    address: str
    """Host of the peer's end, without brackets."""
    port: int
    """Port of the peer's end."""


class ConnectionPlaces:
    """Connections of a listener in the order in which they were first seen."""

    def __init__(self, places: int):
        """Watches a listener with this limit of connections."""
        self._places = places
        self._connections: dict[Connection, None] = {}
        self._guarded_until = -math.inf

    @property
    def is_guarded(self) -> bool:
        """True for `GUARD_S` after the last connection in excess."""
        return time.monotonic() < self._guarded_until

    def excess(self, current: Iterable[Connection]) -> list[Connection]:
        """Returns the connections to end.

        Args:
          current: all connections; those that the last call did not know are the newest.
        """
        present = dict.fromkeys(current)
        known = [connection for connection in self._connections if connection in present]
        self._connections = dict.fromkeys(itertools.chain(known, present))
        limit = _LEFT if self.is_guarded else _FULL
        if len(present) <= limit * self._places:
            return []
        by_account: dict[str, list[Connection]] = collections.defaultdict(list)
        for connection in self._connections:
            by_account[connection.account].append(connection)
        ended: list[Connection] = []
        count = len(present) - math.floor(_LEFT * self._places)
        for _ in range(count):
            largest = max(by_account.values(), key=len)
            if len(largest) <= _SMALL_ACCOUNT * self._places:
                break
            ended.append(largest.pop())
        if ended:
            self._guarded_until = time.monotonic() + GUARD_S
        return ended


def keep_places(sessions: Sessions, places: int) -> None:
    """Ends connections in excess, in a thread, until the sessions of a listener are closed.

    The thread continues while the sessions are reopened, so that it is none of theirs.

    Args:
      sessions: sessions of the listener, one for each flow.
      places: limit of the connections of each.
    """
    thread = threading.Thread(
        target=_end_excess, args=(sessions, places), daemon=True, name="zenoh-places"
    )
    thread.start()


def _end_excess(sessions: Sessions, places: int) -> None:
    """Ends connections in excess until the sessions are closed."""
    by_flow: dict[str, ConnectionPlaces] = {}
    period = PERIOD_S
    while not sessions.closed.wait(period):
        start = time.monotonic()
        excess: list[Connection] = []
        with sessions.inside(), contextlib.suppress(zenoh.ZError):
            for flow, session in sessions.open_sessions():
                watched = by_flow.setdefault(flow, ConnectionPlaces(places))
                excess += watched.excess(_connections(session))
        if excess:
            end_connections(excess)
        period = PERIOD_S
        if any(watched.is_guarded for watched in by_flow.values()):
            period = max(_GUARD_PERIOD_S, (time.monotonic() - start) / _GUARD_SHARE)


def _connections(session: zenoh.Session) -> list[Connection]:
    """Current connections of a listener's session."""
    connections = []
    for link in session.info.links():
        address = host(link.dst)
        port = link.dst.partition("?")[0].rpartition(":")[2]
        if not port.isdecimal():
            continue
        account = str(link.auth_identifier or address)
        connections.append(Connection(account, address.strip("[]"), int(port)))
    return connections


def end_connections(connections: Sequence[Connection]) -> None:
    """Shuts down the sockets of connections, which Zenoh then closes.

    Zenoh's interface does not close a single connection.
    """
    ends = {(connection.address, connection.port) for connection in connections}
    with contextlib.suppress(OSError):
        for name in os.listdir(_DESCRIPTORS):
            with contextlib.suppress(OSError), _duplicate(int(name)) as other:
                if other.family not in _NETWORK_FAMILIES:
                    continue
                address, port = other.getpeername()[:2]
                if (address.removeprefix("::ffff:"), port) in ends:
                    other.shutdown(socket.SHUT_RDWR)


def _duplicate(descriptor: int) -> socket.socket:
    """Returns a socket with a descriptor of its own, so that the socket that is examined is the one
    that is shut down; raises an OSError for another kind of file.
    """
    duplicate = os.dup(descriptor)
    try:
        return socket.socket(fileno=duplicate)
    except OSError:
        os.close(duplicate)
        raise
