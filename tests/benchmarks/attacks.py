"""What hostile and slow clients of a policy server cost an honest one: the same queries alone and
beside each attack.

The server is the real one with an untrained policy; the attackers (`tests.benchmarks.attackers`)
are processes. The same attack on a second server shows what is due to this machine, which
attackers, servers and client share.
"""

import contextlib
import os
import pathlib
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.policy import bundle as bundles
from congrasp.common.wire.codec import Message, encode
from congrasp.services.client.episode_policy import EpisodePolicy
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.serve.load import Example, example_episode, serve_policy
from congrasp.services.train.command import untrained
from congrasp.services.train.presets import get_preset
from tests.benchmarks.attackers import attacked

_PERIOD = 0.01  # seconds between two queries
_START = 180.0  # seconds that the server may take to start
_SETTLE = 1.0  # seconds of an attack that are not measured
_KINDS = {"unread": 2, "silent": 1, "huge": 1}
"""Attacks, and the number of attackers of each."""
_FIGURES = {
    "p99 of a query, ms": 2,
    "answers a second": 0,
    "a new connection, ms": 0,
    "server, MB": 0,
}
"""What is measured, with the digits that are printed."""


def attacks(seconds: float = 5.0, turns: int = 3) -> int:
    """What hostile clients of a policy server cost an honest one that queries it 100 times a
    second.

    Two clients leave long answers unread, one opens 300 silent connections, one sends 60 MB at a
    time.

    Args:
      seconds: Length of each measurement.
      turns: Measurements alone, beside each attack on another server and on this one, in turn;
        medians are printed.

    Examples:
      python -m tests.benchmarks attacks
      python -m tests.benchmarks attacks --seconds 2 --turns 1
    """
    table = Table(title=f"{turns} x {seconds:g} s; load average {os.getloadavg()[0]:.1f}")
    for column in (
        "beside",
        "honest",
        "alone",
        "elsewhere",
        "attacked",
        "attacked / alone",
        "attacked / elsewhere",
    ):
        table.add_column(column, justify="right" if table.columns[1:] else "left")
    with (
        tempfile.TemporaryDirectory() as name,
        _servers(folder := pathlib.Path(name), seconds) as (endpoints, measure),
    ):
        for kind, count in _KINDS.items():
            rows: list[list[list[float]]] = [[], [], []]
            for _ in range(turns):
                rows[0].append(measure())
                for row, endpoint in zip(rows[1:], endpoints, strict=True):
                    query = folder / "query" if kind == "unread" else None
                    with attacked(kind, endpoint, "policy", query, count):
                        time.sleep(_SETTLE)
                        row.append(measure())
            for (unit, digits), medians in zip(_FIGURES.items(), np.median(rows, 1).T, strict=True):
                ratios = medians[2] / np.maximum(medians[:2], 1e-9)
                figures = [*(f"{x:.{digits}f}" for x in medians), *(f"{x:.2f}" for x in ratios)]
                table.add_row(f"{count} x {kind}", unit, *figures)
    Console(width=120).print(table)
    return 0


@contextlib.contextmanager
def _servers(
    folder: pathlib.Path, seconds: float
) -> Iterator[tuple[list[str], Callable[[], list[float]]]]:
    """Endpoints of another policy server and of the honest client's, and a function that returns
    the honest `_FIGURES`.

    Writes a long query to `folder/query`.
    """
    policy = folder / "policy.safetensors"
    bundles.save(untrained(get_preset("quickstart")), policy)
    with (
        serve_policy(policy, folder / "other.log") as (other, _),
        serve_policy(policy, folder / "serve.log") as (endpoint, process),
    ):
        episode = example_episode(1_000_000)
        with PolicyClient(other, wait=_START) as client:
            client.metadata()
        with PolicyClient(endpoint, wait=_START) as client:
            client.metadata()
            (folder / "query").write_bytes(_long_query(client, episode))

            def measure() -> list[float]:
                times = _latencies(client, episode, seconds)
                memory = psutil.Process(process).memory_info().rss / 1e6
                p99 = 1e3 * float(np.percentile(times, 99))
                return [p99, len(times) / seconds, 1e3 * _connecting(endpoint), memory]

            yield [other, endpoint], measure


def _latencies(client: PolicyClient, episode: Example, seconds: float) -> list[float]:
    """Seconds of the queries of a client that sends one in each `_PERIOD`."""
    client.reset(episode.request)
    times = []
    deadline = time.monotonic() + seconds
    while (began := time.monotonic()) < deadline:
        with contextlib.suppress(CongraspError):
            client.act(episode.state)
            times.append(time.monotonic() - began)
        time.sleep(max(0.0, _PERIOD - (time.monotonic() - began)))
    return times


def _connecting(endpoint: str) -> float:
    """Seconds until a new client has its first answer."""
    began = time.monotonic()
    with PolicyClient(endpoint, wait=_START) as client:
        client.health()
    return time.monotonic() - began


def _long_query(client: PolicyClient, episode: Example) -> bytes:
    """The bytes of a query of 64 states."""
    return _recorded(client, episode, 64)


def single_query(client: PolicyClient, episode: Example) -> bytes:
    """The bytes of a query of one state."""
    return _recorded(client, episode, 1)


class _QueryRecorder(EpisodePolicy):
    """Keeps the newest query instead of sending it."""

    def __init__(self, metadata: dict[str, Any]):
        super().__init__()
        self._metadata = metadata
        self.query = Message()

    def _fetch_metadata(self) -> dict[str, Any]:
        return self._metadata

    def _query(self, query: Message) -> Message:
        self.query = query
        raise TransportError("The query is not sent.")


def _recorded(client: PolicyClient, episode: Example, states: int) -> bytes:
    """The bytes of a client's query."""
    recorder = _QueryRecorder(client.metadata())
    recorder.reset(episode.request)
    with contextlib.suppress(TransportError):
        recorder.act_each([episode.state] * states)
    query = recorder.query
    return encode(Message(query.arrays, {"timeout": 60.0, **query.meta}))
