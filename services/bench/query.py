"""Latency of a policy server in a separate process, with an untrained policy, over loopback."""

import pathlib
import tempfile

import psutil

from congrasp.common.policy import bundle as bundles
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.serve.load import Load, Target, example_episode, measure, serve_policy
from congrasp.services.train.command import untrained
from congrasp.services.train.presets import get_preset

_EPISODE_SEED = 1_000_000
_START_TIMEOUT_S = 180.0
"""Longest wait for the server, which compiles the policy first."""
_ANSWER_TIMEOUT_S = 5.0


def bench_query(load: Load) -> None:
    """Prints the latency of a server under a load, and its processor time per answer."""
    with tempfile.TemporaryDirectory() as folder:
        policy = pathlib.Path(folder, "policy.safetensors")
        bundles.save(untrained(get_preset("quickstart")), policy)
        with serve_policy(policy, pathlib.Path(folder, "serve.log")) as (endpoint, server):
            episode = example_episode(_EPISODE_SEED)
            with PolicyClient(endpoint, wait=_START_TIMEOUT_S) as client:
                client.metadata()
            process = psutil.Process(server)
            before = _processor_seconds(process)
            target = Target(endpoint, "policy", timeout=_ANSWER_TIMEOUT_S)
            result = measure(target, episode, load)
            busy = _processor_seconds(process) - before
            result["server_cpu_ms"] = 1e3 * busy / load.repeat / load.states
    print(", ".join(f"{name} {value:.2f}" for name, value in result.items()))


def _processor_seconds(process: psutil.Process) -> float:
    """Processor time of a process so far, in user and system mode, s."""
    times = process.cpu_times()
    return times.user + times.system
