"""Two transports as one: for a learner that also has an actor in its own process."""

from collections.abc import Callable
from typing import Any, Self

from congrasp.common.transport.base import Answerer, Subscription, Transport
from congrasp.common.wire.codec import Message


class PairTransport:
    """Serves, shows itself and publishes on two transports, which stay the caller's; asks and listens on the first."""

    def __init__(self, first: Transport, second: Transport):
        """`query` and `subscribe` use the first alone."""
        self._first, self._both = first, (first, second)

    def serve(self, key: str, handler: Answerer, **options: Any) -> None:
        """See `Transport.serve`; each of the two has workers of its own."""
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
        """Leaves both open."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
