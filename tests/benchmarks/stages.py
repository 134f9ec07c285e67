"""Stages of a query of a policy server, whose means add up to that of its round trip.

`python -m tests.benchmarks.stages ENDPOINT BYTES` answers bare Zenoh queries.
"""

import contextlib
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from zenoh.handlers import FifoChannel

from congrasp.common.policy import bundle as bundles
from congrasp.common.transport.ports import local_url
from congrasp.common.wire.codec import Message, decode, encode
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.ops.lifetime import follow_parent
from congrasp.services.serve.load import Example, example_episode, serve_policy
from congrasp.services.train.command import untrained
from congrasp.services.train.presets import get_preset
from tests.bare_zenoh import bare_session
from tests.children import following

_START_S = 300.0
_TIMEOUT_S = 5.0
_KEY = "echo"
_WARM_UP = 20  # queries of a turn that are not measured


class _Stages(NamedTuple):
    """Durations of one query, ms."""

    packing: float
    transport: float
    queue: float
    inference: float
    rest: float


_DESCRIPTIONS = (
    "client: packing the state, unpacking the answer",
    "Zenoh, threads, encoding and decoding of both messages",
    "server: queue",
    "server: inference",
    "server: parsing the query, resolving the answer",
)
"""Those of the fields of `_Stages`."""


class _StagedClient(PolicyClient):
    """A client that measures its queries."""

    query: Message = Message()
    reply: Message = Message()
    query_ms = 0.0

    def _query(self, query: Message) -> Message:
        """The server's reply; notes both messages and the duration."""
        began = time.perf_counter()
        reply = super()._query(query)
        self.query_ms = 1e3 * (time.perf_counter() - began)
        self.query = query
        self.reply = reply
        return reply


def stages(queries: int = 300, turns: int = 5, pause: float = 0.01) -> int:
    """Durations of the stages of a query of one client, of a bare Zenoh query of as many bytes, and
    of the codec.

    They are measured in turn. The stages are disjoint, so that their means add up.

    Args:
      queries: Queries of each kind in a turn.
      turns: Number of turns.
      pause: Seconds between two queries, as in a control loop.

    Examples:
      python -m tests.benchmarks stages
      python -m tests.benchmarks stages --queries 100 --turns 3 --pause 0
    """
    rows: list[_Stages] = []
    bare: list[float] = []
    codec: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        policy = folder / "policy.safetensors"
        bundles.save(untrained(get_preset("quickstart")), policy)
        with serve_policy(policy, folder / "serve.log") as (endpoint, _):
            episode = example_episode(1_000_000)
            with _StagedClient(endpoint, wait=_START_S, timeout=_TIMEOUT_S) as client:
                client.metadata()
                client.reset(episode.request)
                client.act(episode.state)
                query = encode(client.query)
                reply = encode(client.reply)
                with _echo(len(reply)) as echo:
                    for _ in range(turns):
                        rows += _policy_queries(client, episode, queries, pause)
                        bare += _bare_queries(echo, query, queries, pause)
                        codec += _codec_times([query, reply], queries, pause)
    references = {
        "bare Zenoh query of as many bytes": bare,
        "encoding and decoding of both messages in one process": codec,
    }
    _print(np.array(rows), references, len(query))
    return 0


def _policy_queries(
    client: _StagedClient, episode: Example, count: int, pause: float
) -> list[_Stages]:
    """Measures queries of the policy server."""
    rows = []
    for _ in range(_WARM_UP + count):
        time.sleep(pause)
        answer = client.act(episode.state)
        meta = client.reply.meta
        stages_of_query = _Stages(
            packing=answer.round_trip_ms - client.query_ms,
            transport=client.query_ms - meta["total_ms"],
            queue=meta["queue_ms"],
            inference=meta["infer_ms"],
            rest=meta["total_ms"] - meta["queue_ms"] - meta["infer_ms"],
        )
        rows.append(stages_of_query)
    return rows[_WARM_UP:]


def _bare_queries(endpoint: str, query: bytes, count: int, pause: float) -> list[float]:
    """Measures bare Zenoh queries, ms."""
    times = []
    with bare_session("client", connect=endpoint) as session:
        for _ in range(_WARM_UP + count):
            time.sleep(pause)
            began = time.perf_counter()
            for reply in session.get(_KEY, FifoChannel(4), payload=query, timeout=_TIMEOUT_S):
                assert reply.ok is not None, "the bare query was not answered"
                reply.ok.payload.to_bytes()
            times.append(1e3 * (time.perf_counter() - began))
    return times[_WARM_UP:]


def _codec_times(messages: Sequence[bytes], count: int, pause: float) -> list[float]:
    """Measures decoding and encoding messages, ms."""
    times = []
    for _ in range(_WARM_UP + count):
        time.sleep(pause)
        began = time.perf_counter()
        for message in messages:
            decoded = decode(message)
            encode(Message(decoded.arrays, decoded.meta))
        times.append(1e3 * (time.perf_counter() - began))
    return times[_WARM_UP:]


@contextlib.contextmanager
def _echo(reply_bytes: int) -> Iterator[str]:
    """Context with a process that answers bare queries; yields its endpoint."""
    endpoint = local_url()
    command = [sys.executable, "-m", "tests.benchmarks.stages", endpoint, str(reply_bytes)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env=following())
    try:
        assert process.stdout is not None
        assert process.stdout.readline(), "the bare responder did not start"
        yield endpoint
    finally:
        process.kill()
        process.wait()


def _print(rows: np.ndarray, references: Mapping[str, Sequence[float]], query_bytes: int) -> None:
    """Prints the stages (n, 5) and other durations by name, ms."""
    load = os.getloadavg()[0]
    table = Table(title=f"{len(rows)} queries of {query_bytes} bytes; load average {load:.1f}")
    table.add_column("stage")
    for column in ("mean, ms", "p50", "p99"):
        table.add_column(column, justify="right")
    round_trips = rows.sum(1)
    for description, times in zip(_DESCRIPTIONS, rows.T, strict=True):
        table.add_row(description, *_figures(times))
    table.add_section()
    table.add_row("round trip", *_figures(round_trips))
    for description, durations in references.items():
        table.add_row(description, *_figures(np.array(durations)))
    Console(width=100).print(table)


def _figures(times: np.ndarray) -> list[str]:
    """Mean, median and 99th percentile as text."""
    figures = [np.mean(times), np.percentile(times, 50), np.percentile(times, 99)]
    return [f"{figure:.2f}" for figure in figures]


def _answer_bare_queries(endpoint: str, reply_bytes: int) -> None:
    """Answers bare queries until the process is killed."""
    payload = bytes(reply_bytes)
    with bare_session("peer", listen=endpoint) as session:
        queryable = session.declare_queryable(_KEY, FifoChannel(4))
        print("began", flush=True)
        for query in queryable:
            with query:
                query.reply(_KEY, payload)


if __name__ == "__main__":
    follow_parent()
    _answer_bare_queries(sys.argv[1], int(sys.argv[2]))
