"""Gate of the live view: admits programs of this machine and the Foxglove app, and passes their
connections on to the server of the SDK, which would answer any site that a browser shows.
"""

import asyncio
import contextlib
import re
import socket
import threading
import urllib.parse

from congrasp.common.transport.places import Places

LOCAL_HOST = "127.0.0.1"
_LOOPBACK = (LOCAL_HOST, "localhost", "::1")
_APP = "foxglove.dev"
"""Domain of the app in a browser."""
_HEAD_BYTES = 16 << 10
"""Limit of a request's head."""
_HEAD_S = 10.0
"""Time in which the head must arrive."""
_SOCKETS = 32
"""Connections at a time, shared by addresses."""
_UNREAD_BYTES = 4 << 20
"""Bytes that wait for a client that does not read."""
UNREAD_S = 10.0
"""Time after which a client that does not read is dropped."""
_CHUNK_BYTES = 1 << 16
_CLOSING_S = 1.0


class LiveGate:
    """Passes connections on to the server of the SDK, which answers any site that a browser
    shows.
    """

    def __init__(self, outside: socket.socket, inside: tuple[str, int]):
        """Accepts connections of a listening socket, for the server at an address."""
        self._outside = outside
        self._inside = inside
        self._places = Places(_SOCKETS)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, daemon=True, name="live gate")
        self._thread.start()

    def close(self) -> None:
        """Stops accepting, and ends all connections."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_CLOSING_S)
        self._outside.close()

    def _run(self) -> None:
        """Runs until it is closed."""
        loop = self._loop
        asyncio.set_event_loop(loop)
        server = asyncio.start_server(self._admit, sock=self._outside, limit=_HEAD_BYTES)
        loop.run_until_complete(server)
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
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _HEAD_S)
            fault = _fault(head.decode("latin-1"))
            if fault:
                _answer(writer, "403 Forbidden", fault)
                await asyncio.wait_for(writer.drain(), _HEAD_S)
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
    writer.transport.set_write_buffer_limits(high=_UNREAD_BYTES)
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
        for receiver in (writer, to_writer):
            if receiver.transport.get_write_buffer_size():
                receiver.transport.abort()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Copies one direction of a connection until it ends, or its receiver does not read."""
    while data := await reader.read(_CHUNK_BYTES):
        writer.write(data)
        await asyncio.wait_for(writer.drain(), UNREAD_S)


def _fault(head: str) -> str:
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
    """True for the app in a browser, pages of this machine, and programs that are no sites."""
    site = urllib.parse.urlsplit(origin)
    if site.scheme not in ("", "http", "https"):
        return True
    name = site.hostname or ""
    return name in _LOOPBACK or f".{name}".endswith(f".{_APP}")
