"""The client of a policy server, for a robot's control loop: needs only NumPy and Zenoh."""

import contextlib
import os
import secrets
import time
from collections.abc import Callable
from typing import Any

from congrasp.common.errors import RefusedError, StartingError, TransportError
from congrasp.common.runtime import forks
from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import shifted
from congrasp.common.wire.codec import Message
from congrasp.services.client.episode_policy import EpisodePolicy

WORKERS = "workers"
"""Entry of a server's metadata: number of workers that serve the policy, on neighbouring ports from
the server's first one on; absent for one."""
MAX_WORKERS = 64
"""Limit of the number of workers."""
_WORKER_WAIT_S = 1.0
"""Time to wait for a connection to a worker."""
_RETRY_PAUSE_S = 0.2  # between two queries of a server that does not respond or is starting


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

        The first call chooses one of the server's workers (`congrasp serve --workers`) at random.
        If that one ends, the client connects to another.

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
        self._transport = urls.connect(connect, "client", certs=certs, wait=wait)
        self._endpoint = connect
        self._certs = certs
        self._has_worker = False  # True once this client has chosen one of the server's workers
        self._keys = Keys(run)
        self._hand = hand
        self._timeout_s = timeout
        self._wait_s = wait
        self._has_metadata = False  # True once the server has sent its metadata
        self._act_key = self._keys.act_for(urls.name_on_wire(secrets.token_hex(4), certs, "client"))

    def health(self) -> dict[str, object]:
        """Returns readiness, version, hand and queue of the server, or for how long it has been
        compiling.
        """
        return dict(
            self._transport.query(self._keys.health, Message({}, {}), timeout=self._timeout_s).meta
        )

    def wait_until_ready(self) -> dict[str, Any]:
        """Returns the health of the server; waits for one that is starting.

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
        """Repeats a query until a server that is starting answers it, for the seconds to wait."""
        deadline = time.monotonic() + self._wait_s
        while True:
            try:
                return ask()
            except TransportError as error:
                # A StartingError is a RefusedError that will pass.
                is_final = isinstance(error, RefusedError) and not isinstance(error, StartingError)
                if is_final or time.monotonic() > deadline:
                    raise
                time.sleep(_RETRY_PAUSE_S)

    def _query_metadata(self) -> dict[str, Any]:
        """Returns the metadata of the server.

        Raises:
          RefusedError: the server is older than this client, or serves another hand.
          TransportError: there is no response.
        """
        query = Message({}, {"metadata": True})
        reply = self._transport.query(self._keys.health, query, timeout=self._timeout_s)
        metadata = dict(reply.meta)
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
        workers = metadata.pop(WORKERS, 1)
        if not self._has_worker and isinstance(workers, int) and 1 < workers <= MAX_WORKERS:
            self._choose_worker(workers)
            return self._query_metadata()  # that worker may still be starting
        self._has_metadata = True
        return metadata

    def _choose_worker(self, workers: int) -> None:
        """Connects to one of the server's workers at random, with the others as alternatives.

        If it does not respond, the client stays at the first one.
        """
        self._has_worker = True
        chosen = secrets.randbelow(workers)
        endpoints = [shifted(self._endpoint, (chosen + i) % workers) for i in range(workers)]
        first = self._transport
        with contextlib.suppress(TransportError):
            self._transport = urls.connect(
                endpoints[0],
                "client",
                certs=self._certs,
                wait=_WORKER_WAIT_S,
                alternatives=endpoints[1:],
            )
            first.close()

    def close(self) -> None:
        """Disconnects."""
        self._transport.close()

    def _query(self, query: Message) -> Message:
        """Returns the server's reply."""
        query = Message(query.arrays, {"timeout": self._timeout_s, **query.meta})
        return self._transport.query(self._act_key, query, timeout=self._timeout_s)
