"""Processes of a training on this machine: learners and actors, which are restarted if they die."""

import pathlib
import shlex
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.runtime.stages import stage
from congrasp.common.transport import urls
from congrasp.common.transport.base import Subscription, Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import reachable_url
from congrasp.learner.run_directory import LOGS
from congrasp.services.ops.lifetime import CHILD_GRACE_S, Child, command, end_all, wait_for
from congrasp.services.train.accelerators import gpu_of_rank
from congrasp.services.train.launch import LaunchRecord, Plan, write_launch

MAX_RESTARTS = 5
"""Restarts of a process without an update of the run between them."""
START = "start of the learner's process"
"""Stage that begins with the start of the learners and actors."""
_BAD_INPUT_CODE = 2
_START_TIMEOUT_S = 120.0
_POLL_S = 0.25
Report = Callable[[dict[str, Any]], None]
"""Called several times a second with the learner's newest metrics, if any, and the number of live
actors.
"""


class ProcessDied(CongraspError):
    """A process of the run failed permanently.

    Attributes:
      what: its end and the cause, without the place of its log.
      log: its log.
    """

    def __init__(self, what: str, log: pathlib.Path):
        """Creates the error."""
        super().__init__(what, f"Its log is {log}.")
        self.what = what
        self.log = log


def train(
    run_dir: pathlib.Path,
    config: RunConfig,
    plan: Plan,
    *,
    stop: threading.Event,
    report: Report = lambda status: None,
    notify: Callable[[str], None] = lambda text: None,
) -> None:
    """Runs a prepared run directory to its end with one learner and its actor processes, or several
    of both.

    A process that dies is restarted (the learner from its last checkpoint), up to `MAX_RESTARTS`
    times each without an update of the run between them. If one of several ranks dies, the others
    end as well, and all are restarted.

    Args:
      run_dir: created by `learner.run_directory.create_run`; with checkpoints, the run resumes from
        the latest.
      config: the run's configuration.
      plan: its processes. Rank r listens on the ports after those of rank r - 1; without an
        endpoint, on free ones of the loopback interface.
      stop: drains everything within a few seconds when set.
      report: called with progress.
      notify: called with a message when a process is restarted, and with errors of the learner,
        such as a full disk.

    Raises:
      CongraspError: a process failed permanently; the message has the last line of its log.
    """
    record = LaunchRecord.of_plan(plan, config.name)
    certs = plan.launch.certs
    logs = run_dir / LOGS
    logs.mkdir(exist_ok=True)
    launch_file = write_launch(run_dir, record)
    learners = _learners(logs, record, launch_file, gpus=plan.gpus)
    actors = _actors(logs, record, launch_file)
    try:
        with stage(START):
            for child in (*learners, *actors):
                child.start()
            transport = _connect(reachable_url(record.endpoint), learners[0], stop, certs)
        if transport is not None:
            view = shlex.join(command("congrasp", "view", run_dir, certs=certs))
            notify(f"Watch it in the browser with: {view}")
            with transport:
                supervise(learners, actors, transport, config.name, stop, report, notify)
    finally:
        end_all([*learners, *actors])


def _learners(
    logs: pathlib.Path, record: LaunchRecord, launch_file: pathlib.Path, *, gpus: bool
) -> list[Child]:
    """Returns the learner processes by rank; with `gpus` each sees only the GPU of its rank."""
    learners: list[Child] = []
    for rank, name in enumerate(record.learner_names):
        arguments = command("learner", launch=launch_file, rank=rank)
        environment: dict[str, str] = {}
        if gpus:
            environment["CUDA_VISIBLE_DEVICES"] = gpu_of_rank(rank)
        learners.append(Child(name, arguments, logs / f"{name}.log", environment))
    return learners


def _actors(logs: pathlib.Path, record: LaunchRecord, launch_file: pathlib.Path) -> list[Child]:
    """Returns the actor processes of all ranks."""
    actors: list[Child] = []
    for name in record.actor_names:
        arguments = command("actor", launch=launch_file, id=name)
        actors.append(Child(name, arguments, logs / f"{name}.log"))
    return actors


def _connect(
    url: str, learner: Child, stop: threading.Event, certs: pathlib.Path | None
) -> Transport | None:
    """Connects to the learner once it listens; returns None if the run is stopped before."""
    deadline = time.monotonic() + _START_TIMEOUT_S
    while time.monotonic() < deadline and not stop.is_set():
        try:
            return urls.connect(url, "observer", certs=certs, wait=_POLL_S)
        except TransportError:
            if learner.code:
                break
    if stop.is_set():
        return None
    raise _died(learner, f"The learner did not start: {learner.cause()}")


def supervise(
    learners: Sequence[Child],
    actors: Sequence[Child],
    transport: Transport,
    run: str,
    stop: threading.Event,
    report: Report,
    notify: Callable[[str], None],
) -> None:
    """Restarts processes that die and reports progress, until rank 0 has finished or the run is
    stopped.

    Args:
      learners: started processes of the learner, by rank.
      actors: started processes of the actors.
      transport: transport that receives the learner's metrics and events.
      run: name of the run.
      stop: ends the supervision.
      report: called with the newest metrics and the number of live actors.
      notify: called with one line for each restart and each error of the learner.

    Raises:
      ProcessDied: a process died too often without progress.
    """
    metrics = transport.subscribe(Keys(run).learner_metrics, depth=16)
    events = transport.subscribe(Keys(run).log("event", "learner", "0"), depth=16)
    while not stop.is_set():
        if learners[0].code == 0:
            return
        latest = _latest(metrics)
        if latest:
            # A resumed learner writes a checkpoint after its first update, which the next one keeps
            for child in (*learners, *actors):
                child.deaths = 0
        if any(child.code for child in learners):
            _restart_learners(learners, stop, notify)
        for child in actors:
            if child.code:
                _restart_actor(child, notify)
        _forward_errors(events, notify)
        live_actors = sum(child.code is None for child in actors)
        # Without actor processes each learner has an actor inside.
        report({**latest, "actors": live_actors or len(learners)})


def _forward_errors(events: Subscription, notify: Callable[[str], None]) -> None:
    """Notifies the user of the learner's errors that have arrived."""
    while event := events.receive(0.0):
        _, message = event
        if message.meta.get("level") == "error":
            notify(str(message.meta.get("text")))


def _latest(metrics: Subscription) -> dict[str, Any]:
    """Waits a moment for metrics of the learner; returns the newest ones, empty if there are
    none.
    """
    newest = metrics.receive(_POLL_S)
    while newer := metrics.receive(0.0):
        newest = newer
    if newest is None:
        return {}
    _, message = newest
    return dict(message.meta)


def _restart_actor(child: Child, notify: Callable[[str], None]) -> None:
    """Restarts an actor that died, later each time."""
    if child.again_at == 0.0:
        _check_can_restart(child)
        notify(f"{child.death()} Restarting it.")
        child.again_at = time.monotonic() + child.pause
    if time.monotonic() >= child.again_at:
        child.restart()


def _restart_learners(
    learners: Sequence[Child], stop: threading.Event, notify: Callable[[str], None]
) -> None:
    """Restarts all ranks after one died; the others notice and end, or are terminated."""
    first = next(child for child in learners if child.code)
    wait_for([child.process for child in learners if child.process], CHILD_GRACE_S)
    # A rank that lost another one reports no more than that.
    failed = [child for child in learners if child.code and child.code != TransportError.exit_code]
    dead = failed or [first]
    deaths = " ".join(child.death() for child in dead)
    end_all(learners)
    for child in (*dead, *learners):
        _check_can_restart(child)
    restarted = "it" if len(learners) == 1 else "all ranks"
    notify(f"{deaths} Restarting {restarted}.")
    stop.wait(learners[0].pause)
    for child in learners:
        if not stop.is_set():
            child.restart()


def _check_can_restart(child: Child) -> None:
    """Raises a `ProcessDied` if a restart would end in the same way."""
    if child.code == _BAD_INPUT_CODE:
        raise _died(child, child.death())
    if child.deaths < MAX_RESTARTS:
        return
    cause = child.death()
    if child.deaths:
        cause += f" It died {child.deaths + 1} times without an update of the run between."
    raise _died(child, cause)


def _died(child: Child, what: str) -> ProcessDied:
    """Returns the error of a process that has ended."""
    assert child.log is not None, "all processes of a training have logs"
    return ProcessDied(what, child.log)
