"""HTTP servers of this process, with limited connections (`http_connections`)."""

import socket
import threading
from typing import Any

import uvicorn

from congrasp.common.transport.places import Places
from congrasp.services.ops.http_connections import TIMEOUT_S, ConnectionConfig

_MAX_WAITING = 128
"""Most connections that wait to be accepted; beyond them, a client's system retries after a
second."""
_CLOSING_TIMEOUT_S = 1
"""Time for the requests in progress when the server stops."""
_JOIN_TIMEOUT_S = 2.0


class HttpServer:
    """Serves an application in a daemon thread until it is closed."""

    def __init__(
        self, application: Any, listener: socket.socket, max_connections: int, **settings: Any
    ):
        """Starts the server's thread.

        Args:
          application: an ASGI application.
          listener: a `listening_socket`.
          max_connections: limit of the connections at a time, which addresses share.
          **settings: further settings of uvicorn.
        """
        config = ConnectionConfig(
            application,
            Places(max_connections),
            loop="asyncio",
            ws="none",
            log_config=None,
            log_level="critical",
            access_log=False,
            proxy_headers=False,
            server_header=False,
            timeout_keep_alive=int(TIMEOUT_S),
            timeout_graceful_shutdown=_CLOSING_TIMEOUT_S,
            **settings,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, args=([listener],), daemon=True, name="http"
        )
        self._thread.start()

    def close(self) -> None:
        """Stops the server."""
        self._server.should_exit = True
        self._thread.join(_JOIN_TIMEOUT_S)


def listening_socket(host: str, port: int) -> socket.socket:
    """Returns a socket that listens on a port of the interface with the address or name `host`.

    Raises:
      OSError: the port is busy, or there is no such interface.
      OverflowError: there is no such port.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(_MAX_WAITING)
    except BaseException:
        listener.close()
        raise
    return listener
