"""A learner and its actors on this machine: starts them, keeps them alive, and ends them together."""

import contextlib
import dataclasses
import functools
import os
import pathlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax

from actors.physics import resolve_physics
from common.config import Board, PhysicsName, RunConfig
from common.errors import CongraspError, TransportError
from common.journal import AUDIT
from common.transport.base import Transport
from common.transport.keys import FLOWS, Keys
from common.transport.memory import MemoryHub, MemoryTransport
from common.transport.pair import PairTransport
from common.transport.ports import free_port
from common.transport.security import Credentials
from common.transport.zenoh_transport import ZenohTransport, shifted
from services.ops.access import credentials, nearby
from services.ops.shutdown import GRACE, PARENT_VARIABLE, take_along

if TYPE_CHECKING:
    from learner.ranks import Ranks

MAX_RESTARTS = 5
CHILD_GRACE = 2.0
"""Seconds in which a child may drain; then this process has time to end it before it must end itself (`GRACE`)."""
_BAD_INPUT = 2
_POLL = 0.25
Report = Callable[[dict[str, Any]], None]
"""Given the learner's newest metrics, where there are any, and the number of actors alive, some times a second."""


@dataclasses.dataclass
class Child:
    """A process of the run."""

    name: str
    arguments: list[str]
    log: pathlib.Path
    environment: dict[str, str] = dataclasses.field(default_factory=dict)
    process: subprocess.Popen[bytes] | None = None
    restarts: int = 0
    again_at: float = 0.0

    def start(self) -> None:
        """Starts it in a session of its own, so that Ctrl-C reaches the orchestrator alone; it dies with its parent."""
        environment = {**os.environ, **self.environment, PARENT_VARIABLE: str(os.getpid())}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "services.cli.main", *self.arguments],
                stdout=log,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env=environment,
                start_new_session=True,
            )
        take_along(self.process)

    def last_words(self) -> str:
        """The last line of its log."""
        lines = self.log.read_text(errors="replace").strip().splitlines() if self.log.exists() else []
        return lines[-1].removeprefix("congrasp: error: ") if lines else "it said nothing"


def train(
    run_dir: pathlib.Path,
    config: RunConfig,
    *,
    actors: int,
    physics: PhysicsName,
    stop: threading.Event,
    ranks: int = 1,
    gpus: bool = False,
    endpoint: str | None = None,
    certs: pathlib.Path | None = None,
    insecure: bool = False,
    report: Report = lambda status: None,
    notify: Callable[[str], None] = lambda text: None,
    boards: Sequence[Board] = (),
    metrics_port: int = 0,
) -> None:
    """Runs a prepared run directory to its end with one learner and `actors` actor processes, or several of both.

    A process that dies is started again (the learner from its last checkpoint), up to `MAX_RESTARTS` times each. When
    one of several ranks dies, the others end, too, and all are started again.

    Args:
      run_dir: made by `learner.run_directory.create_run`; with checkpoints, the run goes on from the latest.
      config: the run's configuration.
      actors: number of actor processes of each rank; with none, an actor lives in each rank's process.
      physics: engine of the actors.
      stop: drains everything within a few seconds when set.
      ranks: learner processes that train together.
      gpus: each rank sees one GPU, the others hidden from it.
      endpoint: where the learner listens (rank r on the ports after those of rank r - 1); free ports of the loopback
        interface by default.
      certs: an authority's folder, for mutual TLS.
      insecure: listen beyond loopback without certificates.
      report: shows progress.
      notify: told in words when something is restarted.
      boards: where rank 0's figures are shown, too.
      metrics_port: port of rank 0's Prometheus endpoint on the loopback interface; 0 for none.

    Raises:
      CongraspError: a process failed for good; its last words are in the message.
    """
    # Those of the ranks, and one pair by which they find each other.
    endpoint = endpoint or f"tcp/127.0.0.1:{free_port(ranks * len(FLOWS) + 2)}"
    connect, secure = nearby(endpoint), [] if certs is None else ["--certs", str(certs)]
    listen = [endpoint, *secure, *(["--insecure"] if insecure else [])]
    coordinator = shifted(connect, ranks * len(FLOWS)).partition("/")[2]
    logs = run_dir / "logs"
    logs.mkdir(exist_ok=True)
    threads = max(1, (os.cpu_count() or 1) // max(1, ranks * actors))
    learners, children = [], []
    for rank in range(ranks):
        environment = {"CUDA_VISIBLE_DEVICES": _gpu(rank)} if gpus else {}
        name = f"rank-{rank}" if ranks > 1 else "learner"
        arguments = ["learner", "--run-dir", str(run_dir), "--resume", "--listen", *listen]
        if ranks > 1 or not actors:
            arguments += ["--rank", str(rank), "--ranks", str(ranks), "--coordinator", coordinator]
            arguments += [] if actors else ["--inside"]
        if rank == 0:
            arguments += ["--metrics-port", str(metrics_port), "--boards", *boards]
        learners.append(Child(name, arguments, logs / f"{name}.log", environment))
        where = shifted(connect, rank * len(FLOWS))
        for number in range(rank * actors, (rank + 1) * actors):
            name = f"actor-{number}"
            arguments = ["actor", "--connect", where, "--run", config.name, "--id", name, "--physics", physics]
            arguments += secure
            arguments += ["--audit", str(run_dir / AUDIT / f"{name}.jsonl")]
            arguments += ["--threads", str(threads), "--patience", "60" if ranks == 1 else "300"]
            children.append(Child(name, arguments, logs / f"{name}.log", environment))
    try:
        for child in (*learners, *children):
            child.start()
        transport = _connected(connect, learners[0], stop, credentials(certs, "observer"))
        if transport is not None:
            watch = [f"congrasp view --connect {connect} --run {config.name} --recordings {run_dir}", *secure]
            notify(f"Watch it in the browser with: {' '.join(watch)}")
            with transport:
                _supervise(learners, children, transport, config.name, stop, report, notify)
    finally:
        end_all([*learners, *children])


def leave_gpus_to(ranks: int) -> bool:
    """Whether each rank has a GPU of its own; this process then does without, so that the memory of all is theirs.

    A process of its own looks, since one that has seen a GPU holds memory of it.

    Raises:
      CongraspError: there are GPUs, but not one for each rank.
    """
    code = "import jax; print(jax.default_backend(), jax.local_device_count())"
    environment = {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    try:
        seen = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120.0
        )
        backend, count = seen.stdout.split()
    except (subprocess.TimeoutExpired, ValueError):
        raise CongraspError("JAX does not start here.", "Look at 'congrasp doctor'.") from None
    if backend == "cpu":
        return False
    if int(count) < ranks:
        raise CongraspError(f"{ranks} ranks need {ranks} GPUs, and JAX sees {count}.", "Name fewer with --ranks.")
    jax.config.update("jax_platforms", "cpu")
    return True


def engine_of(name: PhysicsName, gpus: bool) -> PhysicsName:
    """What `auto` is for the ranks, where this process may see no GPU although they do."""
    if gpus:
        return "warp" if name == "auto" else name
    return resolve_physics(name)


def _gpu(rank: int) -> str:
    """What names a rank's GPU to CUDA, among those that this process may use."""
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    return visible[rank] if visible else str(rank)


def _connected(
    endpoint: str, learner: Child, stop: threading.Event, secrets: Credentials | None
) -> ZenohTransport | None:
    """A connection to the learner once it listens; None if the run is stopped before."""
    deadline = time.monotonic() + 120.0
    while time.monotonic() < deadline and not stop.is_set():
        try:
            return ZenohTransport(connect=[endpoint], wait=_POLL, credentials=secrets)
        except TransportError:
            assert learner.process is not None
            if learner.process.poll() not in (None, 0):
                break
    if stop.is_set():
        return None
    raise CongraspError(f"The learner did not start: {learner.last_words()}", f"Its log is {learner.log}.")


def _supervise(
    learners: Sequence[Child],
    actors: Sequence[Child],
    transport: ZenohTransport,
    run: str,
    stop: threading.Event,
    report: Report,
    notify: Callable[[str], None],
) -> None:
    metrics = transport.subscribe(Keys(run).learner_metrics, depth=16)
    while not stop.is_set():
        codes = {child.name: child.process.poll() for child in learners if child.process}
        if codes[learners[0].name] == 0:
            return
        if any(codes.values()):
            _restart_learners(learners, stop, notify)
        for child in actors:
            assert child.process is not None
            if code := child.process.poll():
                _check_can_go_on(child, code)
                if child.again_at == 0.0:
                    notify(f"The {child.name} died (exit code {code}); starting it again.")
                    child.again_at = time.monotonic() + min(2.0**child.restarts, 15.0) - 1.0
                if time.monotonic() >= child.again_at:
                    child.restarts += 1
                    child.again_at = 0.0
                    child.start()
        received = metrics.receive(_POLL)
        alive = sum(child.process.poll() is None for child in actors if child.process) or len(learners)
        report({**(received[1].meta if received else {}), "actors": alive})


def _restart_learners(learners: Sequence[Child], stop: threading.Event, notify: Callable[[str], None]) -> None:
    """Starts all ranks again after one died: the others notice it and end, or are made to."""
    dead = next(child for child in learners if child.process and child.process.poll())
    assert dead.process is not None
    died = f"The {dead.name} died (exit code {dead.process.poll()})"
    _wait_for([child.process for child in learners if child.process], CHILD_GRACE)
    end_all(learners)
    for child in learners:
        assert child.process is not None
        _check_can_go_on(child, child.process.poll() or 0)
    notify(f"{died}; starting it again." if len(learners) == 1 else f"{died}; starting all ranks again.")
    stop.wait(min(2.0 ** learners[0].restarts, 15.0) - 1.0)
    for child in learners:
        child.restarts += 1
        if not stop.is_set():
            child.start()


def _check_can_go_on(child: Child, code: int) -> None:
    if code == _BAD_INPUT or child.restarts >= MAX_RESTARTS:
        raise CongraspError(f"The {child.name} failed: {child.last_words()}", f"Its log is {child.log}.")


def _wait_for(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> None:
    deadline = time.monotonic() + seconds
    for process in processes:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, deadline - time.monotonic()))


def end_all(children: Sequence[Child]) -> None:
    """SIGTERM to all, and SIGKILL to those that have not drained within `CHILD_GRACE` seconds."""
    running = [child.process for child in children if child.process is not None and child.process.poll() is None]
    for process in running:
        process.terminate()
    _wait_for(running, CHILD_GRACE)
    for process in running:
        if process.poll() is None:
            process.kill()
            process.wait()


def train_in_process(
    run_dir: pathlib.Path,
    config: RunConfig,
    *,
    physics: PhysicsName,
    stop: threading.Event,
    resume: bool,
    ranks: "Ranks | None" = None,
    wire: Transport | None = None,
    on_update: Callable[[dict[str, float]], None] = lambda values: None,
    on_event: Callable[[str, str], None] = lambda level, text: None,
    boards: Sequence[Board] = (),
    metrics_port: int = 0,
) -> None:
    """The same learner and one actor in this process, over the in-memory transport.

    The two share their processors: to act under old weights while the learner updates would gain nothing. So updates
    are on-policy, whatever `max_staleness` says.

    Args:
      run_dir: see `run_learner`, as `config`, `resume`, `ranks`, `on_update` and `on_event`.
      physics: engine of the actor.
      stop: ends training.
      wire: a transport that listens, where others may ask how things stand, and send rollouts, too.
      boards: where the figures are shown, too.
      metrics_port: port of a Prometheus endpoint on the loopback interface; 0 for none.
    """
    from actors.process import run_actor
    from learner.process import run_learner
    from learner.ranks import ROUND_SECONDS
    from services.ops.metrics import LearnerMetrics, exposed
    from services.ops.status import ask
    from services.train.metric_writers import recorded

    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, max_staleness=0))
    broker = MemoryHub()
    failures: list[BaseException] = []
    ended = threading.Event()
    rank = 0 if ranks is None else ranks.rank

    def act() -> None:
        try:
            with MemoryTransport(broker) as transport:
                run_actor(
                    transport,
                    run=config.name,
                    actor=f"actor-{rank}",
                    stop=ended,
                    physics=physics,
                    threads=os.cpu_count() or 1,
                    patience=ROUND_SECONDS,
                    keep=False,
                )
        except BaseException as error:
            failures.append(error)
            stop.set()

    actor = threading.Thread(target=act, name="actor", daemon=True)
    with MemoryTransport(broker) as memory:
        recorder = recorded(memory, config, run_dir, boards) if rank == 0 else None
        metrics = LearnerMetrics(functools.partial(ask, memory, config.name))

        def updated(values: dict[str, float]) -> None:
            metrics.update(values)
            on_update(values)

        actor_started = threading.Timer(0.5, actor.start)
        actor_started.start()
        try:
            with exposed(metrics_port, "127.0.0.1", metrics) if metrics_port else contextlib.nullcontext():
                run_learner(
                    run_dir,
                    config,
                    memory if wire is None else PairTransport(memory, wire),
                    stop_event=stop,
                    resume=resume,
                    ranks=ranks,
                    audit=False,
                    recorder=recorder,
                    on_update=updated,
                    on_event=on_event,
                )
        finally:
            ended.set()
            actor_started.cancel()
            if actor.ident is not None:
                actor.join(GRACE)
    if failures:
        raise failures[0]
