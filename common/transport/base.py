"""Interface of transports."""

import collections
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from typing import Protocol, Self

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import Message

Handler = Callable[[str, Message], Message]
"""(key, request) -> reply."""
Answerer = Callable[[str, Message], "Message | Future[Message]"]
"""A handler that may also return a future of the reply: its thread then continues with the next
request.
"""
Damage = Callable[[str, CongraspError], None]
"""(key, fault): called for a request that could not be decoded."""
Admission = Callable[[str], Message | None]
"""key -> reply, or raised error, that rejects a request before it is decoded; None admits it."""


def join(threads: Iterable[threading.Thread], deadline: float) -> None:
    """Joins threads, except the current one, until `deadline` on the monotonic clock."""
    for thread in threads:
        if thread is not threading.current_thread():
            thread.join(max(0.0, deadline - time.monotonic()))


class Subscription:
    """Messages published under a key expression: a ring buffer that keeps the newest and counts
    lost ones.

    Attributes:
      dropped: messages lost so far, in transit or because `receive` was called too rarely.
    """

    def __init__(self, depth: int, on_close: Callable[[], None] = lambda: None):
        self.dropped = 0
        self._ring: collections.deque[tuple[str, Callable[[], Message]]] = collections.deque()
        self._depth = depth
        self._on_close = on_close
        self._changed = threading.Condition()
        self._closed = False

    def push(self, key: str, message: Callable[[], Message], lost: int = 0) -> None:
        """Adds a message, to be decoded on receipt; `lost` messages before it never arrived."""
        with self._changed:
            self.dropped += lost
            if len(self._ring) == self._depth:
                self._ring.popleft()
                self.dropped += 1
            self._ring.append((key, message))
            self._changed.notify()

    def receive(self, timeout: float) -> tuple[str, Message] | None:
        """Returns the oldest buffered message with its key; None if none arrives within `timeout`
        seconds.

        A message that cannot be decoded counts as dropped.
        """
        deadline = time.monotonic() + timeout
        while True:
            with self._changed:
                while not self._ring:
                    rest = deadline - time.monotonic()
                    if self._closed or rest <= 0:
                        return None
                    self._changed.wait(rest)
                key, message = self._ring.popleft()
            try:
                return key, message()
            except CongraspError:
                self.dropped += 1

    def close(self) -> None:
        """Closes the subscription; a waiting `receive` returns."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._on_close()


class Closing(Protocol):
    """A context that is closed at its end."""

    def close(self) -> None:
        """Closes the context and all of its declarations; may be called repeatedly."""
        ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class Transport(Closing, Protocol):
    """Endpoint of a process."""

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
        """Answers queries.

        Args:
          key: key or key expression.
          handler: returns the reply; called in a separate daemon thread. Message and code of its
            CongraspError are sent.
          workers: threads that run the handler.
          depth: length of the queue; further queries wait at their senders.
          on_damage: called for requests that cannot be decoded; these are refused without calling
            the handler.
          admission: called before a request is decoded; it may reject it with a reply.
          fair: waiting queries are answered in the order of their senders' turns instead of that of
            their arrival, and those in excess of `depth` are refused (`FairQueue`).
        """
        ...

    def query(self, key: str, request: Message, *, timeout: float) -> Message:
        """Sends a query to the peer that serves a key.

        Args:
          key: the key.
          request: the request.
          timeout: seconds to wait for the reply, and for each further chunk of a long one.

        Raises:
          RefusedError: the peer answered with an error; of the subclass that its code names
            (`common.errors`).
          TransportError: no peer serves the key, or there was no response in time.
        """
        ...

    def publish(self, key: str, message: Message) -> None:
        """Publishes a message to all subscribers; does not block for long, and may lose the
        message.
        """
        ...

    def subscribe(self, key_expression: str, *, depth: int) -> Subscription:
        """Subscribes to a key expression; `depth` messages are buffered."""
        ...

    def declare_alive(self, key: str) -> None:
        """Declares a liveliness token until this transport closes or its process dies."""
        ...

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """Calls `on_change`, in a daemon thread, for each token that exists, appears or
        disappears.
        """
        ...
