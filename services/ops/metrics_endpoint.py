"""A Prometheus endpoint: the HTTP server of a process's metrics.

It is imported only where a port is set: its libraries take longer to import than the metrics.
"""

import contextlib
from collections.abc import Iterator
from typing import Any

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.exposition import choose_encoder
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from congrasp.common.errors import PORT_ERRORS, os_errors_as
from congrasp.services.ops.http_server import HttpServer, listening_socket

MAX_CONNECTIONS = 64  # at a time, shared by addresses


@contextlib.contextmanager
def serve_metrics(port: int, host: str, *collectors: Any) -> Iterator[None]:
    """Context that serves collectors at http://HOST:PORT/metrics, with this process's memory and
    CPU time.

    Raises:
      CongraspError: the port cannot be used.
    """
    # Without `auto_describe` the names are not compared, for which every collector would be called.
    registry = CollectorRegistry()
    ProcessCollector(registry=registry)
    for collector in collectors:
        registry.register(collector)
    with os_errors_as(
        f"The metrics cannot be served at {host}:{port}",
        "Pass another --metrics-port.",
        PORT_ERRORS,
    ):
        listener = listening_socket(host, port)
    server = HttpServer(_application(registry), listener, MAX_CONNECTIONS)
    try:
        yield
    finally:
        server.close()


def _application(registry: CollectorRegistry) -> Starlette:
    """Returns the application that answers scrapes."""

    def scrape(request: Request) -> Response:
        """Returns the metrics, or those that the query names; runs in a thread."""
        names = request.query_params.getlist("name[]")
        scraped = registry.restricted_registry(names) if names else registry
        encode, content_type = choose_encoder(request.headers.get("accept", ""))
        return Response(encode(scraped), headers={"Content-Type": content_type})

    return Starlette(routes=[Route("/{path:path}", scrape)])
