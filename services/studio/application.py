"""Web application of a studio: the page's files, and the routes of each browser's session."""

import asyncio
import json
import pathlib
import re
import secrets
import urllib.parse
from collections.abc import Callable

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

from congrasp.common.errors import CongraspError
from congrasp.common.wire.codec import Message, encode
from congrasp.services.ops.logs import log
from congrasp.services.studio.access import Access
from congrasp.services.studio.routes import Answer, BadRequest, Download, Picture, Routes

STATIC = pathlib.Path(__file__).with_name("static")
_MAX_BYTES = 128 << 20
"""Bytes of the largest request body, an uploaded mesh."""
_BODY_TYPES = ("application/json", "application/octet-stream")
"""Types of a request's body; a form of another site cannot send them."""
SILENCE_S = 30.0
"""Time between two chunks of a body."""
_TOKEN = re.compile("[0-9a-f]{32}")


def page_application(routes: Callable[[str], Routes], access: Access, port: int) -> Starlette:
    """Returns the application.

    A proxy may offer the page under a prefix of its paths.

    Args:
      routes: returns the routes of a browser, by the token in its cookie; an empty one without a
        cookie.
      access: senders whose requests are answered.
      port: TCP port of the page, for the name of its cookie; the ports of a host share theirs.
    """
    page = _Page(routes, f"congrasp-{port}")
    pages: list[BaseRoute] = []
    for prefix in ("", "/{prefix:path}"):
        pages += [
            Route(f"{prefix}/api/{{name}}", page.get, methods=["GET"]),
            Route(f"{prefix}/api/{{name}}", page.post, methods=["POST"]),
            Mount(f"{prefix}/static", StaticFiles(directory=STATIC)),
            Route(f"{prefix}/", page.index),
        ]
    app = Starlette(
        routes=pages,
        middleware=[Middleware(_PageOnly, access)],
        exception_handlers=dict.fromkeys((HTTPException, CongraspError, Exception), _error_of),
    )
    app.router.redirect_slashes = False
    return app


class _PageOnly:
    """Refuses the requests of other sites."""

    def __init__(self, app: ASGIApp, access: Access):
        """Passes the requests of the page on to an application."""
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serves a request."""
        app = self._app
        if scope["type"] == "http":
            fault = self._access.fault(Headers(scope=scope))
            if fault:
                app = _error(403, fault)
        await app(scope, receive, send)


class _Page:
    """Answers the requests of browsers."""

    def __init__(self, routes: Callable[[str], Routes], cookie: str):
        """Uses the routes of browsers, by the token in their cookie of this name."""
        self._routes = routes
        self._cookie = cookie

    def index(self, request: Request) -> Response:
        """The page, which gives a new browser its cookie."""
        headers: dict[str, str] = {}
        if not self._browser(request):
            token = secrets.token_hex(16)
            headers["Set-Cookie"] = f"{self._cookie}={token}; HttpOnly; SameSite=Strict"
        return FileResponse(STATIC / "index.html", headers=headers)

    def get(self, request: Request) -> Response:
        """The answer of a route."""
        route = self._routes_of(request).gets.get(_path(request))
        if route is None:
            raise HTTPException(404, "There is no such page.")
        return _response(route(request.query_params))

    async def post(self, request: Request) -> Response:
        """The answer of a route; a request is refused by its headers, before its body is read."""
        _check_body(request.headers)
        routes = await run_in_threadpool(self._routes_of, request)
        route = routes.posts.get(_path(request))
        if route is None:
            raise HTTPException(404, "There is no such action.")
        body = await _body(request)
        return await run_in_threadpool(lambda: _response(route(request.query_params, body)))

    def _routes_of(self, request: Request) -> Routes:
        """The routes of the session of a request's browser."""
        return self._routes(self._browser(request))

    def _browser(self, request: Request) -> str:
        """The token in the browser's cookie; empty without one."""
        token = request.cookies.get(self._cookie, "")
        return token if _TOKEN.fullmatch(token) else ""


def _path(request: Request) -> str:
    """A route's path, without the prefix of a proxy."""
    return f"/api/{request.path_params['name']}"


def _check_body(headers: Headers) -> None:
    """Raises an HTTPException for a type or a length of a body that the page does not send."""
    if headers.get("content-type", "").partition(";")[0] not in _BODY_TYPES:
        raise HTTPException(403, "The page sends no such content.")
    length = headers.get("content-length")
    if length is None or "transfer-encoding" in headers:
        raise HTTPException(413, "The request has no length.")
    if int(length) > _MAX_BYTES:
        raise HTTPException(413, f"At most {_MAX_BYTES >> 20} MiB can be sent.")


async def _body(request: Request) -> bytes:
    """The body of a request.

    Raises:
      HTTPException: the client is silent, or has disconnected.
    """
    stream = aiter(request.stream())
    chunks: list[bytes] = []
    while True:
        try:
            async with asyncio.timeout(SILENCE_S):
                chunk = await anext(stream, b"")
        except (TimeoutError, ClientDisconnect):
            raise HTTPException(408, "The request is not complete.") from None
        if not chunk:
            return b"".join(chunks)
        chunks.append(chunk)


def _response(answer: Answer) -> Response:
    """An answer as a response."""
    if isinstance(answer, Message):
        return Response(encode(answer), media_type="application/octet-stream")
    if isinstance(answer, Download):
        name = urllib.parse.quote(answer.name)
        headers = {"Content-Disposition": f"attachment; filename*=UTF-8''{name}"}
        return Response(answer.data, headers=headers, media_type="application/octet-stream")
    if isinstance(answer, Picture):
        return Response(answer.png, media_type="image/png")
    # Starlette's JSONResponse fails for a lone surrogate, such as in the name of a file.
    return Response(json.dumps(answer, allow_nan=False), media_type="application/json")


def _error_of(request: Request, error: Exception) -> Response:
    """The response to a request that raised an error."""
    if isinstance(error, HTTPException):
        return _error(error.status_code, error.detail)
    if isinstance(error, BadRequest):
        return _error(400, str(error))
    if isinstance(error, CongraspError):
        return _error(200, str(error))
    kind = type(error).__name__
    log("error", f"{request.scope['path']}: {kind}: {error}")
    return _error(500, f"Internal error of congrasp: {kind}: {error}.")


def _error(code: int, error: str) -> Response:
    """An error; one with the code 200 is an answer of the studio, such as to a wrong value."""
    headers = {"X-Refused": "yes"} if code == 200 else {}
    return Response(json.dumps({"error": error}), code, headers, "application/json")
