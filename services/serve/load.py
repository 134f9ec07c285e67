"""A policy server in a separate process, a plausible query for it, and a latency test."""

import concurrent.futures
import contextlib
import pathlib
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from congrasp.common.errors import OverloadedError, TransportError
from congrasp.common.request import GraspRequest
from congrasp.common.transport.ports import local_url
from congrasp.services.client.policy import Policy
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.ops.lifetime import Child, command, end_all


@contextlib.contextmanager
def serving(
    policy: pathlib.Path, log: pathlib.Path, certs: pathlib.Path | None = None
) -> Iterator[tuple[str, int]]:
    """Context with a server of a policy file on this machine: yields its endpoint and process id.

    The server may still be compiling: a client's `metadata` waits for it.

    Args:
      policy: the file.
      log: file for the server's output.
      certs: folder of a server's certificate.
    """
    endpoint = local_url()
    shared = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}  # a GPU's memory, with this process
    server = Child(
        "server", command("serve", policy=policy, listen=endpoint, certs=certs), log, shared
    )
    try:
        yield endpoint, server.start()
    finally:
        end_all([server])


class Example(NamedTuple):
    """Initial state of an episode."""

    hand: str
    """Name of the hand."""
    object: str
    """Name of the object."""
    request: GraspRequest
    """Request for `reset`."""
    state: dict[str, np.ndarray]
    """State for `act`."""


def example_episode(seed: int, hand: str = "human") -> Example:
    """Returns the initial state of an episode with a procedural object and one of its headings."""
    import jax

    from congrasp.actors.initial import initial_hand
    from congrasp.common.hands import get_hand
    from congrasp.common.objects import procedural
    from congrasp.common.objects.pool import scale_objects
    from congrasp.common.task.config import TaskConfig
    from congrasp.common.task.constraints import goal_of
    from congrasp.common.task.types import Surface
    from congrasp.services.grasp.approaches import headings

    task, found = TaskConfig(hand=hand, constraints=("heading",)), get_hand(hand)
    (obj,) = scale_objects(found, task, [procedural.generate(seed)])
    *frame, (rest,) = headings(found, obj, GraspRequest(), 1, np.random.default_rng(seed))
    position, direction, cross = (axis[0].astype(np.float32) for axis in frame)
    goals = {"heading": {"position": position, "direction": direction, "cross": cross}}
    points, pose = (
        np.asarray(x, np.float32) for x in (obj.points[: task.surface_points], obj.rest_poses[rest])
    )
    asked = (
        goal_of(found, task, GraspRequest(goals)),
        Surface(points, np.zeros(len(points), bool)),
        pose,
    )
    begin = jax.jit(initial_hand, static_argnums=(0, 1))
    q, *wrist = (
        np.asarray(value)[0]
        for value in begin(found, task, *jax.tree.map(lambda x: x[None], asked))
    )
    world = tuple(wrist), (pose[:3], pose[3:])
    request = GraspRequest(goals, surface=points, q=q, wrist=world[0], object_pose=world[1])
    state = {"q": q, "u": np.zeros(6), "object_position": pose[:3], "object_quaternion": pose[3:]}
    return Example(found.name, obj.name, request, state)


def measure(  # noqa: PLR0913
    connect: str,
    name: str,
    episode: Example,
    repeat: int,
    concurrency: int,
    timeout: float,
    certs: pathlib.Path | None = None,
    states: int = 1,
    rate: float = 0.0,
) -> dict[str, float]:
    """Latencies of `repeat` queries from `concurrency` clients; the first query of each client is
    not counted.

    With `states` > 1 each query holds that many, and each state counts as an answer. Each client
    sends `rate` queries a second, spread over the second, or its next query after the answer if
    that is 0. The measurement begins when all clients have had their first answer.
    """
    share = max(1, repeat // concurrency)

    def connected(_: int) -> PolicyClient:
        client = stack.enter_context(
            PolicyClient(connect, name, hand=episode.hand, timeout=timeout, certs=certs)
        )
        client.reset(episode.request)
        client.act(episode.state)
        return client

    def ask(index: int, client: PolicyClient) -> tuple[list[float], int, int]:
        times, failed, overloaded, state = [], 0, 0, episode.state
        for number in range(share):
            if rate:
                time.sleep(
                    max(0.0, began + (number + index / concurrency) / rate - time.perf_counter())
                )
            try:
                answer = client.act(state) if states == 1 else client.act_each([state] * states)[0]
                times.append(answer.round_trip_ms)
            except OverloadedError:
                overloaded += 1
            except TransportError:
                failed += 1
        return times, failed, overloaded

    with (
        contextlib.ExitStack() as stack,
        concurrent.futures.ThreadPoolExecutor(concurrency) as pool,
    ):
        clients = list(pool.map(connected, range(concurrency)))
        began = time.perf_counter()
        results = list(pool.map(ask, range(concurrency), clients))
        spent = time.perf_counter() - began
    times = np.concatenate([np.array(part) for part, _, _ in results])
    return {
        "p50_ms": float(np.percentile(times, 50)) if len(times) else float("nan"),
        "p99_ms": float(np.percentile(times, 99)) if len(times) else float("nan"),
        "answers_per_s": states * len(times) / spent,
        "failed": sum(failed for _, failed, _ in results),
        "overloaded": sum(overloaded for _, _, overloaded in results),
    }


def one_answer(policy: Policy, episode: Example) -> str:
    """Queries the first action of an episode; returns the answer as text."""
    policy.reset(episode.request)
    answer = policy.act(episode.state)
    with np.printoptions(precision=3, suppress=True):
        return (
            f"object       {episode.object}, constraints: "
            f"{', '.join(episode.request.constraints)}\n"
            f"active       {' '.join(answer.active)}\n"
            f"q_target     {answer.q_target} rad\n"
            f"u_target     {answer.u_target} m, rad\n"
            f"version      {answer.version}\n"
            f"timing       {answer.round_trip_ms:.2f} ms round trip, {answer.server_ms:.2f} ms in "
            f"the server"
        )
