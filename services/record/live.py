"""Offers log entries to the Foxglove app over its WebSocket while they happen."""

import collections
import heapq
import itertools
import queue
import threading
import time
from typing import Any

from common.errors import CongraspError
from services.record.channels import Channel, Entry

_HOST = "127.0.0.1"
_BACKLOG = 20000  # entries that may wait for their time; beyond it the newest are left out


class LiveServer:
    """A WebSocket server; a sink of `services.record.recorder.Recorder`.

    An episode arrives at once, after it has happened; its entries are sent when their time comes, so that the viewer
    plays it. Whoever subscribes later is given the last message of latched channels.
    """

    def __init__(self, port: int):
        """Listens on the loopback interface: there is no authentication, and anyone who reaches it sees the run.

        Args:
          port: TCP port; 0 takes a free one (see `port`).

        Raises:
          CongraspError: the package is absent, or the port is busy.
        """
        try:
            import foxglove
        except ImportError:
            raise CongraspError(
                "The live view needs the package 'foxglove-sdk'.", "Run: pip install 'congrasp[viz]'"
            ) from None
        self._sdk = foxglove
        self._context = foxglove.Context()
        self._channels: dict[Channel, Any] = {}
        self._topics: dict[str, Any] = {}
        self._last: dict[str, Entry] = {}
        self._waiting: list[tuple[int, int, Entry]] = []
        self._number = itertools.count()
        self._incoming: queue.SimpleQueue[Entry | str | None] = queue.SimpleQueue()
        self.left_out: collections.Counter[str] = collections.Counter()
        """Entries that were not sent because too many waited, by topic."""
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
                f"The live view cannot listen on {_HOST}:{port} ({error}).", "Choose another port with --live."
            ) from None
        self.port = self._server.port
        self._thread = threading.Thread(target=self._work, daemon=True, name="live view")
        self._thread.start()

    def write(self, entry: Entry) -> None:
        """Takes an entry; it is sent at its time."""
        self._incoming.put(entry)

    def close(self, timeout: float = 3.0) -> None:
        """Ends the server; entries whose time has not come are not sent."""
        self._incoming.put(None)
        self._thread.join(timeout)
        self._server.stop()

    def __enter__(self) -> "LiveServer":
        """The server itself."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Closes."""
        self.close()

    def _work(self) -> None:
        """Sends entries when their time comes, and latched ones to new subscribers."""
        while True:
            wait = max(0.0, (self._waiting[0][0] - time.time_ns()) / 1e9) if self._waiting else None
            try:
                item = self._incoming.get(timeout=wait)
            except queue.Empty:
                self._send(heapq.heappop(self._waiting)[2])
                continue
            if item is None:
                return
            if isinstance(item, str):
                if item in self._last:
                    self._send(self._last[item])
            elif len(self._waiting) < _BACKLOG:
                heapq.heappush(self._waiting, (item.time, next(self._number), item))
            else:
                self.left_out[item.channel.topic] += 1

    def _send(self, entry: Entry) -> None:
        """Sends an entry on its channel."""
        if entry.channel not in self._channels:
            self._advertise(entry.channel)
        if entry.channel.latched:
            self._last[entry.channel.topic] = entry
        self._channels[entry.channel].log(entry.data, log_time=entry.time)

    def _advertise(self, channel: Channel) -> None:
        """Opens a channel; a topic whose schema has grown gets a new one in place of the old."""
        if channel.topic in self._topics:
            self._topics[channel.topic].close()
        schema = self._sdk.Schema(name=channel.schema_name, encoding=channel.schema_encoding, data=channel.schema)
        opened = self._sdk.Channel(
            channel.topic, schema=schema, message_encoding=channel.encoding, context=self._context
        )
        self._channels[channel] = self._topics[channel.topic] = opened
