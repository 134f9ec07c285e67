"""A learner and its actors as processes of this machine: starts, restarts and ends them."""

import os
import pathlib
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from congrasp.actors.harvest import references_file
from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.io.journal import AUDIT
from congrasp.common.runtime.parallel import cores
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import local_url, rank_url, reachable_url
from congrasp.learner.run_directory import LOGS
from congrasp.services.ops.children import CHILD_GRACE, Child, command, end_all, wait_for
from congrasp.services.train.launch import Plan

MAX_RESTARTS = 5
_BAD_INPUT = 2
_START_SECONDS, _POLL = 120.0, 0.25
Report = Callable[[dict[str, Any]], None]
"""Called several times a second with the learner's newest metrics, if any, and the number of live actors."""


def train(
    run_dir: pathlib.Path,
    config: RunConfig,
    plan: Plan,
    *,
    stop: threading.Event,
    report: Report = lambda status: None,
    notify: Callable[[str], None] = lambda text: None,
) -> None:
    """Runs a prepared run directory to its end with one learner and its actor processes, or several of both.

    A process that dies is restarted (the learner from its last checkpoint), up to `MAX_RESTARTS` times each. If one of
    several ranks dies, the others end as well, and all are restarted.

    Args:
      run_dir: created by `learner.run_directory.create_run`; with checkpoints, the run resumes from the latest.
      config: the run's configuration.
      plan: its processes. Rank r listens on the ports after those of rank r - 1; without an endpoint, on free ones of
        the loopback interface.
      stop: drains everything within a few seconds when set.
      report: called with progress.
      notify: called with a message when a process is restarted, and with errors of the learner, such as a full disk.

    Raises:
      CongraspError: a process failed permanently; the message has the last line of its log.
    """
    launch = plan.launch
    endpoint = launch.listen or local_url(launch.ranks + 1)  # one more for the ports through which the ranks join
    logs = run_dir / LOGS
    logs.mkdir(exist_ok=True)
    learners, actors = _learners(run_dir, plan, endpoint), _actors(run_dir, plan, config.name, endpoint)
    try:
        for child in (*learners, *actors):
            child.start()
        transport = _connect(reachable_url(endpoint), learners[0], stop, launch.certs)
        if transport is not None:
            shown = " ".join(command("congrasp", "view", run_dir, certs=launch.certs))
            notify(f"Watch it in the browser with: {shown}")
            with transport:
                _supervise(learners, actors, transport, config.name, stop, report, notify)
    finally:
        end_all([*learners, *actors])


def _learners(run_dir: pathlib.Path, plan: Plan, endpoint: str) -> list[Child]:
    """Returns the learner processes; rank 0 listens at the endpoint, and has the metrics."""
    launch, inside, found = plan.launch, not plan.actors, []
    coordinator = rank_url(reachable_url(endpoint), launch.ranks).partition("/")[2]
    for rank in range(launch.ranks):
        name = f"rank-{rank}" if launch.ranks > 1 else "learner"
        arguments = command("learner", run_dir=run_dir, resume=True, listen=endpoint, certs=launch.certs)
        arguments += command(insecure=launch.insecure, inside=inside)
        if launch.ranks > 1:
            arguments += command(rank=rank, ranks=launch.ranks, coordinator=coordinator)
        if rank == 0:
            arguments += command(metrics_port=launch.metrics_port, metric_writers=launch.metric_writers)
        environment = {"CUDA_VISIBLE_DEVICES": _gpu(rank)} if plan.gpus else {}
        found.append(Child(name, arguments, run_dir / LOGS / f"{name}.log", environment))
    return found


def _actors(run_dir: pathlib.Path, plan: Plan, run: str, endpoint: str) -> list[Child]:
    """Returns the actor processes of all ranks; rank 0 listens at the endpoint."""
    launch, found = plan.launch, []
    threads = max(1, cores() // max(1, launch.ranks * plan.actors))
    patience = 60 if launch.ranks == 1 else 300
    for number in range(launch.ranks * plan.actors):
        name, url = f"actor-{number}", rank_url(reachable_url(endpoint), number // plan.actors)
        kept = {"audit": run_dir / AUDIT / f"{name}.jsonl", "references": references_file(run_dir, name)}
        arguments = command("actor", connect=url, certs=launch.certs, run=run, id=name, physics=plan.physics, **kept)
        arguments += command(threads=threads, patience=patience)
        found.append(Child(name, arguments, run_dir / LOGS / f"{name}.log"))
    return found


def _gpu(rank: int) -> str:
    """Identifier of a rank's GPU for CUDA, among those available to this process."""
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    return visible[rank] if visible else str(rank)


def _connect(url: str, learner: Child, stop: threading.Event, certs: pathlib.Path | None) -> Transport | None:
    """Connects to the learner once it listens; returns None if the run is stopped before."""
    deadline = time.monotonic() + _START_SECONDS
    while time.monotonic() < deadline and not stop.is_set():
        try:
            return urls.connect(url, "observer", certs=certs, wait=_POLL)
        except TransportError:
            if learner.code:
                break
    if stop.is_set():
        return None
    raise CongraspError(f"The learner did not start: {learner.last_line()}", f"Its log is {learner.log}.")


def _supervise(
    learners: Sequence[Child],
    actors: Sequence[Child],
    transport: Transport,
    run: str,
    stop: threading.Event,
    report: Report,
    notify: Callable[[str], None],
) -> None:
    """Restarts processes that die and reports progress, until rank 0 has finished or the run is stopped."""
    metrics = transport.subscribe(Keys(run).learner_metrics, depth=16)
    events = transport.subscribe(Keys(run).log("event", "learner", "0"), depth=16)
    while not stop.is_set():
        if learners[0].code == 0:
            return
        if any(child.code for child in learners):
            _restart_learners(learners, stop, notify)
        for child in actors:
            if code := child.code:
                _check_can_restart(child, code)
                if child.again_at == 0.0:
                    notify(f"The {child.name} died (exit code {code}); restarting it.")
                    child.again_at = time.monotonic() + min(2.0**child.restarts, 15.0) - 1.0
                if time.monotonic() >= child.again_at:
                    child.restarts += 1
                    child.again_at = 0.0
                    child.start()
        while event := events.receive(0.0):
            if event[1].meta.get("level") == "error":
                notify(str(event[1].meta.get("text")))
        received = metrics.receive(_POLL)
        alive = sum(child.code is None for child in actors) or len(learners)
        report({**(received[1].meta if received else {}), "actors": alive})


def _restart_learners(learners: Sequence[Child], stop: threading.Event, notify: Callable[[str], None]) -> None:
    """Restarts all ranks after one died; the others notice and end, or are terminated."""
    dead = next(child for child in learners if child.code)
    died = f"The {dead.name} died (exit code {dead.code})"
    wait_for([child.process for child in learners if child.process], CHILD_GRACE)
    end_all(learners)
    for child in learners:
        _check_can_restart(child, child.code or 0)
    notify(f"{died}; restarting it." if len(learners) == 1 else f"{died}; restarting all ranks.")
    stop.wait(min(2.0 ** learners[0].restarts, 15.0) - 1.0)
    for child in learners:
        child.restarts += 1
        if not stop.is_set():
            child.start()


def _check_can_restart(child: Child, code: int) -> None:
    """Raises a `CongraspError` if a restart would end in the same way."""
    if code == _BAD_INPUT or child.restarts >= MAX_RESTARTS:
        raise CongraspError(f"The {child.name} failed: {child.last_line()}", f"Its log is {child.log}.")
