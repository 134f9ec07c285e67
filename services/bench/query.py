"""Latency of a policy server in a separate process."""

import pathlib
import tempfile

import psutil

from congrasp.common.policy import bundle as bundles
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.serve.load import example_episode, measure, serving
from congrasp.services.train.command import untrained
from congrasp.services.train.presets import get_preset


def bench_query(repeat: int, concurrency: int, states: int) -> None:
    """Prints latencies and rates of queries of an untrained policy, and the server's processor time per answer.

    Args:
      repeat: total number of queries.
      concurrency: number of concurrent clients.
      states: number of states in one query.
    """
    with tempfile.TemporaryDirectory() as folder:
        policy = pathlib.Path(folder, "policy.safetensors")
        bundles.save(untrained(get_preset("quickstart")), policy)
        with serving(policy, pathlib.Path(folder, "serve.log")) as (endpoint, server):
            episode = example_episode(1_000_000)
            with PolicyClient(endpoint, wait=180.0) as client:
                client.metadata()
            process = psutil.Process(server)
            before = process.cpu_times()
            result = measure(endpoint, "policy", episode, repeat, concurrency, 5.0, states=states)
            after = process.cpu_times()
            result["server_cpu_ms"] = 1e3 * (sum(after[:2]) - sum(before[:2])) / repeat / states  # of user and system
    print(", ".join(f"{name} {value:.2f}" for name, value in result.items()))
