"""`congrasp query`: one query of a policy server, or a latency test."""

import pathlib
from typing import Annotated

import tyro

from congrasp.common.errors import TransportError
from congrasp.common.transport.ports import SERVER_URL
from congrasp.services.cli.console import in_range
from congrasp.services.client.policy_client import PolicyClient


def query(  # noqa: PLR0913
    connect: str = SERVER_URL,
    name: str = "policy",
    object_seed: int = 1_000_000,
    repeat: int = 1,
    concurrency: int = 1,
    states: int = 1,
    rate: float = 0.0,
    timeout: float = 1.0,
    certs: pathlib.Path | None = None,
    health: bool = False,
    json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Query a policy server for one action at the start of an episode, or measure its latency.

    Args:
      connect: The server's endpoint.
      name: Name of the served run.
      object_seed: Seed of the procedural object and of the heading.
      repeat: Total number of queries.
      concurrency: Number of concurrent clients, each with a separate connection.
      states: States in one query, up to 64; each gets an answer.
      rate: Queries a second of each client; 0 sends the next after each answer.
      timeout: Deadline of one query, s.
      certs: Folder of a client's certificate (congrasp certs).
      health: Only check whether the server is ready; the exit code is 0 if it is, else 4.
      json: Print JSON: p50_ms, p99_ms, answers_per_s, failed, overloaded.

    Examples:
      congrasp query --connect tcp/127.0.0.1:7457
      congrasp query --repeat 1000 --concurrency 4 --json
      congrasp query --repeat 4000 --concurrency 200 --rate 2
    """
    import json as json_module

    in_range(1, repeat=repeat, concurrency=concurrency, states=states)
    in_range(0, rate=rate)
    if health:
        with PolicyClient(connect, name, timeout=timeout, wait=timeout, certs=certs) as client:
            found = client.health()
        print(json_module.dumps(found))
        return 0 if found["ready"] else TransportError.exit_code
    from congrasp.services.serve.load import Load, Target, example_episode, measure, one_answer

    with PolicyClient(connect, name, timeout=timeout, certs=certs) as client:
        episode = example_episode(object_seed, str(client.health()["hand"]))
    with PolicyClient(connect, name, hand=episode.hand, timeout=timeout, certs=certs) as client:
        if repeat == states == 1 and not json:
            print(one_answer(client, episode))
            return 0
    target = Target(connect, name, timeout, certs)
    result = measure(target, episode, Load(repeat, concurrency, states, rate))
    if json:
        print(json_module.dumps(result))
    else:
        latency = "p50 {p50_ms:.2f} ms, p99 {p99_ms:.2f} ms, {answers_per_s:.0f} answers/s".format(
            **result
        )
        lost = f"{result['failed']:.0f} failed, {result['overloaded']:.0f} overloaded"
        print(
            f"{repeat} queries of {states} state(s) from {concurrency} client(s): {latency}, {lost}"
        )
    return 0 if result["failed"] == 0 else 1


COMMAND = query
