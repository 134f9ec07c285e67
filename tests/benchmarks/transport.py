"""Throughput of the wire: rollouts into one learner beside bare Zenoh and bare PUSH/PULL sockets,
weights out of it.

Everything but the policy and the physics is the real thing: the hub with its checks, admission and
journals, and links with theirs, in processes of their own over the loopback interface.
"""

import contextlib
import functools
import importlib.util
import json
import math
import multiprocessing
import pathlib
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from zenoh import CongestionControl
from zenoh.handlers import FifoChannel

from congrasp.actors.link import ActorLink, RunFinished
from congrasp.common.errors import CongraspError
from congrasp.common.io.journal import AUDIT, Journal
from congrasp.common.transport import urls
from congrasp.common.transport.ports import free_port, local_url
from congrasp.common.wire.codec import Message, encode
from congrasp.common.wire.messages import RolloutForm
from congrasp.learner.hub.admission import Admission
from congrasp.learner.hub.staleness import StalenessManager
from congrasp.learner.hub.task_ranges import Ranges
from congrasp.learner.hub.used_rollouts import AuditLog
from congrasp.learner.hub.write_ahead import FOLDER, WriteAheadLog
from tests.bare_zenoh import bare_session
from tests.rollouts import SCHEMA, Learner, bundle, learner_hub

_FORM = RolloutForm(steps=20, worlds=340, observation=534, action=26, half=True)
"""Of the human hand's rollouts; these have 8.0 MB."""
_RUN = "bench"
_BATCH = 4
_WARM_UP = 1.0  # seconds that are not counted
_START = 30.0  # seconds that processes may take to start
_INTERVAL = 0.25  # seconds between two versions of the weights
_WEIGHTS_MB = 4.0


def transport(
    senders: int = 1, seconds: float = 5.0, repeats: int = 3, actors: int = 4, versions: int = 100
) -> int:
    """Rollouts of 8 MB into one learner, bare Zenoh and bare PUSH/PULL (pyzmq); 4 MB of weights to
    its actors.

    Args:
      senders: Actor processes that send rollouts.
      seconds: Length of one measurement.
      repeats: Measurements of each kind of ingest, alternating; medians are printed.
      actors: Actor processes that wait for weights.
      versions: Publications of weights, four a second.

    Examples:
      python -m tests.benchmarks transport
      python -m tests.benchmarks transport --senders 4
    """
    ours, on_disk, queries, bare = measure_ingest(senders, seconds, repeats)
    sockets = (
        "pyzmq is not installed"
        if math.isnan(bare)
        else f"{bare:.0f} MB/s, ratio {ours / bare:.2f}"
    )
    print(
        f"rollouts of 8 MB: {ours:.0f} MB/s into the learner\n"
        f"bare Zenoh queries: {queries:.0f} MB/s, ratio {ours / queries:.2f}\n"
        f"bare PUSH/PULL: {sockets}\n"
        f"with all of them on disk first, and a checkpoint after each update: {on_disk:.0f} MB/s "
        f"(ratio {on_disk / ours:.2f})",
        flush=True,
    )
    delays = measure_weights(actors, versions, _WEIGHTS_MB)
    p50, p99 = (1e3 * delays[int(share * (len(delays) - 1))] for share in (0.5, 0.99))
    print(
        f"weights of {_WEIGHTS_MB:g} MB to {actors} actors: "
        f"p50 {p50:.0f} ms, p99 {p99:.0f} ms, longest {1e3 * delays[-1]:.0f} ms"
    )
    return 0


def measure_ingest(senders: int, seconds: float, repeats: int) -> list[float]:
    """MB/s into a learner, into one that writes all rollouts to its disk first, by bare Zenoh
    queries and by bare sockets (NaN where pyzmq is not installed): medians of `repeats` alternating
    measurements."""
    ways = (
        _through_the_hub,
        functools.partial(_through_the_hub, write_ahead=True),
        _through_queries,
        _through_sockets,
    )
    rates = []
    for _ in range(repeats):
        rates.append([way(senders, seconds) for way in ways])
    return [statistics.median(each) for each in zip(*rates, strict=True)]


def measure_weights(actors: int, versions: int, megabytes: float) -> list[float]:
    """Seconds from the publication of weights until each actor holds them, for every actor and
    version, sorted.

    Versions that an actor never held, since a newer one was there, count from their own publication
    as well.
    """
    parameters = int(megabytes * 250_000)
    with (
        tempfile.TemporaryDirectory() as name,
        _learner(folder := pathlib.Path(name)) as ((hub, _), endpoint),
    ):
        published: list[float] = []

        def publish() -> None:
            published.append(time.monotonic())
            hub.publish_weights(
                bundle(len(published) - 1, form=_FORM, parameters=parameters), len(published) - 1
            )

        publish()
        with _processes(actors, _pull, endpoint, folder):
            _until(
                lambda: all(_held(folder, i) for i in range(actors)), "The actors got no weights."
            )
            for _ in range(versions):
                time.sleep(_INTERVAL)
                publish()
            last = len(published) - 1
            _until(
                lambda: all(_held(folder, i)[-1][0] == last for i in range(actors)),
                "The last weights never came.",
            )
            hub.finish()
        delays = []
        for i in range(actors):
            held = iter(_held(folder, i)[1:])
            version, when = next(held)
            for number in range(1, last + 1):
                while version < number:
                    version, when = next(held)
                delays.append(when - published[number])
        return sorted(delays)


@contextlib.contextmanager
def _learner(folder: pathlib.Path, *, write_ahead: bool = False) -> Iterator[tuple[Learner, str]]:
    """A learner's hub without a learner, and where it listens."""
    endpoint = local_url()
    ranges = Ranges(np.full(_FORM.observation, 100.0), 100.0, 100.0, {})
    with urls.listen(endpoint, "learner") as transport:
        bench = learner_hub(
            transport,
            _RUN,
            form=_FORM,
            staleness=StalenessManager(1, _BATCH),
            audit=AuditLog(folder, "0"),
            log=WriteAheadLog(folder / FOLDER, 1, write=write_ahead),
            admission=Admission(lambda: ranges),
        )
        yield bench, endpoint
        bench.rollouts.close()


def _rollout() -> Message:
    """A rollout that passes the checks."""
    rng = np.random.default_rng(0)
    arrays = {
        name: rng.normal(size=zeros.shape).astype(zeros.dtype)
        for name, zeros in _FORM.zeros().items()
    }
    return Message(arrays, {"version": 0, "schema": SCHEMA, "steps": _FORM.steps * _FORM.worlds})


def _through_the_hub(senders: int, seconds: float, *, write_ahead: bool = False) -> float:
    """MB/s through the learner's hub; with `write_ahead` there is a checkpoint (of nothing) after
    each update.
    """
    size = len(encode(_rollout()))
    with (
        tempfile.TemporaryDirectory() as name,
        _learner(folder := pathlib.Path(name), write_ahead=write_ahead) as (
            (hub, rollouts),
            endpoint,
        ),
    ):
        hub.publish_weights(bundle(0, form=_FORM), 0)
        version = 0

        def receive() -> int:
            nonlocal version
            batch = rollouts.next_batch(_BATCH, 0.5)
            if batch is None:
                return 0
            version += 1
            hub.publish_weights(bundle(version, form=_FORM), version)
            if write_ahead:
                rollouts.durable()
                rollouts.note_saved()
            return size * len(batch)

        with _processes(senders, _upload, endpoint, folder):
            rate = _rate(receive, seconds)
            hub.finish()
        return rate


def _through_queries(senders: int, seconds: float) -> float:
    """MB/s through bare Zenoh queries."""
    endpoint = f"tcp/127.0.0.1:{free_port(1)}"
    with bare_session("peer", listen=endpoint) as session:
        queryable = session.declare_queryable(_RUN, FifoChannel(8))

        def receive() -> int:
            query = queryable.handler.try_recv()
            if query is None:
                time.sleep(0.0002)
                return 0
            with query:
                size = len(query.payload.to_bytes()) if query.payload else 0
                query.reply(_RUN, b"accepted")
            return size

        with _processes(senders, _ask, endpoint, pathlib.Path()):
            return _rate(receive, seconds)


def _through_sockets(senders: int, seconds: float) -> float:
    """MB/s through bare PUSH/PULL sockets."""
    if importlib.util.find_spec("zmq") is None:
        return math.nan
    import zmq

    with zmq.Context() as context, context.socket(zmq.PULL) as socket:
        socket.rcvhwm = 8
        socket.rcvtimeo = 500
        port = socket.bind_to_random_port("tcp://127.0.0.1")

        def receive() -> int:
            try:
                return len(socket.recv(copy=False).buffer)
            except zmq.Again:
                return 0

        with _processes(senders, _push, f"tcp://127.0.0.1:{port}", pathlib.Path()):
            return _rate(receive, seconds)


def _rate(receive: Callable[[], int], seconds: float) -> float:
    """MB/s that a function receives, after a while in which it is not counted."""
    _until(lambda: receive() > 0, "Nothing was received.")
    received = 0
    began = time.monotonic() + _WARM_UP
    while (now := time.monotonic()) < began + seconds:
        size = receive()
        received += size if now >= began else 0
    return received / (time.monotonic() - began) / 1e6


def _until(condition: Callable[[], bool], message: str) -> None:
    """Waits for a condition; a CongraspError if it takes too long."""
    deadline = time.monotonic() + _START
    while not condition():
        if time.monotonic() > deadline:
            raise CongraspError(
                f"{message[:-1]} within {_START:g} s.", "Is the machine busy otherwise?"
            )
        time.sleep(0.01)


@contextlib.contextmanager
def _processes(
    count: int, role: Callable[[str, pathlib.Path, int], None], *arguments: Any
) -> Iterator[None]:
    """Runs a function of this module in processes of their own, which are killed at the end of the
    block.
    """
    spawn = multiprocessing.get_context("spawn")
    processes = [
        spawn.Process(target=role, args=(*arguments, i), daemon=True) for i in range(count)
    ]
    try:
        for process in processes:
            process.start()
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


@contextlib.contextmanager
def _link(endpoint: str, folder: pathlib.Path, number: int) -> Iterator[ActorLink]:
    """An actor's link to the learner."""
    path = folder / AUDIT / f"a{number}.jsonl"

    def journal(run_id: str) -> Journal:
        return Journal(path)

    with (
        urls.connect(endpoint, "actor") as transport,
        ActorLink(transport, _RUN, f"a{number}", window=2, journal=journal) as link,
        contextlib.suppress(RunFinished),
    ):
        link.config(_START)
        yield link


def _upload(endpoint: str, folder: pathlib.Path, number: int) -> None:
    """An actor that makes the same rollout again and again, in no time."""
    message = _rollout()
    with _link(endpoint, folder, number) as link:
        while True:
            if ticket := link.acquire_ticket(1.0):
                link.upload(
                    Message(message.arrays, {**message.meta, "version": ticket.version}), ticket
                )


def _ask(endpoint: str, _: pathlib.Path, number: int) -> None:
    """Two threads, as an actor has, each with one query on its way."""
    data = encode(_rollout())

    def send() -> None:
        while True:
            for _reply in session.get(
                _RUN, FifoChannel(4), payload=data, congestion_control=CongestionControl.BLOCK
            ):
                pass

    with bare_session("client", connect=endpoint) as session, ThreadPoolExecutor(2) as pool:
        for sending in [pool.submit(send) for _ in range(2)]:
            sending.result()


def _push(address: str, _: pathlib.Path, number: int) -> None:
    """Sends the same rollout again and again through a socket."""
    import zmq

    data = encode(_rollout())
    with zmq.Context() as context, context.socket(zmq.PUSH) as socket:
        socket.sndhwm = 2
        socket.connect(address)
        while True:
            socket.send(data, copy=False)


def _pull(endpoint: str, folder: pathlib.Path, number: int) -> None:
    """An actor that takes new weights at once, and writes down when it held them."""
    version = -1
    with (
        _link(endpoint, folder, number) as link,
        _file(folder, number).open("w", buffering=1) as log,
    ):
        while True:
            message = link.weights(version)
            if message is not None:
                version = message.meta["version"]
                log.write(json.dumps([version, time.monotonic()]) + "\n")
            else:
                link.acquire_ticket(0.0)  # notices the end of the run
                time.sleep(0.001)


def _held(folder: pathlib.Path, number: int) -> list[tuple[int, float]]:
    """Versions that an actor held, and since when."""
    path = _file(folder, number)
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return [tuple(json.loads(line)) for line in lines if line.endswith("\n")]


def _file(folder: pathlib.Path, number: int) -> pathlib.Path:
    """Where an actor writes them down."""
    return folder / f"weights.{number}.jsonl"
