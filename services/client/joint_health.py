"""Joint health of the workers of a policy server."""

import contextlib
import os
from collections.abc import Mapping, Sequence
from typing import Any

from congrasp.common.errors import TransportError
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.client.worker_endpoints import WORKER, worker_endpoints

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
      TransportError: neither the first worker nor the second responds.
    """
    with PolicyClient(connect, run, timeout=timeout, wait=timeout, certs=certs) as client:
        first = client.health()
        endpoints = worker_endpoints(client.endpoint, first)
    if len(endpoints) == 1:
        return first
    number_of_first = first.get(WORKER, 0)
    healths = [first]
    for number, endpoint in enumerate(endpoints):
        if number == number_of_first:
            continue
        with (
            contextlib.suppress(TransportError),
            PolicyClient(endpoint, run, timeout=timeout, wait=timeout, certs=certs) as client,
        ):
            if client.endpoint == endpoint:  # and not the second worker, in place of the first
                healths.append(client.health())
    return _joined(healths)


def _joined(healths: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Joins the health of the workers that respond."""
    ready = [health for health in healths if health["ready"]]
    example = ready[0] if ready else healths[0]
    joined = {**example, "workers_ready": len(ready)}
    joined.pop(WORKER, None)
    if not ready:
        return joined
    for name in _SUMS:
        joined[name] = sum(health[name] for health in ready)
    joined["version"] = min(health["version"] for health in ready)
    troubles = [health["trouble"] for health in ready if health["trouble"]]
    joined["trouble"] = next(iter(troubles), "")
    return joined
