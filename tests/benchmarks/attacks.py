"""What hostile and slow peers cost honest ones: the same honest work alone and beside each, in one run.

The policy server is the real one with an untrained policy; the learner is the real hub without a learner. Honest peers
are paced as real ones are: a client asks 100 times a second, an actor makes a rollout of 0.8 MB in 50 ms and pulls
weights of 3.5 MB after every second one. Attackers (`services.bench.attackers`) are processes of their own.
"""

import contextlib
import functools
import math
import multiprocessing
import os
import pathlib
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from congrasp.actors.process.link import ActorLink
from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.transport import urls
from congrasp.common.transport.keys import FLOWS
from congrasp.common.transport.ports import free_port, local_url, shifted
from congrasp.common.wire.codec import Message, encode
from congrasp.common.wire.schema import RolloutForm
from congrasp.learner.hub.hub import LearnerHub
from congrasp.learner.hub.staleness import StalenessManager
from congrasp.services.client.policy_client import PolicyClient
from congrasp.services.serve.load import Example, example_episode, processor_seconds, serving, wait_until_ready
from congrasp.services.train.command import untrained
from congrasp.services.train.presets import get_preset

_FORM = RolloutForm(steps=20, worlds=34, observation=534, action=26, half=True)
_RUN, _RUN_ID, _SCHEMA = "bench", "id", "schema"
_BATCH = 2
_WEIGHTS = 875_000  # float32
_PACE = 0.05  # seconds in which an actor makes a rollout
_PERIOD = 0.01  # seconds between two queries of a client
_SLOW = 400e3  # bytes a second of a slow actor's link
_START = 180.0  # seconds that processes may take to start
_SETTLE = 1.0  # seconds of an attack that are not measured
ON_SERVER = {"unread": 2, "silent": 1, "huge": 1}
"""Attacks on a policy server, and how many of each there are."""
ON_LEARNER = {"greedy": 1, "greedy-3": 3, "silent-learner": 1, "slow": 1, "slow-3": 3}
"""Attacks on a learner."""
_SERVER_FIGURES = {"p99 of a query, ms": 2, "answers a second": 0, "a new connection, ms": 0, "server, MB": 0}
_LEARNER_FIGURES = {"rollouts a second": 1, "updates a second": 1, "longest pause, s": 2}
"""What is measured, with the digits that are printed."""
_DEFINITION = (
    "Same cores: beside processes that only take as much processor time as the attackers did, and talk to nobody. "
    "Figures are medians."
)


Measure = Callable[[], Sequence[float]]
Attack = Callable[[], contextlib.AbstractContextManager[Sequence[subprocess.Popen | BaseProcess]]]
"""Begins an attack, and gives the attackers' processes."""


class Found(NamedTuple):
    """What honest peers had: medians, an entry for each figure that is measured."""

    alone: np.ndarray
    burnt: np.ndarray
    """Beside processes that do nothing but take as much processor time as the attackers did."""
    attacked: np.ndarray
    cores: float
    """Processor time that the attackers took, in cores."""


def bench_attacks(seconds: float, turns: int, kinds: Sequence[str]) -> None:
    """Prints a table of attacks, each beside the same honest work alone, and beside its processor time alone.

    Args:
      seconds: length of each measurement.
      turns: measurements of each, alternating; medians count.
      kinds: of `ON_SERVER` and `ON_LEARNER`; all of them if none is named.

    Raises:
      CongraspError: a kind is unknown; something did not start.
    """
    if unknown := set(kinds) - {*ON_SERVER, *ON_LEARNER}:
        known = ", ".join((*ON_SERVER, *ON_LEARNER))
        raise CongraspError(f"There is no attack '{min(unknown)}'.", f"Choose from: {known}.")
    console = Console(width=140)
    table = Table(title=f"{turns} x {seconds:g} s; load average {os.getloadavg()[0]:.1f}", caption=_DEFINITION)
    for column in ("beside", "honest", "alone", "same cores", "attacked", "ratio to alone", "to same cores", "cores"):
        table.add_column(column, justify="right" if table.columns[1:] else "left")
    for chosen, measured in ((ON_SERVER, _on_the_server), (ON_LEARNER, _on_the_learner)):
        wanted = [name for name in chosen if name in (kinds or chosen)]
        for name, what, found in measured(wanted, seconds, turns) if wanted else ():
            for i, (unit, digits) in enumerate(what.items()):
                figures = [f"{value[i]:.{digits}f}" for value in found[:3]]
                ratios = [f"{found.attacked[i] / max(value[i], 1e-9):.2f}" for value in (found.alone, found.burnt)]
                table.add_row(name, unit, *figures, *ratios, f"{found.cores:.2f}")
                console.print(f"{name}: {unit} {' / '.join(figures)}, ratios {' and '.join(ratios)}")
    console.print(table)


@contextlib.contextmanager
def attacked(
    kind: str, endpoint: str, run: str, query: pathlib.Path | None = None, count: int = 1
) -> Iterator[Sequence[subprocess.Popen]]:
    """Attackers of a kind, in processes of their own, while the block runs."""
    command = [sys.executable, "-m", "tests.benchmarks.attackers", kind, endpoint, run, str(query or "")]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) for _ in range(count)]
    try:
        for process in processes:
            assert process.stdout is not None
            if not process.stdout.readline():
                raise CongraspError(f"The attacker '{kind}' did not start.")
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _compare(measure: Measure, attack: Attack, turns: int) -> Found:
    """What is measured alone, beside an attack, and beside as much processor time, in turns."""
    alone, burnt, beside, cores = [], [], [], []
    for _ in range(turns):
        alone.append(measure())
        with attack() as processes:
            time.sleep(_SETTLE)
            began, spent = time.monotonic(), _processor_seconds(processes)
            beside.append(measure())
            cores.append((_processor_seconds(processes) - spent) / (time.monotonic() - began))
        with _burning(cores[-1]):
            time.sleep(_SETTLE)
            burnt.append(measure())
    medians = [np.median(values, axis=0) for values in (alone, burnt, beside)]
    return Found(medians[0], medians[1], medians[2], statistics.median(cores))


def _processor_seconds(processes: Sequence[subprocess.Popen | BaseProcess]) -> float:
    """Processor time that processes have taken."""
    return sum(processor_seconds(process.pid) for process in processes if process.pid)


@contextlib.contextmanager
def _burning(cores: float) -> Iterator[None]:
    """Processes that take so many cores in all while the block runs."""
    count = math.ceil(cores)
    with tempfile.TemporaryDirectory() as folder:
        share = pathlib.Path(folder, "share")
        share.write_text(str(max(cores, 0.001) / max(1, count)))
        with attacked("burn", "", "", share, count):
            yield


# --- a policy server and its clients ---


def _on_the_server(kinds: Sequence[str], seconds: float, turns: int) -> Iterator[tuple[str, dict[str, int], Found]]:
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

                def measure() -> list[float]:
                    times = _latencies(client, episode, seconds)
                    memory = psutil.Process(process).memory_info().rss / 1e6
                    return [_p99(times), len(times) / seconds, 1e3 * _connecting(endpoint), memory]

                for kind in kinds:
                    attack = functools.partial(
                        attacked, kind, endpoint, "policy", query if kind == "unread" else None, ON_SERVER[kind]
                    )
                    yield f"{ON_SERVER[kind]} x {kind}", _SERVER_FIGURES, _compare(measure, attack, turns)


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


def _on_the_learner(kinds: Sequence[str], seconds: float, turns: int) -> Iterator[tuple[str, dict[str, int], Found]]:
    """What an honest actor's rollouts and the run's updates come to beside each attack on the learner."""
    spawn = multiprocessing.get_context("spawn")
    endpoint, updates, rollouts, pause = local_url(), spawn.Value("i", 0), spawn.Value("i", 0), spawn.Value("d", 0.0)
    roles = (_learn, (endpoint, updates)), (_act, (endpoint, "honest", rollouts, pause))
    processes = [spawn.Process(target=role, args=arguments, daemon=True) for role, arguments in roles]
    try:
        for process in processes:
            process.start()
        _until_made(rollouts)

        def measure() -> list[float]:
            pause.value = 0.0
            before, began = (rollouts.value, updates.value), time.monotonic()
            time.sleep(seconds)
            spent = time.monotonic() - began
            return [(rollouts.value - before[0]) / spent, (updates.value - before[1]) / spent, pause.value]

        for kind in kinds:
            count = ON_LEARNER[kind]
            name = kind.partition("-")[0]
            attack: Attack = functools.partial(attacked, name, endpoint, _RUN, None, count)
            attack = functools.partial(_slow_actors, endpoint, count) if name == "slow" else attack
            yield f"{count} x {name}", _LEARNER_FIGURES, _compare(measure, attack, turns)
    finally:
        for process in processes:
            process.kill()
            process.join()


def _until_made(rollouts: Any) -> None:
    """Waits for an actor's first rollout."""
    deadline = time.monotonic() + _START
    while not rollouts.value:
        if time.monotonic() > deadline:
            raise CongraspError("The learner or the actor did not start.")
        time.sleep(0.1)


def _learn(endpoint: str, updates: Any) -> None:
    """A hub that is given new weights after every batch."""
    staleness = StalenessManager(1, _BATCH)
    sizes = {"observation": (_FORM.observation,), "value": ()}
    arrays: dict[str, Any] = {f"{kind}/{m}": np.zeros(size) for kind, size in sizes.items() for m in ("mean", "m2")}
    arrays |= {"observation/count": np.zeros(()), "value/count": np.zeros(())}
    meta = {"run_id": _RUN_ID, "schema": _SCHEMA, "hand": "human", "layout": [], "format": 1, "action_size": 26}
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
def _slow_actors(endpoint: str, count: int) -> Iterator[Sequence[BaseProcess]]:
    """Honest actors, each behind a link of 400 kB/s of its own, while the block runs; all have made a rollout."""
    spawn = multiprocessing.get_context("spawn")
    with contextlib.ExitStack() as stack:
        made = [(spawn.Value("i", 0), spawn.Value("d", 0.0)) for _ in range(count)]
        links = [stack.enter_context(throttled(endpoint, _SLOW)) for _ in made]
        processes = [
            spawn.Process(target=_act, args=(link, f"slow{number}", *made[number]), daemon=True)
            for number, link in enumerate(links)
        ]
        try:
            for process in processes:
                process.start()
            for rollouts, _ in made:
                _until_made(rollouts)
            yield processes
        finally:
            for process in processes:
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
