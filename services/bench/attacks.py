"""What hostile and slow peers cost honest ones: the same honest work alone and beside each, in one run.

The policy server is the real one with an untrained policy; the learner is the real hub without a learner. Honest peers
are paced as real ones are: a client asks 100 times a second, an actor makes a rollout of 0.8 MB in 50 ms and pulls
weights of 3.5 MB after every second one. Attackers (`services.bench.attackers`) are processes of their own.
"""

import contextlib
import itertools
import multiprocessing
import pathlib
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import psutil

from actors.link import ActorLink
from common.errors import CongraspError
from common.policy import bundle as bundles
from common.transport import urls
from common.transport.keys import FLOWS
from common.transport.ports import free_port, local_url, shifted
from common.wire.codec import Message, encode
from common.wire.schema import RolloutForm
from learner.hub import LearnerHub
from learner.staleness import StalenessManager
from services.serve.client import PolicyClient
from services.serve.load import Example, example_episode, serving, wait_until_ready
from services.train.command import untrained
from services.train.presets import get_preset

_FORM = RolloutForm(steps=20, worlds=34, observation=534, action=26, half=True)
_RUN, _RUN_ID, _SCHEMA = "bench", "id", "schema"
_BATCH = 2
_WEIGHTS = 875_000  # float32
_PACE = 0.05  # seconds in which an actor makes a rollout
_PERIOD = 0.01  # seconds between two queries of a client
_SLOW = 400e3  # bytes a second of a slow actor's link
_START = 180.0  # seconds that processes may take to start


class Row(NamedTuple):
    """What honest peers had alone, and beside an attack."""

    attack: str
    unit: str
    alone: float
    attacked: float
    note: str


def bench_attacks(seconds: float) -> None:
    """Prints a table of all attacks, each measured for `seconds` and compared with as long without it."""
    print(f"{'beside':34} {'honest':26} {'alone':>8} {'beside':>8} {'ratio':>6}", flush=True)
    for row in itertools.chain(_on_the_server(seconds), _on_the_learner(seconds)):
        ratio = row.attacked / row.alone
        print(
            f"{row.attack:34} {row.unit:26} {row.alone:8.2f} {row.attacked:8.2f} {ratio:6.2f}  {row.note}", flush=True
        )


@contextlib.contextmanager
def attacked(kind: str, endpoint: str, run: str, query: pathlib.Path | None = None, count: int = 1) -> Iterator[None]:
    """Attackers of a kind, in processes of their own, while the block runs."""
    command = [sys.executable, "-m", "services.bench.attackers", kind, endpoint, run, str(query or "")]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) for _ in range(count)]
    try:
        for process in processes:
            assert process.stdout is not None
            if not process.stdout.readline():
                raise CongraspError(f"The attacker '{kind}' did not start.")
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


# --- a policy server and its clients ---


def _on_the_server(seconds: float) -> Iterator[Row]:
    """What a client's queries, and a new client's connection, take beside each attack on the policy server."""
    with tempfile.TemporaryDirectory() as folder:
        policy, query = pathlib.Path(folder, "policy.safetensors"), pathlib.Path(folder, "query")
        bundles.save(untrained(get_preset("quickstart")), policy)
        with serving(policy, pathlib.Path(folder, "serve.log")) as (endpoint, process):
            episode = example_episode(1_000_000)
            with PolicyClient(endpoint, wait=_START) as client:
                wait_until_ready(client)
                query.write_bytes(_long_query(client, episode))
                _latencies(client, episode, 1.0)
                for kind, count in (("unread", 2), ("silent", 1), ("huge", 1)):
                    alone = _latencies(client, episode, seconds)
                    before = _connecting(endpoint)
                    with attacked(kind, endpoint, "policy", query if kind == "unread" else None, count):
                        time.sleep(1.0)
                        times, after = _latencies(client, episode, seconds), _connecting(endpoint)
                    memory = psutil.Process(process).memory_info().rss / 1e6
                    name = f"{count} x {kind}"
                    note = f"{len(times)} of {len(alone)} answers, server {memory:.0f} MB"
                    yield Row(name, "p99 of a query, ms", _p99(alone), _p99(times), note)
                    yield Row(name, "a new connection, ms", 1e3 * before, 1e3 * after, "")


def _p99(times: list[float]) -> float:
    return 1e3 * float(np.percentile(times, 99))


def _latencies(client: PolicyClient, episode: Example, seconds: float) -> list[float]:
    """Seconds of the queries of a client that asks 100 times a second."""
    client.reset(episode.request)
    times, deadline = [], time.monotonic() + seconds
    while time.monotonic() < deadline:
        began = time.monotonic()
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
    kept: list[Message] = []
    asked = client._query

    def keep(query: Message) -> Message:
        kept.append(Message(query.arrays, {"hand": episode.hand, "timeout": 60.0, **query.meta}))
        return asked(query)

    client._query = keep  # type: ignore[method-assign]
    client.reset(episode.request)
    client.act_each([episode.state] * 64)
    client._query = asked  # type: ignore[method-assign]
    return encode(kept[-1])


# --- a learner and its actors ---


def _on_the_learner(seconds: float) -> Iterator[Row]:
    """What an honest actor's rollouts and the run's updates come to beside each attack on the learner."""
    attacks: dict[str, Callable[[str], contextlib.AbstractContextManager[Any]]] = {
        "1 x greedy": lambda endpoint: attacked("greedy", endpoint, _RUN),
        "3 x greedy": lambda endpoint: attacked("greedy", endpoint, _RUN, count=3),
        "1 x silent": lambda endpoint: attacked("silent", endpoint, _RUN),
        "an actor of 400 kB/s": _slow_actor,
    }
    spawn = multiprocessing.get_context("spawn")
    endpoint, updates, rollouts, pause = local_url(), spawn.Value("i", 0), spawn.Value("i", 0), spawn.Value("d", 0.0)
    roles = (_learn, (endpoint, updates)), (_act, (endpoint, "honest", rollouts, pause))
    processes = [spawn.Process(target=role, args=arguments, daemon=True) for role, arguments in roles]
    try:
        for process in processes:
            process.start()
        deadline = time.monotonic() + _START
        while not rollouts.value:
            if time.monotonic() > deadline:
                raise CongraspError("The learner or the actor did not start.")
            time.sleep(0.1)

        def rates() -> tuple[float, float, float]:
            pause.value = 0.0
            before, began = (rollouts.value, updates.value), time.monotonic()
            time.sleep(seconds)
            spent = time.monotonic() - began
            return (rollouts.value - before[0]) / spent, (updates.value - before[1]) / spent, pause.value

        for name, attack in attacks.items():
            alone = rates()
            with attack(endpoint):
                time.sleep(1.0)
                beside = rates()
            note = (
                f"updates {beside[1]:.1f} of {alone[1]:.1f} a second, longest pause {beside[2]:.2f} ({alone[2]:.2f}) s"
            )
            yield Row(name, "rollouts a second", alone[0], beside[0], note)
    finally:
        for process in processes:
            process.kill()
            process.join()


def _learn(endpoint: str, updates: Any) -> None:
    """A hub that is given new weights after every batch."""
    staleness = StalenessManager(1, _BATCH)
    sizes = {"observation": (_FORM.observation,), "value": ()}
    arrays: dict[str, Any] = {f"{kind}/{m}": np.zeros(size) for kind, size in sizes.items() for m in ("mean", "m2")}
    arrays |= {"observation/count": np.zeros(()), "value/count": np.zeros(())}
    meta = {"epoch": _RUN_ID, "schema": _SCHEMA, "hand": "human", "layout": [], "format": 1, "action_size": 26}
    with urls.listen(endpoint, "learner") as transport:
        hub = LearnerHub(
            transport, run=_RUN, config_json="{}", run_id=_RUN_ID, schema=_SCHEMA, form=_FORM, staleness=staleness
        )
        for version in range(10**9):
            weights = np.full(_WEIGHTS, version, np.float32)
            hub.publish_weights(Message({**arrays, "actor/w": weights}, {**meta, "version": version}), version)
            while not hub.next_batch(_BATCH, 1.0):
                pass
            updates.value += 1


def _act(endpoint: str, name: str, rollouts: Any, pause: Any) -> None:
    """An actor that makes a rollout in 50 ms; it notes how many were accepted, and the longest time between two."""
    arrays = _FORM.zeros()
    version, ended = -1, time.monotonic()
    with urls.connect(endpoint, "actor", wait=_START) as transport, ActorLink(transport, _RUN, name, window=2) as link:
        link.config(_START)
        while True:
            ticket = link.acquire_ticket(1.0)
            if ticket is None:
                continue
            bundle = link.weights(version)
            version = version if bundle is None else bundle.meta["version"]
            time.sleep(_PACE)
            meta = {"version": max(version, 0), "schema": _SCHEMA, "steps": _FORM.steps * _FORM.worlds}
            link.upload(Message(arrays, meta), ticket).add_done_callback(lambda done: None)
            rollouts.value += 1
            now = time.monotonic()
            pause.value, ended = max(pause.value, now - ended), now


@contextlib.contextmanager
def _slow_actor(endpoint: str) -> Iterator[None]:
    """An honest actor behind a link of 400 kB/s, while the block runs."""
    spawn = multiprocessing.get_context("spawn")
    with throttled(endpoint, _SLOW) as slow:
        arguments = slow, "slow", spawn.Value("i", 0), spawn.Value("d", 0.0)
        process = spawn.Process(target=_act, args=arguments, daemon=True)
        process.start()
        try:
            time.sleep(5.0)
            yield
        finally:
            process.kill()
            process.join()


@contextlib.contextmanager
def throttled(endpoint: str, rate: float) -> Iterator[str]:
    """An endpoint through which another one, with all its flows, is reached at so many bytes a second each way."""
    port, ended = free_port(), threading.Event()

    def pump(source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError), source, target:
            while not ended.is_set() and (data := source.recv(int(rate / 50))):
                target.sendall(data)
                time.sleep(len(data) / rate)

    def accept(listener: socket.socket, target: tuple[str, int]) -> None:
        with contextlib.suppress(OSError), listener:
            while True:
                near, far = listener.accept()[0], socket.create_connection(target, 5.0)
                for one in (near, far):
                    one.settimeout(None)
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 64 << 10)
                for pair in ((near, far), (far, near)):
                    threading.Thread(target=pump, args=pair, daemon=True).start()

    listeners = []
    for index in range(len(FLOWS)):
        host, _, number = shifted(endpoint, index).partition("/")[2].rpartition(":")
        listeners.append(socket.create_server(("127.0.0.1", port + index)))
        threading.Thread(target=accept, args=(listeners[-1], (host, int(number))), daemon=True).start()
    try:
        yield f"tcp/127.0.0.1:{port}"
    finally:
        ended.set()
        for listener in listeners:
            listener.close()
