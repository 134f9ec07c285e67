"""Two transports combined, for a learner with an actor in its process."""

from collections.abc import Callable
from typing import Any

from congrasp.common.transport.base import Answerer, Subscription, Transport
from congrasp.common.wire.codec import Message


class PairTransport(Transport):
    """Serves, publishes and declares tokens on two transports of the caller; queries and subscribes on the first."""

    def __init__(self, first: Transport, second: Transport):
        """Combines two transports; `query` and `subscribe` use only the first."""
        self._first, self._both = first, (first, second)

    def serve(self, key: str, handler: Answerer, **options: Any) -> None:
        """See `Transport.serve`; each of the two has separate workers."""
        for transport in self._both:
            transport.serve(key, handler, **options)

    def query(self, key: str, request: Message, *, timeout: float) -> Message:
        """See `Transport.query`."""
        return self._first.query(key, request, timeout=timeout)

    def publish(self, key: str, message: Message) -> None:
        """See `Transport.publish`."""
        for transport in self._both:
            transport.publish(key, message)

    def subscribe(self, key_expression: str, *, depth: int) -> Subscription:
        """See `Transport.subscribe`."""
        return self._first.subscribe(key_expression, depth=depth)

    def declare_alive(self, key: str) -> None:
        """See `Transport.declare_alive`."""
        for transport in self._both:
            transport.declare_alive(key)

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """See `Transport.watch_alive`."""
        for transport in self._both:
            transport.watch_alive(key_expression, on_change)

    def close(self) -> None:
        """Does nothing: both transports belong to the caller."""
