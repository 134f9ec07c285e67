"""A link that can be cut, and that may be slow: its connections stay open, whatever it does."""

import contextlib
import dataclasses
import math
import queue
import random
import socket
import threading
import time
from collections.abc import Iterator

from congrasp.common.transport.keys import FLOWS
from congrasp.common.transport.ports import free_port, shifted

_CHUNK = 16 << 10
_CONNECT_SECONDS = 5.0
_SEGMENT = 1448
"""Bytes of a TCP segment."""
_MAX_CHUNKS_IN_TRANSIT = 4096
_LATE_S = 0.05
"""Time that is made up for if a thread of the link wakes up late."""
_PERIODIC_LOSS = math.sqrt(1.5)
"""Factor of the throughput of a TCP connection that loses segments (Mathis et al., 1997)."""


@dataclasses.dataclass(frozen=True)
class Medium:
    """Properties of a link in each direction."""

    delay_s: float = 0.0
    """Half of the round trip."""
    bytes_per_s: float = math.inf
    """Throughput of all connections together."""
    loss: float = 0.0
    """Share of the segments that are lost. A lost segment delays what follows on its connection by a
    round trip, and limits the connection to 1.22 segments / (round trip x sqrt(loss)), as in Mathis
    et al., 'The macroscopic behavior of the TCP congestion avoidance algorithm' (1997)."""

    @property
    def connection_bytes_per_s(self) -> float:
        """Limit of the throughput of one connection."""
        if not self.loss:
            return math.inf
        round_trip_s = max(2.0 * self.delay_s, 1e-3)
        return _PERIODIC_LOSS * _SEGMENT / (round_trip_s * math.sqrt(self.loss))


class _Rate:
    """Tells when bytes that share a throughput have been sent."""

    def __init__(self, bytes_per_s: float):
        self._bytes_per_s = bytes_per_s
        self._lock = threading.Lock()
        self._free_at = 0.0

    def sent_at(self, count: int, earliest: float) -> float:
        with self._lock:
            self._free_at = max(self._free_at, earliest - _LATE_S) + count / self._bytes_per_s
            return self._free_at


class Link:
    """An endpoint through which another one, with all its flows, is reached."""

    def __init__(self, medium: Medium | None = None) -> None:
        self.port = free_port()
        self.medium = medium or Medium()
        self.sent_up = 0
        """Bytes that were sent to the other endpoint."""
        self._up = _Rate(self.medium.bytes_per_s)
        self._down = _Rate(self.medium.bytes_per_s)
        self._open = threading.Event()
        self._open.set()
        self._ended = threading.Event()

    @property
    def endpoint(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    def cut(self) -> None:
        """Lets nothing pass, either way."""
        self._open.clear()

    def heal(self) -> None:
        """Lets everything pass again."""
        self._open.set()

    def close(self) -> None:
        self._ended.set()
        self._open.set()

    def serve(self, listener: socket.socket, target: tuple[str, int]) -> None:
        """Forwards connections until the listener is closed."""
        with contextlib.suppress(OSError), listener:
            while True:
                near, _ = listener.accept()
                threading.Thread(target=self._join, args=(near, target), daemon=True).start()

    def _join(self, near: socket.socket, target: tuple[str, int]) -> None:
        self._open.wait()
        try:
            far = socket.create_connection(target, _CONNECT_SECONDS)
        except OSError:
            near.close()
            return
        far.settimeout(None)
        for end in (near, far):
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._pump(near, far, self._up)
        self._pump(far, near, self._down)

    def _pump(self, source: socket.socket, sink: socket.socket, rate: _Rate) -> None:
        """Starts the threads of one direction of a connection."""
        transit: queue.Queue[tuple[float, bytes]] = queue.Queue(_MAX_CHUNKS_IN_TRANSIT)
        threading.Thread(target=self._take, args=(source, transit, rate), daemon=True).start()
        threading.Thread(target=self._deliver, args=(transit, sink), daemon=True).start()

    def _take(self, source: socket.socket, transit: queue.Queue, rate: _Rate) -> None:
        """Reads a connection no faster than the medium sends, and notes when data arrive."""
        medium = self.medium
        connection = _Rate(medium.connection_bytes_per_s)
        rng = random.Random(0)
        arrives_at = 0.0
        with contextlib.suppress(OSError), source:
            while not self._ended.is_set():
                data = source.recv(_CHUNK)
                if not data:
                    break
                now = time.monotonic()
                sent_at = connection.sent_at(len(data), rate.sent_at(len(data), now))
                delay_s = medium.delay_s
                if rng.random() < 1.0 - (1.0 - medium.loss) ** math.ceil(len(data) / _SEGMENT):
                    delay_s *= 3.0
                arrives_at = max(arrives_at, sent_at + delay_s)
                if rate is self._up:
                    self.sent_up += len(data)
                transit.put((arrives_at, data))
                time.sleep(max(0.0, sent_at - time.monotonic()))
        transit.put((arrives_at, b""))

    def _deliver(self, transit: queue.Queue, sink: socket.socket) -> None:
        """Writes data when they arrive; nothing while the link is cut."""
        with contextlib.suppress(OSError), sink:
            while True:
                arrives_at, data = transit.get()
                time.sleep(max(0.0, arrives_at - time.monotonic()))
                self._open.wait()
                if not data or self._ended.is_set():
                    return
                sink.sendall(data)


@contextlib.contextmanager
def cuttable(endpoint: str, medium: Medium | None = None) -> Iterator[Link]:
    """A link to an endpoint while the block runs."""
    link = Link(medium)
    listeners: list[socket.socket] = []
    for index in range(len(FLOWS)):
        host, _, number = shifted(endpoint, index).partition("/")[2].rpartition(":")
        listener = socket.create_server(("127.0.0.1", link.port + index))
        listeners.append(listener)
        target = host, int(number)
        threading.Thread(target=link.serve, args=(listener, target), daemon=True).start()
    try:
        yield link
    finally:
        link.close()
        for listener in listeners:
            listener.close()
