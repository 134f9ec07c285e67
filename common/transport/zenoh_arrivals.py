"""Queries that wait for a worker of a listener, in the order of their senders' turns.

Zenoh's channel is first in, first out: behind a client that sends too often, all others would wait
for the handling of its queries. The channel is therefore emptied before each query is handled,
which costs a small part of handling one.
"""

import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from congrasp.common.transport.fair_queue import FairQueue
from congrasp.common.transport.senders import Peer


class Arrival(NamedTuple):
    """A query and its sender."""

    query: Any
    key: str
    peer: Peer


class Arrivals:
    """Queries of a channel, which workers take in the order of their senders' turns."""

    def __init__(
        self,
        channel: Any,
        sender_of: Callable[[Any, str], Peer],
        refuse: Callable[[Any], None],
        *,
        depth: int,
    ):
        """Takes over a channel.

        Args:
          channel: the channel.
          sender_of: returns the sender of a query with a key.
          refuse: answers a query that has no place.
          depth: limit of waiting queries (`FairQueue`).
        """
        self._channel = channel
        self._sender_of = sender_of
        self._refuse = refuse
        self._depth = depth
        self._queue: FairQueue[Arrival] = FairQueue(depth, depth)
        self._lock = threading.Lock()

    def __iter__(self) -> Iterator[Arrival]:
        """Yields queries; one worker at a time waits for the next.

        Raises:
          zenoh.ZError: the channel is closed.
        """
        while True:
            with self._lock:
                excess = self._receive()
                arrival = self._pop()
            yield arrival
            for query in excess:
                self._refuse(query)

    def _receive(self) -> list[Any]:
        """Moves all queries of the channel to the queue, which then has at least one.

        Returns:
          Queries that have no place in the queue.
        """
        excess = []
        query = self._channel.try_recv() if len(self._queue) else self._channel.recv()
        received = 0
        while query is not None:
            excess += self._add(query)
            received += 1
            query = self._channel.try_recv() if received < self._depth else None
        return excess

    def _add(self, query: Any) -> list[Any]:
        """Queues a query; returns those that have no place, at most one."""
        key = str(query.key_expr)
        arrival = Arrival(query, key, self._sender_of(query, key))
        if not self._queue.has_room(arrival.peer):
            return [query]
        evicted = self._queue.add(arrival, arrival.peer)
        return [evicted.query] if evicted is not None else []

    def _pop(self) -> Arrival:
        """Removes and returns the query whose turn it is."""
        peer = self._queue.in_turn()[0]
        self._queue.end_turn(peer)
        return self._queue.pop(peer)
