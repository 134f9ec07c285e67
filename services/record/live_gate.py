"""Gate of the live view: admits programs of this machine and the Foxglove app alone, and relays
their connections to the SDK's server, which itself would answer any site in a browser.
"""

import asyncio
import contextlib
import re
import selectors
import socket
import threading
import time
import urllib.parse
from asyncio.trsock import TransportSocket

from congrasp.common.transport.places import Places
from congrasp.services.ops.logs import log

LOCAL_HOST = "127.0.0.1"
_LOOPBACK = (LOCAL_HOST, "localhost", "::1")
_APP = "foxglove.dev"
"""Domain of the app in a browser."""
_MAX_HEAD_BYTES = 16 << 10
"""Limit of the head of a request."""
_HEAD_TIMEOUT_S = 10.0
"""Time in which the head must arrive."""
_MAX_VIEWERS = 32
"""Most connections at a time, which the addresses share."""
UNREAD_BYTES = 64 << 20
"""Most bytes that wait for all viewers together; beyond them the viewer with the most unread bytes
is dropped."""
_REPORT_INTERVAL_S = 60.0
"""Least time between two log lines on dropped viewers."""
_CHUNK_BYTES = 1 << 16
_POLL_S = 0.001
"""Time between two checks for unread bytes."""
_REQUEST_TIMEOUT_S = 10.0
"""Time in which the SDK's server must read what a viewer sends."""
_CLOSING_TIMEOUT_S = 1.0


class LiveGate:
    """Relays the connections of admitted viewers to the SDK's server.

    It reads at once what that server sends, since the server's queue for a viewer is limited by
    the number of messages but not by bytes. The bytes that viewers have not read wait here, up to
    `UNREAD_BYTES`.
    """

    def __init__(self, outside: socket.socket, inside: tuple[str, int]):
        """Starts a thread that accepts connections.

        Args:
          outside: the listening socket for viewers; `close` closes it.
          inside: address and port of the SDK's server.
        """
        self._outside = outside
        self._inside = inside
        self._places = Places(_MAX_VIEWERS)
        self._viewers: dict[asyncio.WriteTransport, TransportSocket] = {}
        """For each viewer's connection, the gate's socket to the SDK's server."""
        self._dropped = 0
        self._next_report_time = 0.0
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, daemon=True, name="live gate")
        self._thread.start()

    def close(self) -> None:
        """Stops accepting, and ends all connections."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_CLOSING_TIMEOUT_S)
        self._outside.close()

    def wait_until_read(self, timeout: float) -> bool:
        """Waits until the gate has read what the SDK's server has sent.

        Args:
          timeout: longest wait, s.

        Returns:
          False after the timeout.
        """
        reading = asyncio.run_coroutine_threadsafe(self._read_all(), self._loop)
        try:
            reading.result(timeout)
        except TimeoutError:
            reading.cancel()
            return False
        return True

    async def _read_all(self) -> None:
        """Returns when no bytes of the SDK's server wait for the gate."""
        while self._has_unread():
            await asyncio.sleep(_POLL_S)

    def _has_unread(self) -> bool:
        """True if bytes of the SDK's server wait for the gate."""
        with selectors.DefaultSelector() as selector:
            for to_socket in self._viewers.values():
                if to_socket.fileno() >= 0:  # not closed since
                    selector.register(to_socket, selectors.EVENT_READ)
            return bool(selector.select(0))

    def _run(self) -> None:
        """Accepts and relays connections until `close` stops the loop."""
        loop = self._loop
        asyncio.set_event_loop(loop)
        server = asyncio.start_server(self._admit, sock=self._outside, limit=_MAX_HEAD_BYTES)
        loop.run_until_complete(server)
        loop.run_forever()
        tasks = asyncio.all_tasks(loop)
        for task in tasks:
            task.cancel()
        loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        loop.close()

    async def _admit(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serves a connection if there is a place for it."""
        address = writer.get_extra_info("peername")[0]
        place = self._places.take(address, writer.transport.abort)
        if place is None:
            with contextlib.closing(writer), contextlib.suppress(OSError):
                _answer(writer, "503 Service Unavailable", f"{_MAX_VIEWERS} viewers are connected.")
            return
        try:
            await self._serve(reader, writer)
        finally:
            self._places.leave(place)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Relays the connection of an allowed client; others get the reason as the answer."""
        with (
            contextlib.closing(writer),
            contextlib.suppress(
                OSError, EOFError, ValueError, asyncio.LimitOverrunError, asyncio.CancelledError
            ),
        ):
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _HEAD_TIMEOUT_S)
            refusal = _refusal(head.decode("latin-1"))
            if refusal:
                _answer(writer, "403 Forbidden", refusal)
                await asyncio.wait_for(writer.drain(), _HEAD_TIMEOUT_S)
                return
            await self._connect(head, reader, writer)

    async def _connect(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Relays an admitted connection, whose `head` has been read, until it ends."""
        to_reader, to_writer = await asyncio.open_connection(*self._inside)
        with contextlib.closing(to_writer):
            to_writer.write(head)
            self._viewers[writer.transport] = to_writer.get_extra_info("socket")
            try:
                await self._relay(reader, writer, to_reader, to_writer)
            finally:
                del self._viewers[writer.transport]

    async def _relay(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        to_reader: asyncio.StreamReader,
        to_writer: asyncio.StreamWriter,
    ) -> None:
        """Copies both directions of a connection until one ends; then both are dropped at once."""
        directions = (
            asyncio.ensure_future(_copy_requests(reader, to_writer)),
            asyncio.ensure_future(self._copy_messages(to_reader, writer)),
        )
        try:
            await asyncio.wait(directions, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for direction in directions:
                direction.cancel()
            await asyncio.gather(*directions, return_exceptions=True)
            for receiver in (writer, to_writer):
                if receiver.transport.get_write_buffer_size():
                    receiver.transport.abort()

    async def _copy_messages(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Copies messages to a viewer until the connection ends."""
        while data := await reader.read(_CHUNK_BYTES):
            writer.write(data)
            self._limit_unread()
            if writer.transport.is_closing():
                return

    def _limit_unread(self) -> None:
        """Drops the slowest viewers until the unread bytes of the others are within the limit."""
        unread = {viewer: viewer.get_write_buffer_size() for viewer in self._viewers}
        while sum(unread.values()) > UNREAD_BYTES:
            slowest = max(unread, key=lambda viewer: unread[viewer])
            slowest.abort()
            del unread[slowest]
            self._report_dropped()

    def _report_dropped(self) -> None:
        """Counts a dropped viewer, and logs their number now and then."""
        self._dropped += 1
        now = time.monotonic()
        if now < self._next_report_time:
            return
        self._next_report_time = now + _REPORT_INTERVAL_S
        log(
            "warning",
            f"The live view has dropped {self._dropped} viewer(s) that did not read fast enough.",
        )


def _answer(writer: asyncio.StreamWriter, status: str, text: str) -> None:
    """Sends an answer of the gate itself."""
    body = f"{text}\n".encode()
    head = f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    writer.write(head.encode() + body)


async def _copy_requests(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Copies what a viewer sends until the connection ends."""
    while data := await reader.read(_CHUNK_BYTES):
        writer.write(data)
        await asyncio.wait_for(writer.drain(), _REQUEST_TIMEOUT_S)


def _refusal(head: str) -> str:
    """Reason why a request is refused; empty if it comes from this machine or from the app.

    A site's name may resolve to this machine (DNS rebinding), so Host must name the loopback
    interface; a browser sends the site as Origin.
    """
    headers = {}
    for line in head.split("\r\n")[1:]:
        name, _, value = line.partition(":")
        headers[name.strip().lower()] = value.strip()
    host = re.sub(r":\d*$", "", headers.get("host", "")).strip("[]")
    if host not in _LOOPBACK:
        return (
            "The live view answers only under a name of the loopback interface: open "
            "ws://127.0.0.1 with its port."
        )
    if _is_allowed(headers.get("origin", "file://")):
        return ""
    return "Another site asked for the live view: open it in the Foxglove app."


def _is_allowed(origin: str) -> bool:
    """True for the app in a browser, pages of this machine, and programs that are not sites."""
    site = urllib.parse.urlsplit(origin)
    if site.scheme not in ("", "http", "https"):
        return True
    name = site.hostname or ""
    return name in _LOOPBACK or f".{name}".endswith(f".{_APP}")
