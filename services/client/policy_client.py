"""The client of a policy server, for a robot's control loop: needs only NumPy and Zenoh."""

import contextlib
import logging
import os
import secrets
import time
from collections.abc import Callable, Mapping
from typing import Any

from congrasp.common.errors import CongraspError, RefusedError, StartingError, TransportError
from congrasp.common.runtime import forks
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import check_host, shifted
from congrasp.common.wire.codec import Message
from congrasp.services.client.episode_policy import EpisodePolicy
from congrasp.services.client.worker_endpoints import WORKER, WORKERS, worker_endpoints

_RETRY_PAUSE_S = 0.2
"""Time between two attempts to reach a server that does not respond or is starting."""
_HEALTH_INTERVAL_S = 0.02
"""Time between two queries of a server's health: one with certificates drops a query that follows
another one of the same connection within 10 ms (`LIMITS` of `common.transport.security`)."""
_REPORT_AFTER_S = 2.0
"""Time after which a wait is reported."""
_STARTING_S = 3.0
"""Longest wait for a worker that is starting, if the server has others. Workers that start together
become ready together: the clients that wait for them then remain distributed."""
_log = logging.getLogger(__name__)


class _Wait:
    """Wait for a server: it has a deadline, and is reported once."""

    def __init__(self, what: str, limit_s: float):
        self._what = what
        self._limit_s = limit_s
        self._start = time.monotonic()
        self._is_reported = False

    def pause(self, error: TransportError) -> None:
        """Sleeps until the next attempt.

        Args:
          error: reason why the last attempt failed, which is raised after the deadline.
        """
        waited_s = time.monotonic() - self._start
        if waited_s >= self._limit_s:
            raise error
        if waited_s >= _REPORT_AFTER_S and not self._is_reported:
            self._is_reported = True
            _log.warning(
                "Waiting for %s, %.0f s so far, up to %g s. %s",
                self._what,
                waited_s,
                self._limit_s,
                error.fault,
            )
        time.sleep(min(_RETRY_PAUSE_S, self._limit_s - waited_s))


class PolicyClient(EpisodePolicy):
    """The `Policy` of a server."""

    def __init__(
        self,
        connect: str,
        run: str = "policy",
        *,
        hand: str = "human",
        timeout: float = 1.0,
        wait: float = 10.0,
        certs: str | os.PathLike[str] | None = None,
    ):
        """Connects, and reconnects if the server restarts.

        The first call draws a random order of the server's workers (`congrasp serve --workers`),
        and connects to the first of them that is ready. If that one ends, the client connects to
        the next. A wait of more than two seconds is reported as a warning of `logging`.

        Args:
          connect: the server's endpoint, such as tcp/10.0.0.7:7457.
          run: name under which the policy is served.
          hand: name of the controlled hand; the policy of another one is refused.
          timeout: deadline of one call, s.
          wait: seconds to wait for the server to appear, and to compile its policy: the first call
            lasts until then.
          certs: folder of a client's certificate, for a server that requires one.

        Raises:
          TransportError: there is no response.
        """
        super().__init__()
        self._endpoint = connect
        """Endpoint of the server, or of its second worker if the first does not respond."""
        self._worker_order: list[str] = []
        """Endpoints of the workers in this client's order, the current one first; empty while their
        number is not known."""
        self._certs = certs
        self._keys = Keys(run)
        self._hand = hand
        self._timeout_s = timeout
        self._wait_s = wait
        self._has_metadata = False  # True once the server has sent its metadata
        self._health_queried_at = 0.0
        self._act_key = self._keys.act_for(urls.name_on_wire(secrets.token_hex(4), certs, "client"))
        self._transport = self._connect_to_server()
        self._connected_at = time.monotonic()

    @property
    def endpoint(self) -> str:
        """Endpoint of the worker to which this client connected before it chose one."""
        return self._endpoint

    def health(self) -> dict[str, object]:
        """Returns readiness, version, hand and queue of the server, or for how long it has been
        compiling.
        """
        return self._health_at(self._transport)

    def _health_at(self, transport: Transport, **question: bool) -> dict[str, Any]:
        """Returns the health of the server at the other end of a connection.

        Args:
          transport: the connection.
          question: what else the server is asked for: `metadata=True`.
        """
        since_last_s = time.monotonic() - self._health_queried_at
        time.sleep(max(0.0, _HEALTH_INTERVAL_S - since_last_s))
        query = Message({}, question)
        try:
            return dict(transport.query(self._keys.health, query, timeout=self._timeout_s).meta)
        finally:
            self._health_queried_at = time.monotonic()

    def wait_until_ready(self) -> dict[str, Any]:
        """Returns the health of the server, or of one of its workers; waits for one that is
        starting.

        Raises:
          StartingError: it is still starting after the seconds to wait.
          TransportError: there is no response.
        """
        return self._once_started(self._ready_health)

    def _ready_health(self) -> dict[str, Any]:
        """Returns the health of the server; raises a StartingError if it is not ready."""
        health = self.health()
        if not health["ready"]:
            raise StartingError(f"The policy server is {health['state']}.", "Wait for it.")
        return health

    def metadata(self) -> dict[str, Any]:
        """See `Policy.metadata`; waits for a server that is starting."""
        forks.require_same_process(self._fork_generation, "policy")
        return self._once_started(self._query_metadata)

    def _fetch_metadata(self) -> dict[str, Any]:
        """Returns the metadata; only the first call waits, since later ones are part of a control
        loop.
        """
        if self._has_metadata:
            return self._query_metadata()
        return self.metadata()

    def _once_started(self, ask: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Repeats a query until a server or one of its workers answers it, for the seconds to
        wait.
        """
        wait = _Wait(f"the policy server at {self._endpoint}", self._wait_s)
        needs_other_worker = False
        while True:
            try:
                if needs_other_worker:
                    self._use_next_worker()
                return ask()
            except TransportError as error:
                # A StartingError is a RefusedError that will pass.
                is_starting = isinstance(error, StartingError)
                if isinstance(error, RefusedError) and not is_starting:
                    raise
                wait.pause(error)
            needs_other_worker = not is_starting or self._has_waited_for_start()

    def _has_waited_for_start(self) -> bool:
        """True if this client has waited long enough for a worker that is starting."""
        longest_s = min(_STARTING_S, self._wait_s / 3)
        return time.monotonic() - self._connected_at >= longest_s

    def _query_metadata(self) -> dict[str, Any]:
        """Returns the metadata of the server.

        Raises:
          RefusedError: the server is older than this client, or serves another hand.
          TransportError: there is no response.
        """
        metadata = self._health_at(self._transport, metadata=True)
        if "query" not in metadata:
            raise RefusedError(
                "The server does not describe its queries.",
                "Update congrasp on the server's machine.",
            )
        if metadata["hand"] != self._hand:
            raise RefusedError(
                f"The policy is for the hand {ascii(metadata['hand'])[:60]}, not '{self._hand}'.",
                "Connect to a server of this hand, or pass another hand.",
            )
        if not self._worker_order:
            self._draw_worker_order(metadata)
            if len(self._worker_order) > 1:
                self._connect_to_worker()
                return self._query_metadata()  # that worker may still be starting
        metadata.pop(WORKERS, None)
        metadata.pop(WORKER, None)
        self._has_metadata = True
        return metadata

    def _connect_to_server(self) -> Transport:
        """Returns a connection to the server, or to its second worker if the first does not
        respond.

        Raises:
          TransportError: neither responds within the seconds to wait.
        """
        check_host(self._endpoint)
        wait = _Wait(f"the policy server at {self._endpoint}", self._wait_s)
        while True:
            try:
                return urls.connect(self._endpoint, "client", certs=self._certs, wait=0.0)
            except TransportError as error:
                second_worker = self._connect_to_second_worker()
                if second_worker is not None:
                    return second_worker
                wait.pause(error)

    def _connect_to_second_worker(self) -> Transport | None:
        """Returns a connection to the server's second worker; None if there is none.

        The next port may have another server: only a worker of number 1 is accepted.
        """
        with contextlib.suppress(CongraspError), contextlib.ExitStack() as stack:
            endpoint = shifted(self._endpoint, 1)
            transport = urls.connect(endpoint, "client", certs=self._certs, wait=0.0)
            stack.enter_context(transport)
            if self._health_at(transport).get(WORKER) == 1:
                stack.pop_all()
                self._endpoint = endpoint
                return transport
        return None

    def _draw_worker_order(self, health: Mapping[str, Any]) -> None:
        """Draws the order in which this client tries the workers.

        Args:
          health: health or metadata of the server.
        """
        endpoints = worker_endpoints(self._endpoint, health)
        self._worker_order = secrets.SystemRandom().sample(endpoints, len(endpoints))

    def _use_next_worker(self) -> None:
        """Connects to the next worker in this client's order, if the server has several.

        Raises:
          TransportError: the next worker does not respond.
        """
        if self._worker_order:
            current, *others = self._worker_order
            self._worker_order = [*others, current]
        else:
            self._find_workers()
        if len(self._worker_order) > 1:
            self._connect_to_worker()

    def _find_workers(self) -> None:
        """Draws the order of the workers, if the first of them responds; else connects to the
        second, if that one does.
        """
        try:
            self._draw_worker_order(self.health())
        except TransportError:
            second_worker = self._connect_to_second_worker()
            if second_worker is not None:
                self._replace_transport(second_worker)

    def _connect_to_worker(self) -> None:
        """Connects to the first worker in this client's order, with the others as alternatives.

        Raises:
          TransportError: it does not respond; the previous connection remains.
        """
        first, *others = self._worker_order
        transport = urls.connect(first, "client", certs=self._certs, wait=0.0, alternatives=others)
        self._replace_transport(transport)

    def _replace_transport(self, transport: Transport) -> None:
        """Uses another connection, and closes the previous one."""
        previous = self._transport
        self._transport = transport
        self._connected_at = time.monotonic()
        previous.close()

    def close(self) -> None:
        """Disconnects."""
        self._transport.close()

    def _query(self, query: Message) -> Message:
        """Returns the server's reply."""
        query = Message(query.arrays, {"timeout": self._timeout_s, **query.meta})
        return self._transport.query(self._act_key, query, timeout=self._timeout_s)
