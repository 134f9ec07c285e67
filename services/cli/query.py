"""`congrasp query`: one query of a policy server, or a latency test."""

from typing import Annotated, Any

import tyro


def query(
    connect: str = "tcp/127.0.0.1:7457",
    name: str = "policy",
    object_seed: int = 1_000_000,
    repeat: int = 1,
    concurrency: int = 1,
    timeout: float = 1.0,
    json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Ask a policy server for one action at the start of an episode, or measure its latency.

    Args:
      connect: The server's endpoint.
      name: Name under which the policy is served.
      object_seed: Seed of the procedural object and of the heading.
      repeat: Queries in all.
      concurrency: Clients that ask at the same time, each with a connection of its own.
      timeout: Seconds that one query may take.
      json: Print JSON: p50_ms, p99_ms, answers_per_s, failed, overloaded.
    """
    import json as json_module

    from services.load import example_episode, measure

    if repeat == 1 and not json:
        _print_one(connect, name, example_episode(object_seed), timeout)
        return 0
    result = measure(connect, name, example_episode(object_seed), repeat, concurrency, timeout)
    if json:
        print(json_module.dumps(result))
    else:
        latency = (
            f"p50 {result['p50_ms']:.2f} ms, p99 {result['p99_ms']:.2f} ms, {result['answers_per_s']:.0f} answers/s"
        )
        lost = f"{result['failed']:.0f} failed, {result['overloaded']:.0f} overloaded"
        print(f"{repeat} queries from {concurrency} client(s): {latency}, {lost}")
    return 0 if result["failed"] == 0 else 1


def _print_one(connect: str, name: str, episode: dict[str, Any], timeout: float) -> None:
    import numpy as np

    from services.client import PolicyClient

    with PolicyClient(connect, name, timeout=timeout) as client:
        client.reset(**episode["reset"])
        answer = client.act(episode["state"])
    with np.printoptions(precision=3, suppress=True):
        print(f"object       {episode['object']}, constraints: {', '.join(episode['reset']['constraints'])}")
        print(f"active       {' '.join(answer.active)}")
        print(f"q_target     {answer.q_target} rad")
        print(f"u_target     {answer.u_target} m, rad")
        print(f"version      {answer.version}")
        print(f"timing       {answer.round_trip_ms:.2f} ms round trip, {answer.server_ms:.2f} ms in the server")


COMMAND = query
