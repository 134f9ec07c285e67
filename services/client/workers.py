"""Workers of a policy server: their endpoints, and their joint health."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

from congrasp.common.errors import TransportError
from congrasp.common.transport.ports import shifted
from congrasp.services.client.policy_client import WORKERS, PolicyClient

_SUMS = ("queue", "queue_limit", "states_per_second", "answered")
"""Entries of a server's health that add up."""


def joint_health(
    connect: str, run: str, *, timeout: float, certs: str | os.PathLike[str] | None
) -> dict[str, Any]:
    """Returns the health of a policy server; of one with several workers, that of all.

    Queues, rates and counters are sums. `version` is the oldest, `ready` is true if a worker is
    ready, and `workers_ready` is their number.

    Args:
      connect: the endpoint of the server, which is that of its first worker.
      run: name under which the policy is served.
      timeout: seconds to wait for each worker.
      certs: folder of a client's certificate.

    Raises:
      TransportError: the first worker does not respond.
    """

    def health_of(endpoint: str) -> dict[str, Any]:
        with PolicyClient(endpoint, run, timeout=timeout, wait=timeout, certs=certs) as client:
            return client.health()

    first = health_of(connect)
    workers = first.get(WORKERS, 1)
    if workers == 1:
        return first
    healths = [first]
    for worker in range(1, workers):
        try:
            healths.append(health_of(shifted(connect, worker)))
        except TransportError:
            continue
    return _joined(healths)


def _joined(healths: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Joins the health of the workers that respond."""
    ready = [health for health in healths if health["ready"]]
    if not ready:
        return {**healths[0], "workers_ready": 0}
    joined = {**ready[0], "workers_ready": len(ready)}
    for name in _SUMS:
        joined[name] = sum(health[name] for health in ready)
    joined["version"] = min(health["version"] for health in ready)
    troubles = [health["trouble"] for health in ready if health["trouble"]]
    joined["trouble"] = next(iter(troubles), "")
    return joined
