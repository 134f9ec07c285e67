"""Serves log entries to the Foxglove app over its WebSocket as they happen."""

import collections
import heapq
import itertools
import queue
import secrets
import socket
import threading
import time
from typing import Any

from congrasp.common.errors import PORT_ERRORS, need_package, os_errors_as
from congrasp.common.runtime import platforms
from congrasp.common.transport.base import Closing
from congrasp.services.record.live_gate import LOCAL_HOST, LiveGate
from congrasp.services.record.writer import Channel, Entry

_MAX_QUEUED_ENTRIES = 20000
"""Most entries queued for their time; newer ones are dropped."""
MAX_QUEUED_BYTES = 256 << 20
"""Most bytes of the entries queued for their time."""
_MAX_CHANNELS = 4096
"""Most open channels; a further one closes the one that was silent for longest."""
_MAX_LATCHED_BYTES = 64 << 20
"""Most bytes of latched messages kept for late subscribers."""
_MAX_BURST_BYTES = 256 << 10
"""Bytes that are sent before the gate must have read them (`LiveGate.wait_until_read`)."""
_READ_TIMEOUT_S = 1.0
"""Longest wait for the gate; then the entry is dropped."""


class LiveServer(Closing):
    """A WebSocket server; a sink of `services.record.recorder.Recorder`.

    An episode arrives as a whole after its end; its entries are sent at their times, so that the
    viewer plays it. A late subscriber receives the last message of latched channels.
    """

    def __init__(self, port: int):
        """Listens on the loopback interface: programs of this machine and the Foxglove app can
        watch the run.

        Args:
          port: TCP port; 0 uses a free one (see `port`).

        Raises:
          CongraspError: the package is not installed, or the port is in use.
        """
        need_package("The live view", "foxglove")
        import foxglove

        self._sdk = foxglove
        self._context = foxglove.Context()
        # By topic, our channel and the SDK's; the one that was silent for longest comes first.
        self._channels: collections.OrderedDict[str, tuple[Channel, Any]]
        self._channels = collections.OrderedDict()
        # By topic; the oldest comes first.
        self._last_latched: collections.OrderedDict[str, Entry] = collections.OrderedDict()
        self._latched_bytes = 0
        self._burst_bytes = 0  # sent since the gate had read everything
        self.queued_bytes = 0
        """Bytes of the entries that wait for their time."""
        self._accounting = threading.Lock()  # guards `queued_bytes` and `left_out`
        # A heap by time (ns) and number; the number is unique, because entries have no order.
        self._waiting: list[tuple[int, int, Entry]] = []
        self._entry_numbers = itertools.count()
        # Entries, topics with a new subscriber, and None to end.
        self._incoming: queue.SimpleQueue[Entry | str | None] = queue.SimpleQueue()
        self.left_out: collections.Counter[str] = collections.Counter()
        """Number of entries dropped because the queue was full, by topic."""
        live = self

        class Listener(foxglove.websocket.ServerListener):
            """Notifies the server of subscriptions."""

            def on_subscribe(self, client: Any, channel: Any) -> None:
                """Queues the topic, whose latched message the client needs."""
                live._incoming.put(channel.topic)

        with os_errors_as(
            f"The live view cannot listen on {LOCAL_HOST}:{port}",
            "Pass another port with --live.",
            PORT_ERRORS,
        ):
            outside = socket.create_server((LOCAL_HOST, port))
        inside = _inside_host()
        self._server = foxglove.start_server(
            name="congrasp", host=inside, port=0, context=self._context, server_listener=Listener()
        )
        self.port = int(outside.getsockname()[1])
        self._gate = LiveGate(outside, (inside, self._server.port))
        self._thread = threading.Thread(target=self._work, daemon=True, name="live view")
        self._thread.start()

    def write(self, entry: Entry) -> None:
        """Queues an entry until its time, or drops it if the queue is full."""
        with self._accounting:
            queued_bytes = self.queued_bytes + len(entry.data)
            if queued_bytes > MAX_QUEUED_BYTES or self._incoming.qsize() > _MAX_QUEUED_ENTRIES:
                self.left_out[entry.channel.topic] += 1
                return
            self.queued_bytes = queued_bytes
        self._incoming.put(entry)

    def close(self, timeout: float = 3.0) -> None:
        """Stops the server; queued entries are not sent."""
        self._incoming.put(None)
        self._thread.join(timeout)
        self._gate.close()
        self._server.stop()

    def _work(self) -> None:
        """Sends entries at their times, and latched ones to new subscribers."""
        while True:
            try:
                item = self._incoming.get(timeout=self._seconds_to_next())
            except queue.Empty:
                _, _, entry = heapq.heappop(self._waiting)
                self._release(entry)
                self._send(entry)
                continue
            if item is None:
                return
            if isinstance(item, Entry):
                self._schedule(item)
            elif item in self._last_latched:
                self._send(self._last_latched[item])

    def _seconds_to_next(self) -> float | None:
        """Time until the next entry is to be sent, s; None if none is queued."""
        if not self._waiting:
            return None
        due, _, _ = self._waiting[0]
        return max(0.0, (due - time.time_ns()) / 1e9)

    def _schedule(self, entry: Entry) -> None:
        """Queues an entry until its time, or drops it if too many are queued."""
        if len(self._waiting) < _MAX_QUEUED_ENTRIES:
            heapq.heappush(self._waiting, (entry.time, next(self._entry_numbers), entry))
            return
        self._release(entry)
        self._count_left_out(entry.channel.topic)

    def _count_left_out(self, topic: str) -> None:
        """Counts a dropped entry of a topic."""
        with self._accounting:
            self.left_out[topic] += 1

    def _release(self, entry: Entry) -> None:
        """Removes an entry from the accounting of the queue."""
        with self._accounting:
            self.queued_bytes -= len(entry.data)

    def _send(self, entry: Entry) -> None:
        """Sends an entry on its channel, or drops it if the gate is behind."""
        topic = entry.channel.topic
        if self._burst_bytes > _MAX_BURST_BYTES:
            if not self._gate.wait_until_read(_READ_TIMEOUT_S):
                self._count_left_out(topic)
                return
            self._burst_bytes = 0
        self._burst_bytes += len(entry.data)
        channel, _ = self._channels.get(topic, (None, None))
        if channel != entry.channel:
            self._open_channel(entry.channel)
        self._channels.move_to_end(topic)
        if entry.channel.latched:
            self._keep_latched(entry)
        _, opened = self._channels[topic]
        opened.log(entry.data, log_time=entry.time)

    def _keep_latched(self, entry: Entry) -> None:
        """Keeps the last message of a latched channel, within the limit of all topics."""
        replaced = self._last_latched.pop(entry.channel.topic, None)
        if replaced is not None:
            self._latched_bytes -= len(replaced.data)
        self._last_latched[entry.channel.topic] = entry
        self._latched_bytes += len(entry.data)
        while self._latched_bytes > _MAX_LATCHED_BYTES and len(self._last_latched) > 1:
            _, oldest = self._last_latched.popitem(last=False)
            self._latched_bytes -= len(oldest.data)

    def _open_channel(self, channel: Channel) -> None:
        """Opens a channel; one of the same topic, whose schema has grown, is closed."""
        if channel.topic in self._channels:
            _, outdated = self._channels.pop(channel.topic)
            outdated.close()
        elif len(self._channels) >= _MAX_CHANNELS:
            _, (_, silent) = self._channels.popitem(last=False)
            silent.close()
        schema = self._sdk.Schema(
            name=channel.schema_name, encoding=channel.schema_encoding, data=channel.schema
        )
        opened = self._sdk.Channel(
            channel.topic, schema=schema, message_encoding=channel.encoding, context=self._context
        )
        self._channels[channel.topic] = (channel, opened)


def _inside_host() -> str:
    """Address for the SDK's server, behind the gate: on Linux a random one of the loopback
    interface, so that the pages of other sites in a browser cannot know it.
    """
    if not platforms.HAS_LOOPBACK_NETWORK:
        return LOCAL_HOST
    second = secrets.randbelow(254) + 1
    third = secrets.randbelow(256)
    fourth = secrets.randbelow(254) + 1
    return f"127.{second}.{third}.{fourth}"
