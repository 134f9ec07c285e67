"""The transport within one process: messages are passed by reference, so that arrays stay on the device."""

import threading
from collections.abc import Callable

import zenoh

from common.errors import CongraspError, TransportError
from common.transport.base import Handler, Subscription
from common.wire.codec import Message


class MemoryBroker:
    """Where the endpoints of one process meet."""

    def __init__(self) -> None:
        """Nobody is here yet."""
        self.lock = threading.RLock()
        self.handlers: dict[str, tuple[object, Handler]] = {}
        self.subscriptions: list[tuple[object, zenoh.KeyExpr, Subscription]] = []
        self.alive: dict[str, object] = {}
        self.watchers: list[tuple[object, zenoh.KeyExpr, Callable[[str, bool], None]]] = []

    def change(self, key: str, alive: bool) -> None:
        """Tells the watchers."""
        for _, expression, on_change in list(self.watchers):
            if expression.includes(zenoh.KeyExpr(key)):
                on_change(key, alive)


class MemoryTransport:
    """An endpoint of a `MemoryBroker`; handlers run in the asker's thread."""

    def __init__(self, broker: MemoryBroker):
        """Joins the broker."""
        self._broker = broker

    def serve(self, key: str, handler: Handler, *, workers: int = 1, depth: int = 4) -> None:
        """See `Transport.serve`."""
        self._broker.handlers[key] = (self, handler)

    def query(self, key: str, request: Message, *, timeout: float) -> Message:
        """See `Transport.query`."""
        found = self._broker.handlers.get(key)
        if found is None:
            raise TransportError(f"Nobody answers on '{key}'.")
        try:
            return found[1](key, request)
        except CongraspError as error:
            raise TransportError(str(error)) from None

    def publish(self, key: str, message: Message) -> None:
        """See `Transport.publish`."""
        for _, expression, subscription in list(self._broker.subscriptions):
            if expression.includes(zenoh.KeyExpr(key)):
                subscription.deliver(key, message)

    def subscribe(self, key_expression: str, *, depth: int = 64) -> Subscription:
        """See `Transport.subscribe`."""
        subscription = Subscription(depth)
        self._broker.subscriptions.append((self, zenoh.KeyExpr(key_expression), subscription))
        return subscription

    def declare_alive(self, key: str) -> None:
        """See `Transport.declare_alive`."""
        self._broker.alive[key] = self
        self._broker.change(key, True)

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """See `Transport.watch_alive`."""
        expression = zenoh.KeyExpr(key_expression)
        self._broker.watchers.append((self, expression, on_change))
        for key in list(self._broker.alive):
            if expression.includes(zenoh.KeyExpr(key)):
                on_change(key, True)

    def close(self) -> None:
        """Leaves the broker; see `Transport.close`."""
        broker = self._broker
        with broker.lock:
            broker.handlers = {k: v for k, v in broker.handlers.items() if v[0] is not self}
            broker.subscriptions = [s for s in broker.subscriptions if s[0] is not self]
            broker.watchers = [w for w in broker.watchers if w[0] is not self]
            mine = [key for key, owner in broker.alive.items() if owner is self]
            for key in mine:
                del broker.alive[key]
        for key in mine:
            broker.change(key, False)

    def __enter__(self) -> "MemoryTransport":
        """The endpoint itself."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Closes."""
        self.close()
