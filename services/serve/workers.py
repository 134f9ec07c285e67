"""Processes that serve one policy together: each is a complete server on a separate port.

Zenoh cannot distribute queries over equal queryables: it sends a query to all of them, or always
to the first that is declared as complete. Each client therefore tries the workers in a random
order, and connects to another one if its worker ends (`services.client.policy_client`).
"""

import time
from collections.abc import Sequence

from congrasp.common.errors import CongraspError, TransportError
from congrasp.services.ops.lifetime import POLL_S, Child, Stop, end_all
from congrasp.services.ops.logs import log

MAX_RESTARTS = 5
"""Restarts of a worker that each time ends within `_STEADY_S`."""
_STEADY_S = 60.0
"""Time after which earlier deaths of a worker do not count."""


def worker_of(number: int, arguments: list[str]) -> Child:
    """Returns a worker, not started yet.

    Args:
      number: its number, from 0 on.
      arguments: words of its command after `congrasp`.
    """
    # The workers share the memory of a GPU
    environment = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    return Child(f"worker {number}", arguments, None, environment)


def run_workers(workers: Sequence[Child], stop: Stop) -> None:
    """Runs workers until a signal, and restarts those that end before.

    Args:
      workers: workers, not started yet; all have ended on return.
      stop: set by the signal.

    Raises:
      TransportError: the learner does not respond to the first start of a worker in time.
      CongraspError: a worker rejects its options, or ends repeatedly.
    """
    started_at: dict[str, float] = {}
    try:
        for worker in workers:
            worker.start()
            started_at[worker.name] = time.monotonic()
        while not stop.wait(POLL_S):
            for worker in workers:
                if worker.code is None:
                    continue
                if not worker.again_at:
                    _plan_restart(worker, time.monotonic() - started_at[worker.name])
                if time.monotonic() >= worker.again_at:
                    worker.restart()
                    started_at[worker.name] = time.monotonic()
    finally:
        end_all(workers)


def _plan_restart(worker: Child, lasted_s: float) -> None:
    """Logs the end of a worker and plans its restart.

    Args:
      worker: worker that has ended.
      lasted_s: seconds for which it ran.

    Raises:
      TransportError: the learner did not respond in time, and the worker has never served.
      CongraspError: it would end again.
    """
    death = worker.death()
    if lasted_s > _STEADY_S:
        worker.deaths = 0
    if worker.code == CongraspError.exit_code:
        raise CongraspError(death)
    lacks_learner = worker.code == TransportError.exit_code
    if lacks_learner and not worker.restarts:
        raise TransportError(death)
    # The learner may return, and the other workers serve its last policy
    if worker.deaths >= MAX_RESTARTS and not lacks_learner:
        raise CongraspError(death)
    log("warning", f"{death} Restarting it.")
    worker.again_at = time.monotonic() + worker.pause
