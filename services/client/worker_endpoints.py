"""Endpoints of the workers of a policy server (`congrasp serve --workers`)."""

from collections.abc import Mapping
from typing import Any

from congrasp.common.transport.ports import shifted

WORKERS = "workers"
"""Entry of a server's health and metadata: number of workers that serve the policy, on neighbouring
ports; absent for one."""
WORKER = "worker"
"""Entry of them: number of the worker that sends them, from 0 on; absent for one."""
MAX_WORKERS = 64
"""Limit of the number of workers."""


def worker_endpoints(endpoint: str, health: Mapping[str, Any]) -> list[str]:
    """Returns the endpoints of all workers of a server by their numbers; for a server without
    workers its endpoint.

    Args:
      endpoint: endpoint of one worker.
      health: health or metadata of this worker. One of an older version does not send its number,
        and is the first.
    """
    workers = health.get(WORKERS, 1)
    number = health.get(WORKER, 0)
    if not isinstance(workers, int) or not isinstance(number, int):
        return [endpoint]
    if not 1 < workers <= MAX_WORKERS or not 0 <= number < workers:
        return [endpoint]
    return [shifted(endpoint, worker - number) for worker in range(workers)]
