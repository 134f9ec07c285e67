"""In-process transport, without copies.

It behaves as over the wire, except that the option `fair` of `serve` has no effect. Arrays may
stay on a device. All endpoints of a `MemoryHub` see each other. A `PairTransport` combines two
transports, for a learner with an actor in its process.
"""

import contextlib
import functools
import logging
import queue
import threading
import time
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple

from congrasp.common.errors import CongraspError, RefusedError, TransportError, error_of
from congrasp.common.runtime import forks
from congrasp.common.transport.base import (
    Admission,
    Answerer,
    Damage,
    Subscription,
    Transport,
    join,
)
from congrasp.common.transport.keys import matches
from congrasp.common.wire.codec import Message

_log = logging.getLogger(__name__)
_GRACE = 5.0
"""Seconds that `close` waits for running handlers."""


class _Question(NamedTuple):
    key: str
    request: Message
    answer: "Future[Message]"


class _Server(NamedTuple):
    key: str
    questions: "queue.SimpleQueue[_Question | None]"
    """Queued queries; None ends one worker."""
    places: threading.Semaphore
    """Free places in the queue. A query takes one before it is queued."""
    workers: int
    ended: threading.Event


class _Watcher(NamedTuple):
    expression: str
    changes: "queue.Queue[tuple[str, bool] | None]"


class MemoryHub:
    """State shared by the endpoints of one process."""

    def __init__(self) -> None:
        self.fork_generation = forks.generation()
        self.lock = threading.Lock()
        self.servers: list[_Server] = []
        self.subscriptions: list[tuple[str, Subscription]] = []
        self.tokens: list[str] = []
        self.watchers: list[_Watcher] = []
        self.listening = False

    def notify(self, key: str, alive: bool) -> None:
        """Notifies the watchers; the caller holds the lock."""
        for watcher in self.watchers:
            if matches(watcher.expression, key):
                watcher.changes.put((key, alive))


class MemoryTransport(Transport):
    """A `Transport` between the endpoints of a hub."""

    def __init__(self, hub: MemoryHub, on_close: Callable[[], None] = lambda: None):
        """Creates an endpoint; `on_close` is called once, when it closes."""
        self._hub = hub
        self._on_close = on_close
        self._servers: list[_Server] = []
        self._subscriptions: list[Subscription] = []
        self._tokens: list[str] = []
        self._watchers: list[_Watcher] = []
        self._threads: list[threading.Thread] = []
        self._closed = False

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
        """See `Transport.serve`.

        `on_damage` is never called: messages are not encoded. `fair` has no effect: queries are
        answered in the order of their arrival, and those in excess of `depth` wait at their
        senders.
        """
        self._check_open()
        server = _Server(
            key, queue.SimpleQueue(), threading.Semaphore(depth), workers, threading.Event()
        )
        with self._hub.lock:
            self._hub.servers.append(server)
        self._servers.append(server)
        for _ in range(workers):
            self._start(f"memory-{key}", _serve, server, handler, admission or (lambda _: None))

    def query(self, key: str, request: Message, *, timeout: float) -> Message:
        """See `Transport.query`."""
        self._check_open()
        deadline = time.monotonic() + timeout
        with self._hub.lock:
            server = next(
                (server for server in self._hub.servers if matches(server.key, key)), None
            )
        if server is None:
            raise TransportError(
                f"No response for {key}.",
                "The process that serves it may have ended, or has another name.",
            )
        if not server.places.acquire(timeout=timeout):
            raise _late(key, timeout)
        question = _Question(key, request, Future())
        server.questions.put(question)
        if server.ended.is_set():
            # The server has closed since the lookup, and its workers may have ended
            _refuse_waiting(server)
        try:
            return question.answer.result(max(0.0, deadline - time.monotonic()))
        except TimeoutError:
            raise _late(key, timeout) from None

    def publish(self, key: str, message: Message) -> None:
        """See `Transport.publish`; does nothing once closed."""
        self._require_same_process()
        if self._closed:
            return
        with self._hub.lock:
            subscriptions = [
                ring for expression, ring in self._hub.subscriptions if matches(expression, key)
            ]
        for ring in subscriptions:
            ring.push(key, lambda: message)

    def subscribe(self, key_expression: str, *, depth: int) -> Subscription:
        """See `Transport.subscribe`."""
        self._check_open()

        def remove() -> None:
            with self._hub.lock, contextlib.suppress(ValueError):
                self._hub.subscriptions.remove((key_expression, subscription))

        subscription = Subscription(depth, remove)
        with self._hub.lock:
            self._hub.subscriptions.append((key_expression, subscription))
        self._subscriptions.append(subscription)
        return subscription

    def declare_alive(self, key: str) -> None:
        """See `Transport.declare_alive`."""
        self._check_open()
        with self._hub.lock:
            self._hub.tokens.append(key)
            self._hub.notify(key, True)
        self._tokens.append(key)

    def watch_alive(self, key_expression: str, on_change: Callable[[str, bool], None]) -> None:
        """See `Transport.watch_alive`."""
        self._check_open()
        watcher = _Watcher(key_expression, queue.Queue())
        with self._hub.lock:
            self._hub.watchers.append(watcher)
            for key in self._hub.tokens:
                if matches(key_expression, key):
                    watcher.changes.put((key, True))
        self._watchers.append(watcher)
        self._start("memory-alive", _watch, watcher, on_change)

    def close(self) -> None:
        """See `Transport.close`.

        Waits for its threads: a thread that releases a device array while the interpreter shuts
        down kills the process. In a fork it does nothing: the endpoint belongs to the process that
        opened it.
        """
        if self._closed or self._hub.fork_generation != forks.generation():
            return
        self._closed = True
        self._on_close()
        with self._hub.lock:
            for server in self._servers:
                self._hub.servers.remove(server)
            for watcher in self._watchers:
                self._hub.watchers.remove(watcher)
            for key in self._tokens:
                self._hub.tokens.remove(key)
                self._hub.notify(key, False)
        for watcher in self._watchers:
            watcher.changes.put(None)
        for server in self._servers:
            server.ended.set()
            _refuse_waiting(server)
        for subscription in self._subscriptions:
            subscription.close()
        join(self._threads, time.monotonic() + _GRACE)

    def _check_open(self) -> None:
        """Raises a TransportError if the endpoint is closed, and a ForkError in a fork."""
        self._require_same_process()
        if self._closed:
            raise TransportError("The transport is closed.")

    def _require_same_process(self) -> None:
        """Raises a ForkError in a fork, which lacks the threads of the hub's endpoints."""
        forks.require_same_process(self._hub.fork_generation, "connection")

    def _start(self, name: str, target: Callable[..., None], *arguments: object) -> None:
        """Runs a function in a daemon thread."""
        thread = threading.Thread(target=target, args=arguments, daemon=True, name=name)
        self._threads.append(thread)
        thread.start()


_named: weakref.WeakValueDictionary[str, MemoryHub] = weakref.WeakValueDictionary()
"""Hubs with an endpoint, by name."""
_listening = threading.Condition()
"""Protects `_named`, and is notified once a hub has a listener."""


def listen_in_memory(name: str) -> MemoryTransport:
    """Creates the listening endpoint of a named hub; raises a CongraspError if this process has
    one already.
    """
    with _listening:
        hub = _named.get(name)
        # In a fork, the listener of an inherited hub is in the process that opened it
        if hub is None or hub.fork_generation != forks.generation():
            hub = MemoryHub()
            _named[name] = hub
        if hub.listening:
            raise CongraspError(f"memory/{name} is in use in this process.", "Choose another name.")
        hub.listening = True
        _listening.notify_all()
    return MemoryTransport(hub, on_close=functools.partial(setattr, hub, "listening", False))


def connect_in_memory(name: str, wait: float) -> MemoryTransport:
    """Creates an endpoint of a named hub; raises a TransportError if there is no listener within
    `wait` seconds.
    """

    def listening_hub() -> MemoryHub | None:
        hub = _named.get(name)
        return hub if hub and hub.listening else None

    with _listening:
        hub = _listening.wait_for(listening_hub, wait)
    if hub:
        return MemoryTransport(hub)
    raise TransportError(
        f"No response from memory/{name}.", "It can only be reached within its process."
    )


def _late(key: str, timeout: float) -> TransportError:
    """Error of a query whose answer has not arrived within `timeout` seconds."""
    return TransportError(f"No answer for {key} within {timeout:g} s.")


def _refuse_waiting(server: _Server) -> None:
    """Fails the queued queries of a closed server, and ends its idle workers."""
    while True:
        try:
            question = server.questions.get_nowait()
        except queue.Empty:
            break
        if question is None:
            continue
        server.places.release()
        question.answer.set_exception(
            TransportError(f"No response for {question.key}: its server has closed.")
        )
    for _ in range(server.workers):
        server.questions.put(None)


def _serve(server: _Server, handler: Answerer, admission: Admission) -> None:
    """Answers queries until the server closes; runs in a separate thread."""
    while not server.ended.is_set():
        question = server.questions.get()
        if question is None:
            return
        server.places.release()
        _settle(question, functools.partial(_reply, question, handler, admission))


def _reply(
    question: _Question, handler: Answerer, admission: Admission
) -> "Message | Future[Message]":
    """Returns the reply of the admission if it rejects the query, else that of the handler."""
    return admission(question.key) or handler(question.key, question.request)


def _settle(question: _Question, compute: "Callable[[], Message | Future[Message]]") -> None:
    """Sets a query's answer to the result of a function, or to its exception. If the result is a
    future, the answer is set once that future is done.
    """
    try:
        result = compute()
        if isinstance(result, Future):
            result.add_done_callback(lambda done: _settle(question, done.result))
        else:
            question.answer.set_result(result)
    except CongraspError as error:
        question.answer.set_exception(error_of(error.code, str(error)))
    except Exception as error:
        _log.exception("The reply to %s failed.", question.key)
        question.answer.set_exception(
            RefusedError(f"The peer failed on {question.key}: {type(error).__name__}.")
        )


def _watch(watcher: _Watcher, on_change: Callable[[str, bool], None]) -> None:
    """Reports liveliness tokens; runs in a separate thread."""
    while (change := watcher.changes.get()) is not None:
        try:
            on_change(*change)
        except Exception:
            _log.exception("Handling the token %s failed.", change[0])


class PairTransport(Transport):
    """Two transports of the caller as one: queries and subscriptions use only the first, everything
    else uses both.
    """

    def __init__(self, first: Transport, second: Transport):
        self._first = first
        self._both = (first, second)

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
