"""Connections of browsers: a limited number, whose clients must send and read in time.

uvicorn limits neither a client that sends a head slowly nor one that does not read its answer.
"""

import asyncio
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.utils import get_remote_addr

from congrasp.common.transport.places import Place, Places

TIMEOUT_S = 30.0
"""Time in which a request's head must arrive, and an answer must be read."""
REST_S = 1.0
"""Time in which the rest of a body is discarded that was answered without it, so that the client
reads the answer before the close.
"""
_FULL = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nRetry-After: 5\r\n"
    b"Connection: close\r\n\r\n"
)


class ConnectionConfig(uvicorn.Config):
    """Settings of a server whose connections take places."""

    def __init__(self, app: Any, places: Places, **settings: Any):
        """Uses the places of the connections, and further settings of uvicorn."""
        super().__init__(app, http=Connection, **settings)
        self.places = places


class Connection(H11Protocol):
    """Connection of a browser, which has a place."""

    config: ConnectionConfig
    _place: Place | None = None
    _head_deadline: asyncio.TimerHandle
    _reading_deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Waits for a request, or answers that there is no room for the connection."""
        address = get_remote_addr(transport) or ("", 0)
        self._place = self.config.places.take(address[0], transport.abort)
        if self._place is None:
            transport.write(_FULL)
            transport.close()
            return
        transport.set_write_buffer_limits(high=0)  # every unread byte has a deadline
        super().connection_made(transport)
        self._await_head(TIMEOUT_S)

    def connection_lost(self, exc: Exception | None) -> None:
        """Makes room for another connection."""
        if self._place is None:
            return
        self._head_deadline.cancel()
        self._cancel_reading_deadline()
        self.config.places.leave(self._place)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Reads bytes of a request; the deadline ends with its head."""
        cycle = self.cycle
        super().data_received(data)
        if self.cycle is not cycle:  # uvicorn makes one for each complete head
            self._head_deadline.cancel()

    def on_response_complete(self) -> None:
        """Waits for the next request, unless it has already arrived."""
        cycle = self.cycle
        super().on_response_complete()
        if self.cycle is not cycle:  # the head of the next request
            return
        seconds = TIMEOUT_S
        if self.conn.their_state is h11.SEND_BODY:
            seconds = REST_S
        self._await_head(seconds)

    def pause_writing(self) -> None:
        """Waits for the client to read what was sent."""
        super().pause_writing()
        self._reading_deadline = self.loop.call_later(TIMEOUT_S, self.transport.abort)

    def resume_writing(self) -> None:
        """Continues after the client has read everything."""
        super().resume_writing()
        self._cancel_reading_deadline()

    def _await_head(self, seconds: float) -> None:
        """Ends the connection unless a request's head arrives in time, at whatever speed."""
        self._head_deadline = self.loop.call_later(seconds, self.transport.abort)

    def _cancel_reading_deadline(self) -> None:
        """Cancels the deadline for an answer, if there is one."""
        if self._reading_deadline is not None:
            self._reading_deadline.cancel()
