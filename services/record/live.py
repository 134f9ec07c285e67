"""Serves log entries to the Foxglove app over its WebSocket as they happen."""

import asyncio
import collections
import contextlib
import heapq
import itertools
import queue
import re
import secrets
import socket
import sys
import threading
import time
import urllib.parse
from typing import Any

from congrasp.common.errors import PORT_ERRORS, need_package, os_errors_as
from congrasp.common.transport.base import Closing
from congrasp.common.transport.places import Places
from congrasp.services.record.writer import Channel, Entry

_HOST, _LOOPBACK = "127.0.0.1", ("127.0.0.1", "localhost", "::1")
_APP = "foxglove.dev"
"""Domain of the app in a browser."""
# Bytes of a request's head, and the time in which it must arrive
_HEAD, _HEAD_SECONDS = (
    16 << 10,
    10.0,
)
# Entries queued for their time; the newest beyond this are dropped
_BACKLOG, _BYTES = (
    20000,
    256 << 20,
)
_SOCKETS = 32  # connections at a time, shared by addresses
# Bytes that wait for a client that does not read, and the time after which it is dropped
_UNREAD, _UNREAD_SECONDS = (
    4 << 20,
    10.0,
)
_TOPICS = 4096  # open channels; beyond this the one that was silent for longest is closed
_KEPT = 64 << 20  # bytes of latched messages kept for late subscribers


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

        # Behind the gate, at an address of the loopback interface that other sites in a browser do
        # not know.
        inside = (
            f"127.{secrets.randbelow(254) + 1}.{secrets.randbelow(256)}."
            f"{secrets.randbelow(254) + 1}"
        )
        inside = inside if sys.platform == "linux" else _HOST
        with os_errors_as(
            f"The live view cannot listen on {_HOST}:{port}",
            "Pass another port with --live.",
            PORT_ERRORS,
        ):
            outside = socket.create_server((_HOST, port))
        self._server = foxglove.start_server(
            name="congrasp", host=inside, port=0, context=self._context, server_listener=Listener()
        )
        self.port = int(outside.getsockname()[1])
        self._gate = _Gate(outside, (inside, self._server.port))
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
        self._gate.close()
        self._server.stop()

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
        schema = self._sdk.Schema(
            name=channel.schema_name, encoding=channel.schema_encoding, data=channel.schema
        )
        opened = self._sdk.Channel(
            channel.topic, schema=schema, message_encoding=channel.encoding, context=self._context
        )
        self._topics[channel.topic] = channel, opened


class _Gate:
    """Passes connections on to the server of the SDK, which answers any site that a browser
    shows.
    """

    def __init__(self, outside: socket.socket, inside: tuple[str, int]):
        """Accepts connections of a listening socket, for the server at an address."""
        self._outside, self._inside = outside, inside
        self._places = Places(_SOCKETS)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, daemon=True, name="live gate")
        self._thread.start()

    def close(self) -> None:
        """Stops accepting, and ends all connections."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(1.0)
        self._outside.close()

    def _run(self) -> None:
        """Runs until it is closed."""
        asyncio.set_event_loop(loop := self._loop)
        loop.run_until_complete(asyncio.start_server(self._admit, sock=self._outside, limit=_HEAD))
        loop.run_forever()
        tasks = asyncio.all_tasks(loop)
        for task in tasks:
            task.cancel()
        loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        loop.close()

    async def _admit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Passes on a connection while there is room."""
        address = writer.get_extra_info("peername")[0]
        place = self._places.take(address, writer.transport.abort)
        if place is None:
            with contextlib.closing(writer), contextlib.suppress(OSError):
                _answer(writer, "503 Service Unavailable", f"{_SOCKETS} viewers are connected.")
            return
        try:
            await self._serve(reader, writer)
        finally:
            self._places.leave(place)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Passes on the connection of an allowed client, and answers others with the reason."""
        with (
            contextlib.closing(writer),
            contextlib.suppress(
                OSError, EOFError, ValueError, asyncio.LimitOverrunError, asyncio.CancelledError
            ),
        ):
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _HEAD_SECONDS)
            if fault := _fault(head.decode("latin-1")):
                _answer(writer, "403 Forbidden", fault)
                await asyncio.wait_for(writer.drain(), _HEAD_SECONDS)
                return
            to_reader, to_writer = await asyncio.open_connection(*self._inside)
            with contextlib.closing(to_writer):
                to_writer.write(head)
                await _relay(reader, writer, to_reader, to_writer)


def _answer(writer: asyncio.StreamWriter, status: str, text: str) -> None:
    """Sends an answer without a connection to the server behind."""
    body = f"{text}\n".encode()
    head = f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    writer.write(head.encode() + body)


async def _relay(
    reader: asyncio.StreamReader,
    writer: asyncio.StreamWriter,
    to_reader: asyncio.StreamReader,
    to_writer: asyncio.StreamWriter,
) -> None:
    """Copies both directions of a connection until one ends; then both are dropped at once."""
    writer.transport.set_write_buffer_limits(high=_UNREAD)
    directions = (
        asyncio.ensure_future(_pump(reader, to_writer)),
        asyncio.ensure_future(_pump(to_reader, writer)),
    )
    try:
        await asyncio.wait(directions, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for direction in directions:
            direction.cancel()
        await asyncio.gather(*directions, return_exceptions=True)
        for end in (writer, to_writer):
            if end.transport.get_write_buffer_size():
                end.transport.abort()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Copies one direction of a connection until it ends, or its receiver does not read."""
    while data := await reader.read(1 << 16):
        writer.write(data)
        await asyncio.wait_for(writer.drain(), _UNREAD_SECONDS)


def _fault(head: str) -> str:
    """Reason why a request is refused; empty if it comes from this machine or from the app.

    A site's name may resolve to this machine (DNS rebinding), so Host must name the loopback
    interface; a browser sends the site as Origin.
    """
    fields = (line.partition(":") for line in head.split("\r\n")[1:])
    headers = {name.strip().lower(): value.strip() for name, _, value in fields}
    host, origin = headers.get("host", ""), headers.get("origin", "file://")
    if re.sub(r":\d*$", "", host).strip("[]") not in _LOOPBACK:
        return (
            "The live view answers only under a name of the loopback interface: open "
            "ws://127.0.0.1 with its port."
        )
    site = urllib.parse.urlsplit(origin)
    name = site.hostname or ""
    own = (
        site.scheme not in ("", "http", "https")
        or name in _LOOPBACK
        or f".{name}".endswith(f".{_APP}")
    )
    return "" if own else "Another site asked for the live view: open it in the Foxglove app."
