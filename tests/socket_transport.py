"""A transport from outside: importing this file makes URLs `socket/PATH` open, over Unix sockets.

The listener keeps an in-memory hub; each connection has an endpoint of its own in it, which does
what the frames ask for and sends back the outcome. A frame is a length, a line of JSON and, where
there is one, an encoded message.
"""

import contextlib
import itertools
import json
import socket
import struct
import threading
import time
from concurrent.futures import Future, InvalidStateError

from congrasp.common import errors
from congrasp.common.errors import CongraspError, RefusedError, TransportError
from congrasp.common.transport.base import Subscription
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.transport.urls import SCHEMES
from congrasp.common.wire.codec import decode, encode

ERRORS = {name: one for name, one in vars(errors).items() if isinstance(one, type)}
LENGTH = struct.Struct("<Q")


class Frames:
    """One end of a connection: sends frames, and gives those that arrive to `handle(head, message)
    -> reply`.
    """

    def __init__(self, connection, handle, on_end):
        self._socket = connection
        self._file = connection.makefile("rb")
        self._handle = handle
        self._on_end = on_end
        self._numbers = itertools.count()
        self._answers = {}
        self._lock = threading.Lock()
        self.ended = False
        threading.Thread(target=self._read, daemon=True).start()

    def send(self, head, message=None):
        data = json.dumps(head).encode() + b"\n" + (encode(message) if message else b"")
        with self._lock, contextlib.suppress(OSError):
            self._socket.sendall(LENGTH.pack(len(data)) + data)

    def call(self, head, message=None, timeout=10.0):
        """Sends a frame and returns the reply, or raises what the peer raised."""
        number = next(self._numbers)
        self._answers[number] = answer = Future()
        try:
            if self.ended:
                raise TransportError("The transport is closed.")
            self.send({**head, "number": number}, message)
            return answer.result(timeout)
        except TimeoutError:
            raise TransportError(f"No answer for {head['key']} within {timeout:g} s.") from None
        finally:
            del self._answers[number]

    def close(self):
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def _read(self):
        while len(start := self._part(LENGTH.size)) == LENGTH.size:
            line, _, body = self._part(*LENGTH.unpack(start)).partition(b"\n")
            head = json.loads(line)
            message = decode(body) if body else None
            if "settles" in head:
                self._settle(head, message)
            elif "number" in head:
                threading.Thread(target=self._reply, args=(head, message), daemon=True).start()
            else:
                self._handle(head, message)
        self.ended = True
        for answer in list(self._answers.values()):
            with contextlib.suppress(InvalidStateError):
                answer.set_exception(TransportError("The connection has ended."))
        self._on_end()

    def _part(self, size):
        with contextlib.suppress(OSError):
            return self._file.read(size)
        return b""

    def _settle(self, head, message):
        if answer := self._answers.get(head["settles"]):
            if "error" in head:
                answer.set_exception(ERRORS.get(head["error"], RefusedError)(head["text"]))
            else:
                answer.set_result(message)

    def _reply(self, head, message):
        reply = {"settles": head["number"]}
        try:
            self.send(reply, self._handle(head, message))
        except CongraspError as error:
            self.send({**reply, "error": type(error).__name__, "text": str(error)})


class Connection:
    """The listener's side of one connection: carries out its frames on an endpoint of the hub."""

    def __init__(self, connection, hub):
        self.endpoint = MemoryTransport(hub)
        self._begun = threading.Event()
        self.frames = Frames(connection, self.handle, self.endpoint.close)
        self._begun.set()

    def handle(self, head, message):
        self._begun.wait()  # the first frame may come before `frames` has its name
        key = head["key"]
        name = head.get("name")
        if head["do"] == "query":
            return self.endpoint.query(key, message, timeout=head["timeout"])
        if head["do"] == "publish":
            self.endpoint.publish(key, message)
        elif head["do"] == "declare":
            self.endpoint.declare_alive(key)
        elif head["do"] == "watch":
            self.endpoint.watch_alive(
                key,
                lambda token, alive: self.frames.send({"name": name, "key": token, "alive": alive}),
            )
        elif head["do"] == "serve":
            self.endpoint.serve(
                key,
                lambda key, request: self.frames.call({"name": name, "key": key}, request, 60),
                **head["options"],
            )
        else:
            subscription = self.endpoint.subscribe(key, depth=10_000)
            threading.Thread(target=self.forward, args=(name, subscription), daemon=True).start()

    def forward(self, name, subscription):
        while not self.frames.ended:
            if received := subscription.receive(1.0):
                self.frames.send({"name": name, "key": received[0]}, received[1])


class SocketListener(MemoryTransport):
    """The end that others connect to."""

    def __init__(self, path):
        hub = MemoryHub()
        self._connections = []
        try:
            self._listener = socket.create_server(path, family=socket.AF_UNIX)
        except OSError:
            raise CongraspError(f"socket/{path} is in use.", "Choose another path.") from None
        super().__init__(hub)
        threading.Thread(target=self._accept, args=(hub,), daemon=True).start()

    def _accept(self, hub):
        with contextlib.suppress(OSError):
            while True:
                self._connections.append(Connection(self._listener.accept()[0], hub))

    def close(self):
        super().close()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        for one in self._connections:
            one.frames.close()


class SocketTransport:
    """The end that connects."""

    def __init__(self, path, wait):
        deadline = time.monotonic() + wait
        connection = socket.socket(socket.AF_UNIX)
        while connection.connect_ex(path):
            if time.monotonic() > deadline:
                raise TransportError(f"No response from socket/{path}.")
            time.sleep(0.01)
        self._names = itertools.count()
        self._handlers = {}
        self._frames = Frames(
            connection,
            lambda head, message: self._handlers[head["name"]](head, message),
            self.close,
        )

    def serve(self, key, handler, *, on_damage=None, admission=None, **options):
        def answer(head, message):
            reply = (admission and admission(head["key"])) or handler(head["key"], message)
            return reply.result() if isinstance(reply, Future) else reply

        self._declare("serve", key, answer, options=options)

    def query(self, key, request, *, timeout):
        return self._frames.call(
            {"do": "query", "key": key, "timeout": timeout}, request, timeout + 1.0
        )

    def publish(self, key, message):
        self._frames.send({"do": "publish", "key": key}, message)

    def subscribe(self, key_expression, *, depth):
        subscription = Subscription(depth)
        self._declare(
            "subscribe", key_expression, lambda head, m: subscription.push(head["key"], lambda: m)
        )
        return subscription

    def declare_alive(self, key):
        self._declare("declare", key, None)

    def watch_alive(self, key_expression, on_change):
        self._declare(
            "watch", key_expression, lambda head, message: on_change(head["key"], head["alive"])
        )

    def _declare(self, what, key, handler, **more):
        name = next(self._names)
        self._handlers[name] = handler
        self._frames.call({"do": what, "key": key, "name": name, **more})

    def close(self):
        self._frames.close()

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.close()


def open_socket(endpoint):
    """The factory: what `connect` and `listen` call for these URLs."""
    if endpoint.listens:
        return SocketListener(endpoint.address)
    return SocketTransport(endpoint.address, endpoint.wait)


SCHEMES["socket"] = open_socket
