"""What messages travel over: queries with answers, publications that may be lost, and signs of life."""

import collections
import threading
from collections.abc import Callable
from typing import Protocol

from common.wire.codec import Message

Handler = Callable[[str, Message], Message]
"""(key, request) -> reply. A CongraspError that it raises reaches the asker in words."""


class Subscription:
    """The newest messages of a key expression; what does not fit into the ring is dropped and counted."""

    def __init__(self, depth: int):
        """A ring of `depth` messages."""
        self._ring: collections.deque[tuple[str, Message]] = collections.deque(maxlen=depth)
        self._ready = threading.Condition()
        self.dropped = 0

    def deliver(self, key: str, message: Message) -> None:
        """Called by the transport."""
        with self._ready:
            self.dropped += len(self._ring) == self._ring.maxlen
            self._ring.append((key, message))
            self._ready.notify()

    def receive(self, timeout: float) -> tuple[str, Message] | None:
        """The oldest message kept, or None when none arrives within `timeout` seconds."""
        with self._ready:
            if not self._ready.wait_for(lambda: self._ring, timeout):
                return None
            return self._ring.popleft()


class Transport(Protocol):
    """One endpoint. Every call returns within its deadline; `close` may be called twice."""

    def serve(self, key: str, handler: Handler, *, workers: int = 1, depth: int = 4) -> None:
        """Answers queries on `key` in threads of its own."""

    def query(self, key: str, request: Message, *, timeout: float) -> Message:
        """The answer of whoever serves `key`; a TransportError says why there is none."""

    def publish(self, key: str, message: Message) -> None:
        """Sends to whoever listens; may be lost, never blocks for long."""

    def subscribe(self, key_expression: str, *, depth: int = 64) -> Subscription:
        """Collects what is published on matching keys."""

    def declare_alive(self, key: str) -> None:
        """Shows `key` as alive until this endpoint closes or dies."""

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """Calls `on_change(key, alive)` for those alive now and for every change."""

    def close(self) -> None:
        """Leaves."""

    def __enter__(self) -> "Transport": ...

    def __exit__(self, *exc: object) -> None: ...
