"""What a client that asks too often costs eight honest ones: refused queries, and latency as a
ratio to the same clients alone.
"""

import concurrent.futures
import contextlib
import itertools
import os
import pathlib
import tempfile
import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from congrasp.common.errors import OverloadedError, TransportError
from congrasp.common.policy import bundle as bundles
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.ops.certificates import create_authority, issue
from congrasp.services.serve.load import Example, example_episode, serve_policy
from congrasp.services.train.command import untrained
from congrasp.services.train.presets import get_preset
from tests.benchmarks.attacks import single_query
from tests.benchmarks.crowds import CONNECTIONS, crowded

_HONEST = 8
_RATES = np.linspace(50.0, 100.0, _HONEST)  # queries a second
_START = 180.0  # seconds that a server may take to start
_COLUMNS = (
    "attack",
    "turn",
    "queries",
    "refused",
    "lost",
    "p99 alone, ms",
    "elsewhere",
    "attacked",
    "/ alone",
    "/ elsewhere",
    "load",
)
_SETTLE = 1.0  # seconds of an attack that are not measured


class _Outcome(NamedTuple):
    """Queries of the honest clients."""

    times: list[float]
    """Seconds of those that were answered."""
    refused: int
    lost: int
    """Those without an answer in time."""


class _Setting(NamedTuple):
    """Two equal servers, the honest clients of the first, and the certificates of the attacker."""

    name: str
    endpoint: str
    elsewhere: str
    clients: Sequence[PolicyClient]
    attacker: Sequence[pathlib.Path]
    query: pathlib.Path
    episode: Example


def crowding(seconds: float = 8.0, turns: int = 3, rate: float = 200.0) -> int:
    """What a client with eight connections costs eight honest ones at 50 to 100 queries a second.

    The attacker asks without waiting for answers, and reads them or not; with and without a
    certificate for each connection. The same attack on another server shows what this machine's
    load alone costs.

    Args:
      seconds: Length of each measurement.
      turns: Measurements alone, beside an attack elsewhere, and beside one here, in turn.
      rate: Queries a second of each connection of the attacker.

    Examples:
      python -m tests.benchmarks crowding
      python -m tests.benchmarks crowding --seconds 3 --turns 1
    """
    table = Table(title=f"{turns} x {seconds:g} s, attacker {CONNECTIONS} x {rate:g} Hz")
    for column in _COLUMNS:
        table.add_column(column)
    measurements: list[_Measurement] = []
    with tempfile.TemporaryDirectory() as name:
        for has_certificates in (False, True):
            folder = pathlib.Path(name) / str(has_certificates)
            folder.mkdir()
            with _setting(folder, has_certificates) as setting:
                for reads in (True, False):
                    repeats = [_measurement(setting, reads, seconds, rate) for _ in range(turns)]
                    measurements += repeats
                    for turn, measurement in enumerate(repeats):
                        table.add_row(*_row(setting, reads, str(turn + 1), measurement))
                    table.add_row(*_row(setting, reads, "median", _median(repeats)))
                    table.add_section()
    Console(width=120).print(table)
    refused = sum(measurement.refused for measurement in measurements)
    return int(refused > 0)


class _Measurement(NamedTuple):
    """Honest clients alone, beside an attack on the other server, and beside one on theirs."""

    queries: float
    """Queries beside the attack on their server, of which some were refused or not answered."""
    refused: float
    lost: float
    alone: float
    """99th percentile of the latency, ms; likewise the next two."""
    elsewhere: float
    attacked: float
    over_alone: float
    """Ratio of `attacked` to `alone`."""
    over_elsewhere: float
    """Ratio of `attacked` to `elsewhere`."""
    load: float
    """Load average of the machine over the last minute."""


def _measurement(setting: _Setting, reads: bool, seconds: float, rate: float) -> _Measurement:
    """Measures the three conditions one after another."""

    def beside(endpoint: str) -> _Outcome:
        with crowded(endpoint, setting.query, reads=reads, rate=rate, certs=setting.attacker):
            time.sleep(_SETTLE)
            return _measured(setting, seconds)

    alone = _p99(_measured(setting, seconds))
    elsewhere = _p99(beside(setting.elsewhere))
    outcome = beside(setting.endpoint)
    attacked = _p99(outcome)
    return _Measurement(
        queries=len(outcome.times) + outcome.refused + outcome.lost,
        refused=outcome.refused,
        lost=outcome.lost,
        alone=alone,
        elsewhere=elsewhere,
        attacked=attacked,
        over_alone=attacked / alone,
        over_elsewhere=attacked / elsewhere,
        load=os.getloadavg()[0],
    )


def _p99(outcome: _Outcome) -> float:
    """99th percentile of the latency, ms."""
    return 1e3 * float(np.percentile(outcome.times, 99))


def _median(measurements: Sequence[_Measurement]) -> _Measurement:
    """Median of each figure."""
    return _Measurement(*np.median(np.array(measurements), axis=0))


def _row(setting: _Setting, reads: bool, turn: str, measurement: _Measurement) -> list[str]:
    """Row of the table."""
    answers = "read" if reads else "unread"
    counts = measurement[:3]
    figures = measurement[3:]
    return [
        f"{setting.name}, {answers}",
        turn,
        *(f"{count:.0f}" for count in counts),
        *(f"{figure:.2f}" for figure in figures),
    ]


@contextlib.contextmanager
def _setting(folder: pathlib.Path, has_certificates: bool) -> Iterator[_Setting]:
    """Starts the servers and the honest clients."""
    policy = folder / "policy.safetensors"
    bundles.save(untrained(get_preset("quickstart")), policy)
    server = None
    certs: list[pathlib.Path] = []
    if has_certificates:
        authority = folder / "certs"
        create_authority(authority)
        server = issue(authority, "server")
        certs = [issue(authority, "client") for _ in range(_HONEST + CONNECTIONS)]
    honest: list[pathlib.Path | None] = [*certs[:_HONEST]] or [None] * _HONEST
    episode = example_episode(1_000_000)
    with contextlib.ExitStack() as stack:
        ends = [
            stack.enter_context(serve_policy(policy, folder / f"{name}.log", server))[0]
            for name in ("here", "elsewhere")
        ]
        clients = []
        for certificate in honest:
            client = PolicyClient(ends[0], wait=_START, timeout=2.0, certs=certificate)
            clients.append(stack.enter_context(client))
        with PolicyClient(ends[1], wait=_START, certs=honest[0]) as client:
            client.metadata()
        for client in clients:
            client.reset(episode.request)
            client.act(episode.state)
        query = folder / "query"
        query.write_bytes(single_query(clients[0], episode))
        name = "certs" if has_certificates else "names"
        yield _Setting(
            name=name,
            endpoint=ends[0],
            elsewhere=ends[1],
            clients=clients,
            attacker=certs[_HONEST:],
            query=query,
            episode=episode,
        )


def _measured(setting: _Setting, seconds: float) -> _Outcome:
    """Queries of all honest clients for some seconds."""

    def ask(client: PolicyClient, rate: float) -> _Outcome:
        client.reset(setting.episode.request)
        times: list[float] = []
        refused = 0
        lost = 0
        ends = time.monotonic() + seconds
        while (began := time.monotonic()) < ends:
            try:
                client.act(setting.episode.state)
                times.append(time.monotonic() - began)
            except OverloadedError:
                refused += 1
            except TransportError:
                lost += 1
            time.sleep(max(0.0, 1.0 / rate - (time.monotonic() - began)))
        return _Outcome(times, refused, lost)

    with concurrent.futures.ThreadPoolExecutor(_HONEST) as pool:
        outcomes = list(pool.map(ask, setting.clients, _RATES))
    times = list(itertools.chain.from_iterable(outcome.times for outcome in outcomes))
    refused = sum(outcome.refused for outcome in outcomes)
    lost = sum(outcome.lost for outcome in outcomes)
    return _Outcome(times, refused, lost)
