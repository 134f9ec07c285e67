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
def serve_policy(
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
    arguments = command("serve", policy=policy, listen=endpoint, certs=certs)
    # This process and the server share the memory of a GPU
    environment = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    server = Child("server", arguments, log, environment)
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

    from congrasp.actors.initial_hand import initial_hand
    from congrasp.common.hands import get_hand
    from congrasp.common.objects import procedural
    from congrasp.common.objects.pool import scale_objects
    from congrasp.common.task.config import TaskConfig
    from congrasp.common.task.constraints import goal_of
    from congrasp.common.task.types import Surface
    from congrasp.services.grasp.approaches import headings

    task = TaskConfig(hand=hand, constraints=("heading",))
    spec = get_hand(hand)
    rng = np.random.default_rng(seed)
    (obj,) = scale_objects(spec, task, [procedural.generate(seed)])
    positions, directions, crosses, (rest,) = headings(spec, obj, GraspRequest(), 1, rng)
    goals = {
        "heading": {
            "position": positions[0].astype(np.float32),
            "direction": directions[0].astype(np.float32),
            "cross": crosses[0].astype(np.float32),
        }
    }
    points = np.asarray(obj.points[: task.surface_points], np.float32)
    pose = np.asarray(obj.rest_poses[rest], np.float32)
    goal = goal_of(spec, task, GraspRequest(goals))
    surface = Surface(points, np.zeros(len(points), bool))
    batch_of_one = jax.tree.map(lambda x: x[None], (goal, surface, pose))
    start = jax.jit(initial_hand, static_argnums=(0, 1))(spec, task, *batch_of_one)
    q, wrist_position, wrist_quaternion = (np.asarray(value)[0] for value in start)
    request = GraspRequest(
        goals,
        surface=points,
        q=q,
        wrist=(wrist_position, wrist_quaternion),
        object_pose=(pose[:3], pose[3:]),
    )
    state = {"q": q, "u": np.zeros(6), "object_position": pose[:3], "object_quaternion": pose[3:]}
    return Example(spec.name, obj.name, request, state)


class Target(NamedTuple):
    """A policy server and how clients connect to it."""

    connect: str
    """Endpoint of the server."""
    name: str
    """Name of the served run."""
    timeout: float
    """Deadline of one query, s."""
    certs: pathlib.Path | None = None
    """Folder of a client's certificate."""


class Load(NamedTuple):
    """Queries of a latency test."""

    repeat: int
    """Total number of queries."""
    concurrency: int
    """Number of clients, each with a separate connection."""
    states: int = 1
    """States in one query; each counts as an answer."""
    rate: float = 0.0
    """Queries a second of each client, spread over the second; 0 sends the next after each
    answer.
    """


class _Outcomes(NamedTuple):
    """Results of one client's queries."""

    round_trips_ms: list[float]
    """Round trips of the answers."""
    failed: int
    overloaded: int


def measure(target: Target, episode: Example, load: Load) -> dict[str, float]:
    """Measures the latencies of queries from concurrent clients.

    The measurement begins when all clients have had their first answer, which is not counted.
    """
    with (
        contextlib.ExitStack() as stack,
        concurrent.futures.ThreadPoolExecutor(load.concurrency) as pool,
    ):

        def connect(_: int) -> PolicyClient:
            """Returns a client that has had its first answer."""
            client = PolicyClient(
                target.connect,
                target.name,
                hand=episode.hand,
                timeout=target.timeout,
                certs=target.certs,
            )
            stack.enter_context(client)
            client.reset(episode.request)
            client.act(episode.state)
            return client

        clients = list(pool.map(connect, range(load.concurrency)))
        began = time.perf_counter()

        def query(index: int, client: PolicyClient) -> _Outcomes:
            """Sends a client's share of the queries; returns their outcomes."""
            return _query_repeatedly(client, index, episode, load, began)

        results = list(pool.map(query, range(load.concurrency), clients))
        duration = time.perf_counter() - began
    round_trips_ms = np.concatenate([np.array(result.round_trips_ms) for result in results])
    p50 = float("nan")
    p99 = float("nan")
    if len(round_trips_ms):
        p50 = float(np.percentile(round_trips_ms, 50))
        p99 = float(np.percentile(round_trips_ms, 99))
    return {
        "p50_ms": p50,
        "p99_ms": p99,
        "answers_per_s": load.states * len(round_trips_ms) / duration,
        "failed": sum(result.failed for result in results),
        "overloaded": sum(result.overloaded for result in results),
    }


def _query_repeatedly(
    client: PolicyClient, index: int, episode: Example, load: Load, began: float
) -> _Outcomes:
    """Sends one client's share of the queries.

    Args:
      client: the client, after its first answer.
      index: its number, which determines its offset within a second.
      episode: the episode whose initial state it sends.
      load: all queries.
      began: start of the measurement (`time.perf_counter`).
    """
    round_trips_ms: list[float] = []
    failed = 0
    overloaded = 0
    for number in range(max(1, load.repeat // load.concurrency)):
        if load.rate:
            due = began + (number + index / load.concurrency) / load.rate
            time.sleep(max(0.0, due - time.perf_counter()))
        try:
            if load.states == 1:
                answer = client.act(episode.state)
            else:
                answer = client.act_each([episode.state] * load.states)[0]
            round_trips_ms.append(answer.round_trip_ms)
        except OverloadedError:
            overloaded += 1
        except TransportError:
            failed += 1
    return _Outcomes(round_trips_ms, failed, overloaded)


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
