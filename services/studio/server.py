"""Serves a studio over HTTP to browsers on this machine."""

from collections.abc import Callable, Sequence

from congrasp.common.errors import PORT_ERRORS, os_errors_as
from congrasp.services.ops.http_server import HttpServer, listening_socket
from congrasp.services.studio.access import Access
from congrasp.services.studio.application import page_application
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
        self._server = HttpServer(
            page_application(routes, access, self.port),
            listener,
            MAX_CONNECTIONS,
            headers=list(_HEADERS.items()),
            h11_max_incomplete_event_size=_HEAD_BYTES,
        )

    def close(self) -> None:
        """Stops the server."""
        self._server.close()
