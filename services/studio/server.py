"""Serves a studio over HTTP to browsers on this machine: a session for each, files, JSON, and
messages of arrays.
"""

import collections
import contextlib
import functools
import http.cookies
import http.server
import json
import pathlib
import re
import secrets
import socket
import threading
import time
import urllib.parse
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from congrasp.common.errors import PORT_ERRORS, CongraspError, os_errors_as
from congrasp.common.transport.places import Place, Places
from congrasp.common.wire.codec import Message, encode
from congrasp.services.ops.logs import log

STATIC = pathlib.Path(__file__).with_name("static")
MOST_BYTES = 128 << 20
"""Bytes of the largest request body, an uploaded mesh."""
MOST = 16
"""Maximum number of browsers; a further one ends the session that was used least recently, if it is
idle.
"""
IDLE = 1800.0
"""Seconds without a request after which a session is idle."""
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}
_POLICY = (
    "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "frame-ancestors 'none'"
)
_ROUTES = "/api/"
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_PAGE_PATH = re.compile("/(api|static(/vendor)?)/[^/]*$")
"""End of a path that belongs to the page, after the prefix of a proxy."""
_TOKEN = re.compile("[0-9a-f]{32}")
TIMEOUT_S = 30.0
"""Time that a connection may be silent, and that a request's head may take."""
_CONNECTIONS = 256  # at a time, shared by addresses; a browser opens six
_DRAINED_BYTES = 64 << 10
"""Bytes read of a refused body, so that the answer arrives before the close."""
_DRAIN_TIMEOUT_S = 1.0
_MAX_LENGTH_DIGITS = 19
"""Digits of a Content-Length."""
_BODY_TYPES = ("application/json", "application/octet-stream")
"""Types of a request's body; a form of another site cannot send them."""
_FULL = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nRetry-After: 5\r\n"
    b"Connection: close\r\n\r\n"
)


class BadRequest(CongraspError):
    """A malformed request; the page sends none."""


class Download(NamedTuple):
    """Bytes that a browser saves under a name."""

    name: str
    data: bytes


class Picture(NamedTuple):
    """A PNG file's content, which a browser shows."""

    png: bytes


Answer = dict[str, Any] | list[Any] | Message | Download | Picture
Get = Callable[[Mapping[str, str]], Answer]
"""Query parameters to answer."""
Post = Callable[[Mapping[str, str], bytes], Answer]
"""Query parameters and body to answer."""


class Routes(NamedTuple):
    """Handlers of requests, by path."""

    gets: Mapping[str, Get]
    posts: Mapping[str, Post]


class Session(Protocol):
    """Everything behind the page of one browser."""

    routes: Routes

    def close(self) -> None:
        """Ends it."""


class Sessions:
    """One session per browser, so that edits in one do not change the objects of others."""

    def __init__(self, new: Callable[[], Session]):
        """Opens the session of the first browser.

        Args:
          new: opens a session.

        Raises:
          CongraspError: `new` failed.
        """
        self._new = new
        self._spare = [new()]
        self._open: collections.OrderedDict[str, tuple[Session, float]] = collections.OrderedDict()
        self._lock = threading.Lock()

    def routes(self, browser: str) -> Routes:
        """Returns the routes of a browser's session, and opens one for a new browser.

        Raises:
          CongraspError: too many browsers use the studio.
        """
        with self._lock:
            now = time.monotonic()
            session, _ = self._open.pop(browser, (None, now))
            if session is None and len(self._open) >= MOST:
                oldest, used = next(iter(self._open.values()))
                if now - used < IDLE:
                    raise CongraspError(
                        f"{MOST} browsers, the maximum, use this studio.",
                        f"Try again after one of them has been idle for {IDLE / 60:.0f} minutes, "
                        f"or start another studio.",
                    )
                self._open.popitem(last=False)
                oldest.close()
            if session is None:
                session = self._spare.pop() if self._spare else self._new()
            self._open[browser] = (session, now)
            return session.routes

    def close(self) -> None:
        """Closes all sessions."""
        with self._lock:
            for session in self._spare:
                session.close()
            for session, _ in self._open.values():
                session.close()


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
            self._server = BoundedServer((host, port), _Handler)
        self._server.page = self
        self.routes = routes
        self.host = host
        self.port = int(self._server.server_address[1])
        self._named = set(names)
        self._names = {*_LOOPBACK, *names} if host in _LOOPBACK else None
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), daemon=True, name="page"
        )
        self._thread.start()

    @property
    def url(self) -> str:
        """URL of the page for a browser on this machine."""
        host = self.host
        if host in ("0.0.0.0", "::", ""):
            host = "127.0.0.1"
        elif ":" in host:
            host = f"[{host}]"
        return f"http://{host}:{self.port}/"

    def close(self) -> None:
        """Stops the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(2.0)

    def fault(self, request: http.server.BaseHTTPRequestHandler) -> str:
        """Reason why a request is refused, with the remedy; empty if it comes from the page itself.

        Other sites in the browser must not reach the page. A site's name may resolve to this
        machine (DNS rebinding), so the Host header must name this machine, or a proxy set by the
        user. Ports differ behind a tunnel.
        """
        return self._host_fault(request) or self._origin_fault(request)

    def _host_fault(self, request: http.server.BaseHTTPRequestHandler) -> str:
        """Reason why the Host header is refused; empty if it names this page."""
        host = _host_of(request)
        name = re.sub(r":\d*$", "", host).strip("[]")
        if host and (self._names is None or {host, name} & self._names):
            return ""
        shown_name = ascii(name)[:60]
        return (
            f"The page is not offered as {shown_name}. Open {self.url} or start it with "
            f"--allow-host {shown_name}."
        )

    def _origin_fault(self, request: http.server.BaseHTTPRequestHandler) -> str:
        """Reason why the sender of a request is refused; empty if it is this page."""
        host = _host_of(request)
        origin = request.headers.get("Origin")
        site = request.headers.get("Sec-Fetch-Site")
        sender = re.sub(r"^https?://|:\d*$", "", origin or "").strip("[]")
        # A proxy may put this server's address as Host, and leave the browser's Origin.
        is_page = origin in (None, f"http://{host}", f"https://{host}") or sender in self._named
        if is_page and site in (None, "none", "same-origin"):
            return ""
        proxy = ""
        if sender:
            proxy = (
                f" If that is a proxy of yours, start it with --allow-host {ascii(sender)[:60]}."
            )
        return f"Another site sent this request. Open the page itself, at {self.url}.{proxy}"


def _host_of(request: http.server.BaseHTTPRequestHandler) -> str:
    """Host header of a request; empty without one."""
    return request.headers.get("Host", "").strip()


def _disconnect(connection: socket.socket) -> None:
    """Ends a connection, which a thread is reading."""
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class BoundedServer(http.server.ThreadingHTTPServer):
    """HTTP server with a thread for each connection, and a limit of connections."""

    page: PageServer
    daemon_threads = True
    request_queue_size = 128  # the client retries a connection that finds no room, after a second

    def __init__(self, address: tuple[str, int], handler: Any):
        """Listens at (interface, port)."""
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        self._places = Places(_CONNECTIONS)
        self._place_of: dict[Any, Place] = {}
        super().__init__(address, handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serves a connection in a thread, or answers that there is no room for it."""
        place = self._places.take(client_address[0], functools.partial(_disconnect, request))
        if place is None:
            with contextlib.suppress(OSError):
                request.setblocking(False)
                request.send(_FULL)
            self.shutdown_request(request)
            return
        self._place_of[request] = place
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no thread can be started
            self._places.leave(self._place_of.pop(request))
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serves a connection, then makes room for another."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.leave(self._place_of.pop(request))

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignores browsers that disconnect during an answer."""


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = TIMEOUT_S
    server: BoundedServer

    def handle_one_request(self) -> None:
        """Serves one request, whose head must arrive within `TIMEOUT_S`, at whatever speed."""
        timer = threading.Timer(TIMEOUT_S, self._give_up)
        timer.daemon = True
        self._head_timer = timer
        timer.start()
        try:
            super().handle_one_request()
        finally:
            timer.cancel()

    def parse_request(self) -> bool:
        """Reads the headers; then the head is complete."""
        try:
            return super().parse_request()
        finally:
            self._head_timer.cancel()

    def _give_up(self) -> None:
        """Ends the connection, which a thread is reading."""
        _disconnect(self.connection)

    def do_GET(self) -> None:
        """Answers by a route, or with a file."""
        path, query = self._route()
        if self._refused():
            return
        if path == "/":
            self._file("index.html")
            return
        if not path.startswith(_ROUTES):
            self._file(path.removeprefix("/static/"))
            return
        routes = self._routes()
        if routes is None:
            return
        route = routes.gets.get(path)
        if route is None:
            self._send(404, "text/plain", b"There is no such page.")
            return
        self._answer(lambda: route(query))

    def do_POST(self) -> None:
        """Answers by a route; a request is refused by its headers, before its body is read."""
        path, query = self._route()
        length = self._body_length()
        route = self._post_route(path, length)
        if route is None:
            self._drain(length)
            return
        body = self.rfile.read(length)
        self._answer(lambda: route(query, body))

    def _body_length(self) -> int:
        """Bytes of the request's body; -1 without a valid Content-Length."""
        digits = self.headers.get("Content-Length") or ""
        if not digits.isdecimal() or len(digits) > _MAX_LENGTH_DIGITS:
            return -1
        return int(digits)

    def _post_route(self, path: str, length: int) -> Post | None:
        """Route of a POST request; None if the request was refused, which is answered."""
        fault = ""
        media_type = (self.headers.get("Content-Type") or "").partition(";")[0]
        if media_type not in _BODY_TYPES:
            fault = "The page sends no such content."
        if self._refused(fault):
            return None
        if length < 0:
            self._error(413, "The request has no length.")
            return None
        if length > MOST_BYTES:
            self._error(413, f"At most {MOST_BYTES >> 20} MiB can be sent.")
            return None
        routes = self._routes()
        if routes is None:
            return None
        route = routes.posts.get(path)
        if route is None:
            self._error(404, "There is no such action.")
        return route

    def _routes(self) -> Routes | None:
        """Routes of this browser; None if there is no room for it, which is answered."""
        try:
            return self.server.page.routes(self._browser())
        except CongraspError as error:
            self._error(200, str(error))
            return None

    @property
    def _cookie(self) -> str:
        """Name of the page's cookie; the ports of a host share theirs."""
        return f"congrasp-{self.server.page.port}"

    def _browser(self) -> str:
        """The token in the browser's cookie; empty without one."""
        with contextlib.suppress(http.cookies.CookieError):
            cookie = http.cookies.SimpleCookie(self.headers.get("Cookie", "")).get(self._cookie)
            if cookie is not None and _TOKEN.fullmatch(cookie.value):
                return cookie.value
        return ""

    def log_message(self, format: str, *args: Any) -> None:
        """Logs nothing."""

    def _route(self) -> tuple[str, dict[str, str]]:
        """Path, without the prefix of a proxy, and query parameters; an empty path for a malformed
        URL.
        """
        try:
            parts = urllib.parse.urlsplit(self.path)
        except ValueError:
            return "", {}
        path = parts.path
        page_path = _PAGE_PATH.search(path)
        if page_path is not None:
            path = page_path[0]
        elif path.endswith("/"):
            path = "/"
        return path, dict(urllib.parse.parse_qsl(parts.query))

    def _refused(self, fault: str = "") -> bool:
        """Sends a refusal if the request is not allowed, or has another fault; returns True if it
        did.
        """
        fault = self.server.page.fault(self) or fault
        if fault:
            self._error(403, fault)
        return bool(fault)

    def _drain(self, length: int) -> None:
        """Ends the connection of a request that was answered without its body."""
        self.close_connection = True
        self.connection.settimeout(_DRAIN_TIMEOUT_S)
        with contextlib.suppress(OSError):
            self.rfile.read(min(max(0, length), _DRAINED_BYTES))

    def _file(self, name: str) -> None:
        """Sends a file of the page."""
        file = _static_file(name)
        if file is None:
            self._send(404, "text/plain", b"There is no such page.")
            return
        headers: dict[str, str] = {}
        if file.suffix == ".html" and not self._browser():
            token = secrets.token_hex(16)
            headers["Set-Cookie"] = f"{self._cookie}={token}; HttpOnly; SameSite=Strict"
        self._send(200, _TYPES[file.suffix], file.read_bytes(), headers)

    def _answer(self, work: Callable[[], Answer]) -> None:
        """Sends what `work` returns, or its error."""
        try:
            content = _content(work())
        except BadRequest as error:
            return self._error(400, str(error))
        except CongraspError as error:
            return self._error(200, str(error))
        except Exception as error:  # the server continues after any error of a request
            log("error", f"{self.path.partition('?')[0]}: {type(error).__name__}: {error}")
            return self._error(500, f"Internal error of congrasp: {type(error).__name__}: {error}.")
        self._send(200, *content)

    def _error(self, code: int, error: str) -> None:
        """Sends an error; one with the code 200 is an answer of the studio, such as a wrong
        value.
        """
        refused = {"X-Refused": "yes"} if code == 200 else {}
        self._send(code, "application/json", json.dumps({"error": error}).encode(), refused)

    def _send(
        self, code: int, kind: str, data: bytes, more: Mapping[str, str] | None = None
    ) -> None:
        """Sends a whole answer."""
        self.send_response(code)
        headers = {
            "Content-Type": kind,
            "Content-Length": str(len(data)),
            "Cache-Control": "no-store",
            "Content-Security-Policy": _POLICY,
            "X-Content-Type-Options": "nosniff",
            **(more or {}),
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)


def _static_file(name: str) -> pathlib.Path | None:
    """File of the page by its path below `STATIC`; None if there is none."""
    for file in STATIC.rglob("*"):
        if file.suffix in _TYPES and file.relative_to(STATIC).as_posix() == name:
            return file
    return None


def _content(answer: Answer) -> tuple[str, bytes, Mapping[str, str]]:
    """Media type, bytes and further headers of an answer."""
    if isinstance(answer, Message):
        return "application/octet-stream", encode(answer), {}
    if isinstance(answer, Download):
        name = urllib.parse.quote(answer.name)
        headers = {"Content-Disposition": f"attachment; filename*=UTF-8''{name}"}
        return "application/octet-stream", answer.data, headers
    if isinstance(answer, Picture):
        return "image/png", answer.png, {}
    return "application/json", json.dumps(answer, allow_nan=False).encode(), {}
