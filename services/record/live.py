"""Serves log entries to the Foxglove app over its WebSocket as they happen."""

import collections
import heapq
import itertools
import queue
import threading
import time
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.services.record.channels import Channel, Entry

_HOST = "127.0.0.1"
_BACKLOG, _BYTES = 20000, 256 << 20  # entries queued for their time; the newest beyond this are dropped
_TOPICS = 4096  # open channels; beyond this the one that was silent for longest is closed
_KEPT = 64 << 20  # bytes of latched messages kept for late subscribers


class LiveServer:
    """A WebSocket server; a sink of `services.record.recorder.Recorder`.

    An episode arrives as a whole after its end; its entries are sent at their times, so that the viewer plays it. A
    late subscriber receives the last message of latched channels.
    """

    def __init__(self, port: int):
        """Listens on the loopback interface: there is no authentication, and every client can watch the run.

        Args:
          port: TCP port; 0 uses a free one (see `port`).

        Raises:
          CongraspError: the package is not installed, or the port is in use.
        """
        try:
            import foxglove
        except ImportError:
            raise CongraspError(
                "The live view needs the package 'foxglove-sdk'.", "Run: pip install 'congrasp[viz]'"
            ) from None
        self._sdk = foxglove
        self._context = foxglove.Context()
        self._topics: collections.OrderedDict[str, tuple[Channel, Any]] = collections.OrderedDict()
        self._last: collections.OrderedDict[str, Entry] = collections.OrderedDict()
        self._kept = self._held = 0  # bytes of these, and of queued entries
        self._changed = threading.Lock()  # guards `_held` and `left_out`
        self._waiting: list[tuple[int, int, Entry]] = []
        self._number = itertools.count()
        self._incoming: queue.SimpleQueue[Entry | str | None] = queue.SimpleQueue()
        self.left_out: collections.Counter[str] = collections.Counter()
        """Number of entries dropped because the queue was full, by topic."""
        live = self

        class Listener(foxglove.websocket.ServerListener):
            def on_subscribe(self, client: Any, channel: Any) -> None:
                live._incoming.put(channel.topic)

        try:
            self._server = foxglove.start_server(
                name="congrasp", host=_HOST, port=port, context=self._context, server_listener=Listener()
            )
        except (OSError, RuntimeError) as error:
            raise CongraspError(
                f"The live view cannot listen on {_HOST}:{port} ({error}).", "Pass another port with --live."
            ) from None
        self.port = self._server.port
        self._thread = threading.Thread(target=self._work, daemon=True, name="live view")
        self._thread.start()

    def write(self, entry: Entry) -> None:
        """Queues an entry until its time, or drops it if the queue is full."""
        with self._changed:
            if self._held + len(entry.data) > _BYTES or self._incoming.qsize() > _BACKLOG:
                self.left_out[entry.channel.topic] += 1
                return
            self._held += len(entry.data)
        self._incoming.put(entry)

    def close(self, timeout: float = 3.0) -> None:
        """Stops the server; queued entries are not sent."""
        self._incoming.put(None)
        self._thread.join(timeout)
        self._server.stop()

    def __enter__(self) -> "LiveServer":
        """Returns the server."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Closes."""
        self.close()

    def _work(self) -> None:
        """Sends entries at their times, and latched ones to new subscribers."""
        while True:
            wait = max(0.0, (self._waiting[0][0] - time.time_ns()) / 1e9) if self._waiting else None
            try:
                item = self._incoming.get(timeout=wait)
            except queue.Empty:
                self._send(self._let_go(heapq.heappop(self._waiting)[2]))
                continue
            if item is None:
                return
            if isinstance(item, str):
                if item in self._last:
                    self._send(self._last[item])
            elif len(self._waiting) < _BACKLOG:
                heapq.heappush(self._waiting, (item.time, next(self._number), item))
            else:
                self._let_go(item)
                with self._changed:
                    self.left_out[item.channel.topic] += 1

    def _let_go(self, entry: Entry) -> Entry:
        """Removes an entry from the accounting of the queue, and returns it."""
        with self._changed:
            self._held -= len(entry.data)
        return entry

    def _send(self, entry: Entry) -> None:
        """Sends an entry on its channel."""
        topic = entry.channel.topic
        if self._topics.get(topic, (None,))[0] != entry.channel:
            self._advertise(entry.channel)
        self._topics.move_to_end(topic)
        if entry.channel.latched:
            self._keep(entry)
        self._topics[topic][1].log(entry.data, log_time=entry.time)

    def _keep(self, entry: Entry) -> None:
        """Keeps the last message of a latched channel, within the limit of all topics."""
        before = self._last.pop(entry.channel.topic, None)
        self._last[entry.channel.topic] = entry
        self._kept += len(entry.data) - (len(before.data) if before else 0)
        while self._kept > _KEPT and len(self._last) > 1:
            self._kept -= len(self._last.popitem(last=False)[1].data)

    def _advertise(self, channel: Channel) -> None:
        """Opens a channel; a topic whose schema has grown gets a new one."""
        if channel.topic in self._topics:
            self._topics.pop(channel.topic)[1].close()
        elif len(self._topics) >= _TOPICS:
            self._topics.popitem(last=False)[1][1].close()
        schema = self._sdk.Schema(name=channel.schema_name, encoding=channel.schema_encoding, data=channel.schema)
        opened = self._sdk.Channel(
            channel.topic, schema=schema, message_encoding=channel.encoding, context=self._context
        )
        self._topics[channel.topic] = channel, opened
