"""A learner and its actors on this machine: starts them, keeps them alive, and ends them together."""

import contextlib
import dataclasses
import functools
import os
import pathlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from common.config import PhysicsName, RunConfig
from common.errors import CongraspError, TransportError
from common.journal import AUDIT
from common.transport.keys import FLOWS, Keys
from common.transport.memory import MemoryHub, MemoryTransport
from common.transport.security import Credentials
from common.transport.zenoh_transport import ZenohTransport
from services.access import credentials, nearby
from services.shutdown import GRACE, PARENT_VARIABLE, take_along

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
    process: subprocess.Popen[bytes] | None = None
    restarts: int = 0
    again_at: float = 0.0

    def start(self) -> None:
        """Starts it in a session of its own, so that Ctrl-C reaches the orchestrator alone; it dies with its parent."""
        environment = {**os.environ, PARENT_VARIABLE: str(os.getpid())}
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
    endpoint: str | None = None,
    certs: pathlib.Path | None = None,
    insecure: bool = False,
    report: Report = lambda status: None,
    notify: Callable[[str], None] = lambda text: None,
    metrics_port: int = 0,
) -> None:
    """Runs a prepared run directory to its end with one learner and `actors` actor processes.

    A process that dies is started again (the learner from its last checkpoint), up to `MAX_RESTARTS` times each.

    Args:
      run_dir: made by `learner.process.create_run`; with checkpoints, the run goes on from the latest.
      config: the run's configuration.
      actors: number of actor processes.
      physics: engine of the actors.
      stop: drains everything within a few seconds when set.
      endpoint: where the learner listens; a free port of the loopback interface by default.
      certs: an authority's folder, for mutual TLS.
      insecure: listen beyond loopback without certificates.
      report: shows progress.
      notify: told in words when something is restarted.
      metrics_port: port of the learner's Prometheus endpoint on the loopback interface; 0 for none.

    Raises:
      CongraspError: a process failed for good; its last words are in the message.
    """
    endpoint = endpoint or f"tcp/127.0.0.1:{free_port()}"
    connect, secure = nearby(endpoint), [] if certs is None else ["--certs", str(certs)]
    listen = [endpoint, *secure, *(["--insecure"] if insecure else [])]
    logs = run_dir / "logs"
    logs.mkdir(exist_ok=True)
    threads = max(1, (os.cpu_count() or 1) // max(1, actors))
    arguments = ["learner", "--run-dir", str(run_dir), "--resume", "--listen", *listen]
    learner = Child("learner", [*arguments, "--metrics-port", str(metrics_port)], logs / "learner.log")
    children = [learner]
    for number in range(actors):
        name = f"actor-{number}"
        arguments = ["actor", "--connect", connect, "--run", config.name, "--id", name, "--physics", physics, *secure]
        arguments += ["--audit", str(run_dir / AUDIT / f"{name}.jsonl")]
        children.append(Child(name, [*arguments, "--threads", str(threads)], logs / f"{name}.log"))
    try:
        for child in children:
            child.start()
        transport = _connected(connect, learner, stop, credentials(certs, "observer"))
        if transport is not None:
            with transport:
                _supervise(children, transport, config.name, stop, report, notify)
    finally:
        end_all(children)


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
    children: Sequence[Child],
    transport: ZenohTransport,
    run: str,
    stop: threading.Event,
    report: Report,
    notify: Callable[[str], None],
) -> None:
    learner = children[0]
    metrics = transport.subscribe(Keys(run).learner_metrics, depth=16)
    while not stop.is_set():
        for child in children:
            assert child.process is not None
            code = child.process.poll()
            if code is None or (child is not learner and code == 0):
                continue
            if child is learner and code == 0:
                return
            if code == _BAD_INPUT or child.restarts >= MAX_RESTARTS:
                raise CongraspError(f"The {child.name} failed: {child.last_words()}", f"Its log is {child.log}.")
            if child.again_at == 0.0:
                notify(f"The {child.name} died (exit code {code}); starting it again.")
                child.again_at = time.monotonic() + min(2.0**child.restarts, 15.0) - 1.0
            if time.monotonic() >= child.again_at:
                child.restarts += 1
                child.again_at = 0.0
                child.start()
        received = metrics.receive(_POLL)
        alive = sum(child is not learner and child.process.poll() is None for child in children if child.process)
        report({**(received[1].meta if received else {}), "actors": alive})


def end_all(children: Sequence[Child]) -> None:
    """SIGTERM to all, and SIGKILL to those that have not drained within `CHILD_GRACE` seconds."""
    running = [child.process for child in children if child.process is not None and child.process.poll() is None]
    for process in running:
        process.terminate()
    deadline = time.monotonic() + CHILD_GRACE
    for process in running:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def train_in_process(
    run_dir: pathlib.Path,
    config: RunConfig,
    *,
    physics: PhysicsName,
    stop: threading.Event,
    resume: bool,
    on_update: Callable[[dict[str, float]], None] = lambda values: None,
    metrics_port: int = 0,
) -> None:
    """The same learner and one actor in this process, over the in-memory transport.

    The two share their processors: to act under old weights while the learner updates would gain nothing. So updates
    are on-policy, whatever `max_staleness` says.
    """
    from actors.process import run_actor
    from common.logs.recorder import Recorder
    from learner.process import LOGS, run_learner
    from services.metrics import LearnerMetrics, exposed
    from services.status import ask

    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, max_staleness=0))
    broker = MemoryHub()
    failures: list[BaseException] = []
    ended = threading.Event()

    def act() -> None:
        try:
            with MemoryTransport(broker) as transport:
                run_actor(
                    transport,
                    run=config.name,
                    actor="actor-0",
                    stop=ended,
                    physics=physics,
                    threads=os.cpu_count() or 1,
                    keep=False,
                )
        except BaseException as error:
            failures.append(error)
            stop.set()

    actor = threading.Thread(target=act, name="actor", daemon=True)
    with MemoryTransport(broker) as transport:
        recorder = Recorder(transport, config.name, run_dir / LOGS)
        metrics = LearnerMetrics(functools.partial(ask, transport, config.name))

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
                    transport,
                    stop_event=stop,
                    resume=resume,
                    audit=False,
                    recorder=recorder,
                    on_update=updated,
                )
        finally:
            ended.set()
            actor_started.cancel()
            if actor.ident is not None:
                actor.join(GRACE)
    if failures:
        raise failures[0]


def free_port() -> int:
    """A port of the loopback interface that is free together with those after it that a transport uses."""
    while True:
        with contextlib.ExitStack() as stack:
            probes = [stack.enter_context(socket.socket()) for _ in FLOWS]
            probes[0].bind(("127.0.0.1", 0))
            port = probes[0].getsockname()[1]
            try:
                for i, probe in enumerate(probes[1:], 1):
                    probe.bind(("127.0.0.1", port + i))
            except (OSError, OverflowError):
                continue
            return port
