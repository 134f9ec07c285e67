"""Serves a studio over HTTP to browsers on this machine."""

import socket
import threading
from collections.abc import Callable, Sequence

import uvicorn

from congrasp.common.errors import PORT_ERRORS, os_errors_as
from congrasp.common.transport.places import Places
from congrasp.services.studio.access import Access
from congrasp.services.studio.application import page_application
from congrasp.services.studio.connections import TIMEOUT_S, ConnectionConfig
from congrasp.services.studio.routes import Routes

MAX_CONNECTIONS = 256  # at a time, shared by addresses; a browser opens six
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": (
        "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
        "frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
}
_HEAD_BYTES = 64 << 10
"""Limit of a request's head."""
_QUEUE = 128
"""Connections that wait to be accepted; a client retries after a second if there are more."""
_CLOSING_S = 1
"""Time for the requests in progress when the server stops."""
_JOIN_TIMEOUT_S = 2.0


class PageServer:
    """Serves the page and the routes of a studio until it is closed."""

    def __init__(
        self, routes: Callable[[str], Routes], host: str, port: int, names: Sequence[str] = ()
    ):
        """Listens.

        Args:
          routes: returns the routes of a browser, by the token in its cookie; an empty one without
            a cookie.
          host: interface; on loopback, only requests to a loopback name or one of `names` are
            answered.
          port: TCP port; 0 takes a free one (see `port`).
          names: names under which a proxy offers the page.

        Raises:
          CongraspError: the port is busy, or there is no such interface.
        """
        remedy = "Choose another --port, or end the process that uses it."
        with os_errors_as(f"The page cannot be offered at {host}:{port}", remedy, PORT_ERRORS):
            listener = listening_socket(host, port)
        self.port = int(listener.getsockname()[1])
        access = Access(host, self.port, names)
        self.url = access.url
        """URL of the page for a browser on this machine."""
        config = ConnectionConfig(
            page_application(routes, access, self.port),
            Places(MAX_CONNECTIONS),
            loop="asyncio",
            ws="none",
            log_config=None,
            log_level="critical",
            access_log=False,
            proxy_headers=False,
            server_header=False,
            headers=list(_HEADERS.items()),
            h11_max_incomplete_event_size=_HEAD_BYTES,
            timeout_keep_alive=int(TIMEOUT_S),
            timeout_graceful_shutdown=_CLOSING_S,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, args=([listener],), daemon=True, name="page"
        )
        self._thread.start()

    def close(self) -> None:
        """Stops the server."""
        self._server.should_exit = True
        self._thread.join(_JOIN_TIMEOUT_S)


def listening_socket(host: str, port: int) -> socket.socket:
    """Returns a socket that listens at an interface.

    Raises:
      OSError: the port is busy, or there is no such interface.
      OverflowError: there is no such port.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(_QUEUE)
    except BaseException:
        listener.close()
        raise
    return listener
