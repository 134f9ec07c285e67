"""Places for the connections of a server, which its clients' addresses share fairly."""

import threading
from collections.abc import Callable
from typing import NamedTuple

from congrasp.common.transport.fair_queue import FairQueue
from congrasp.common.transport.senders import Peer


class Place(NamedTuple):
    """Place of a connection."""

    end: Callable[[], None]
    """Ends the connection, which loses its place to another one."""


class Places:
    """A limited number of places.

    While all are taken, the address with the most connections loses its newest one to an address
    with fewer, so that one client cannot keep the others out.
    """

    def __init__(self, limit: int):
        """Creates `limit` places."""
        self._limit = limit
        self._taken: FairQueue[Place] = FairQueue(limit, limit)
        self._lock = threading.Lock()

    def take(self, address: str, end: Callable[[], None]) -> Place | None:
        """Takes a place for a connection.

        Args:
          address: address of its client.
          end: ends the connection; called in another connection's thread if it loses its place.

        Returns:
          The place; None if there is none for this address.
        """
        peer = Peer(address)
        place = Place(end)
        with self._lock:
            if self._taken.accounts >= self._limit or not self._taken.has_room(peer):
                return None
            evicted = self._taken.add(place, peer)
        if evicted is not None:
            evicted.end()
        return place

    def leave(self, place: Place) -> None:
        """Frees the place of a connection that has ended."""
        with self._lock:
            self._taken.discard(place)
