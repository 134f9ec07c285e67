"""What a transport does, whatever carries the messages."""

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
"""A handler that may also return a future of the reply: its thread then goes on with the next request."""
Damage = Callable[[str, CongraspError], None]
"""(key, what is wrong): a request arrived that could not be decoded."""
Admission = Callable[[str], Message | None]
"""key -> the reply, or raised error, with which a request is turned away unseen; None lets it pass."""


def join(threads: Iterable[threading.Thread], deadline: float) -> None:
    """Waits for threads, but this one, until `deadline` on the monotonic clock."""
    for thread in threads:
        if thread is not threading.current_thread():
            thread.join(max(0.0, deadline - time.monotonic()))


class Subscription:
    """What was published under a key expression: a ring that keeps the newest and counts what it lost.

    Attributes:
      dropped: messages lost so far, on the way or because `receive` was called too rarely.
    """

    def __init__(self, depth: int, on_close: Callable[[], None] = lambda: None):
        self.dropped = 0
        self._ring: collections.deque[tuple[str, Callable[[], Message]]] = collections.deque()
        self._depth = depth
        self._on_close = on_close
        self._changed = threading.Condition()
        self._closed = False

    def push(self, key: str, message: Callable[[], Message], lost: int = 0) -> None:
        """Adds a message, which is decoded when it is received; `lost` ones before it never arrived."""
        with self._changed:
            self.dropped += lost
            if len(self._ring) == self._depth:
                self._ring.popleft()
                self.dropped += 1
            self._ring.append((key, message))
            self._changed.notify()

    def receive(self, timeout: float) -> tuple[str, Message] | None:
        """The oldest message that is kept, with its key; None if none comes within `timeout` seconds.

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
        """Ends the subscription; a waiting `receive` returns."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._on_close()


class Transport(Protocol):
    """One process's end of the wire."""

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
        """Answers queries.

        Args:
          key: key or key expression.
          handler: makes the reply, in a daemon thread of its own; message and code of its CongraspError are sent.
          workers: threads that run the handler.
          depth: queries that wait; further ones wait at their senders.
          on_damage: told about requests that cannot be decoded, which are refused without asking the handler.
          admission: asked before a request is decoded; it may send it away with a reply.
        """
        ...

    def query(self, key: str, request: Message, *, timeout: float) -> Message:
        """Asks whoever serves a key.

        Args:
          key: the key.
          request: the question.
          timeout: seconds to wait for the answer, and for each further piece of a long one.

        Raises:
          RefusedError: the peer answered with an error; a subclass where its code names one (`common.errors`).
          TransportError: nobody serves the key, or there was no response in time.
        """
        ...

    def publish(self, key: str, message: Message) -> None:
        """Sends to whoever listens; never waits long, and may lose the message."""
        ...

    def subscribe(self, key_expression: str, *, depth: int) -> Subscription:
        """Listens; `depth` messages are kept."""
        ...

    def declare_alive(self, key: str) -> None:
        """Shows a token to everyone until this transport closes or its process dies."""
        ...

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """Calls back, in a daemon thread, for each token that is there, comes or goes."""
        ...

    def close(self) -> None:
        """Ends everything that was declared; may be called again."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *exception: object) -> None: ...
