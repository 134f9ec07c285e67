"""Seconds until an actor whose connection is half open is replaced under the same name."""

import contextlib
import os
import pathlib
import tempfile
import time
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

from tests.cluster import Cluster, assert_books_balance
from tests.partition import cuttable

_NAME = "a"
_LIMIT = 10.0  # seconds until the first accepted rollout of the replacement


def replacements(times: int = 20) -> int:
    """Replaces an actor whose peer no longer hears it, and measures the time until the learner has
    accepted a rollout of the new one.

    The link of the old actor is cut without a word: its connections stay open. The new process
    starts at once under the same name. The exit code is 1 if one took longer than ten seconds.

    Args:
      times: Number of replacements, one after another.

    Examples:
      python -m tests.benchmarks replacements
      python -m tests.benchmarks replacements --times 3
    """
    with (
        tempfile.TemporaryDirectory() as name,
        contextlib.closing(Cluster(pathlib.Path(name))) as cluster,
    ):
        learner = cluster.start_learner()
        seconds = [_replacement(cluster) for _ in range(times)]
        assert_books_balance(cluster.stop(learner)[0])
    table = Table(title=f"load average {os.getloadavg()[0]:.1f}")
    for column in ("replacements", f"within {_LIMIT:g} s", "median, s", "longest, s"):
        table.add_column(column)
    in_time = sum(duration <= _LIMIT for duration in seconds)
    median = sorted(seconds)[len(seconds) // 2]
    table.add_row(str(times), str(in_time), f"{median:.1f}", f"{max(seconds):.1f}")
    Console(width=100).print(table)
    return int(in_time < times)


def _replacement(cluster: Cluster) -> float:
    """Starts an actor, cuts its link, and starts another one; returns the latter's seconds until
    its first accepted rollout. Ends both.
    """
    with cuttable(cluster.endpoint) as link:
        first_owner = _start(cluster, set(), link.endpoint)
        owners = {first_owner, *_rollouts(cluster.wait(bool))}
        link.cut()
        began = time.monotonic()
        _start(cluster, owners, cluster.endpoint)
        duration = time.monotonic() - began
    for process in cluster.processes[-2:]:
        process.kill()
        process.wait()
    cluster.wait(lambda status: not _rollouts(status))
    return duration


def _start(cluster: Cluster, owners: set[tuple[str, str]], endpoint: str) -> tuple[str, str]:
    """Starts an actor; returns its name and incarnation once a rollout of it is accepted.

    Args:
      cluster: the processes.
      known: earlier actors.
      endpoint: endpoint of the learner, or of a link to it.
    """
    cluster.start_actor(_NAME, endpoint=endpoint)

    def contributors(status: Mapping[str, Any]) -> list[tuple[str, str]]:
        return [
            owner
            for owner, accepted in _rollouts(status).items()
            if accepted and owner not in owners
        ]

    return contributors(cluster.wait(contributors))[0]


def _rollouts(status: Mapping[str, Any]) -> dict[tuple[str, str], int]:
    """Accepted rollouts by name and incarnation of the actors."""
    actors = [role for role in status["roles"] if role["role"] == "actor"]
    return {(actor["id"], actor["incarnation"]): actor.get("rollouts", 0) for actor in actors}
