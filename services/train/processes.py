"""Trainings as processes of this machine: a learner and its actors, and a whole training in the
background.

`Launch` has their number, their engine, and the peers that may connect.
"""

import dataclasses
import json
import os
import pathlib
import shlex
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax

from congrasp.actors.physics import resolve_physics
from congrasp.actors.references_file import references_file
from congrasp.common.config import MetricWriter, RunConfig
from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_json
from congrasp.common.io.journal import AUDIT
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.runtime.environment import child_environment
from congrasp.common.runtime.parallel import cores
from congrasp.common.runtime.stages import stage
from congrasp.common.transport import urls
from congrasp.common.transport.base import Subscription, Transport
from congrasp.common.transport.keys import FLOWS, Keys
from congrasp.common.transport.ports import (
    LEARNER_URL,
    check_ports,
    local_url,
    rank_url,
    reachable_url,
)
from congrasp.common.transport.security import CERTIFICATE_FILE, check_exposure
from congrasp.learner.run_directory import CONFIG_FILE, LOGS, POLICY_FILE, has_checkpoints
from congrasp.services.ops.lifetime import CHILD_GRACE, Child, command, end_all, run_child, wait_for

MAX_RESTARTS = 5
"""Restarts of a process without an update of the run between them."""
_BAD_INPUT = 2
_START_SECONDS = 120.0
_POLL = 0.25
_LONGEST_PAUSE = 15.0
"""Longest time before a restart, s."""
Report = Callable[[dict[str, Any]], None]
"""Called several times a second with the learner's newest metrics, if any, and the number of live
actors.
"""


@dataclasses.dataclass(frozen=True)
class Launch:
    """Options of a run's processes."""

    actors: int | None = None
    """Actor processes. By default two, or one on fewer than four cores; on a GPU none: a single
    actor then runs in the learner's process, and rollouts never leave the device."""
    ranks: int = 1
    """Learners that train together, data parallel; each has --actors actors, and a separate GPU if
    there are GPUs. The batch grows with them."""
    listen: str | None = None
    """Endpoint for actors of other machines, such as tls/0.0.0.0:7447; by default only this machine
    can join.
    """
    certs: pathlib.Path | None = None
    """The authority's folder (congrasp certs), for mutual TLS."""
    insecure: bool = False
    """Listen beyond loopback without certificates."""
    metric_writers: tuple[MetricWriter, ...] = ("tensorboard",)
    """Additional metric writers: tensorboard (files in the run's folder), wandb-offline (files
    there, for `wandb sync`), wandb (needs an account); without a name, none."""
    metrics_port: int = 0
    """Port of the learner's Prometheus endpoint, http://127.0.0.1:PORT/metrics; 0 for none."""
    audit: bool = True
    """Journals of all rollouts in the run's folder, for 'congrasp audit'."""

    def planned(self, config: RunConfig) -> "Plan":
        """Chooses engine and number of actors; on a GPU one process does everything unless others
        may connect.

        Raises:
          CongraspError: the options contradict each other or this machine, or the learner may not
            listen as requested.
        """
        if self.actors is not None and self.actors < 0:
            raise CongraspError(
                f"--actors is {self.actors}.",
                "Pass a number of actor processes, or 0 to run the actor in the learner's process.",
            )
        if self.ranks < 1:
            raise CongraspError(f"--ranks is {self.ranks}.", "Pass a number of learners from 1 on.")
        joined = self.listen is not None or self.certs is not None
        if joined:
            self._check_connections(config.name)
        gpus = self.ranks > 1 and leave_gpus_to(self.ranks)
        physics = engine_of(config.physics, gpus)
        # Two actors on two cores would compile the same programs at the same time.
        default = 0 if ENGINES[physics].on_device and not joined else min(2, max(1, cores() // 2))
        actors = default if self.actors is None else self.actors
        return Plan(self, actors, physics, gpus)

    def _check_connections(self, run: str) -> None:
        """Raises a `CongraspError` if the learner may not listen as requested, or only some roles
        have certificates.
        """
        if self.certs is not None and (self.certs / CERTIFICATE_FILE).exists():
            raise CongraspError(
                f"{self.certs} belongs to one role.",
                "Pass the authority's folder, which holds those of all roles.",
            )
        credentials = urls.find_credentials(self.certs, "learner", run)
        check_exposure(self.listen or LEARNER_URL, credentials, insecure=self.insecure)
        if self.listen:
            check_ports(self.listen, self.ranks * len(FLOWS))
        for role in ("actor", "observer"):
            urls.find_credentials(self.certs, role, run)
        if self.actors == 0:
            raise CongraspError(
                "With --actors 0 nothing listens.", "Remove --listen and --certs, or --actors."
            )


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


class Plan(NamedTuple):
    """A launch on this machine."""

    launch: Launch
    actors: int
    """Actor processes of each rank; 0 runs an actor in each learner's process."""
    physics: PhysicsName
    """Engine of the actors, except `auto`."""
    gpus: bool
    """True if each of several ranks has a separate GPU, the others hidden from it."""

    @property
    def in_process(self) -> bool:
        """True if learner and actor run in this process."""
        return self.actors == 0 and self.launch.ranks == 1


def leave_gpus_to(ranks: int) -> bool:
    """Returns True if each rank has a GPU; this process then uses none, so that the ranks have all
    memory.

    Raises:
      CongraspError: there are fewer GPUs than ranks, but not none.
    """
    with stage("search for accelerators"):
        backend, count = accelerators()
    if backend == "cpu":
        return False
    if count < ranks:
        raise CongraspError(
            f"{ranks} ranks need {ranks} GPUs, but JAX finds {count}.", "Pass a smaller --ranks."
        )
    jax.config.update("jax_platforms", "cpu")
    return True


def accelerators() -> tuple[str, int]:
    """Returns JAX's name of this machine's hardware, and its number of devices.

    A separate process checks this, since a process that initialises a GPU holds memory of it.

    Raises:
      CongraspError: JAX does not start.
    """
    code = "import jax; print(jax.default_backend(), jax.local_device_count())"
    environment = child_environment(XLA_PYTHON_CLIENT_PREALLOCATE="false")
    try:
        seen = subprocess.run(
            [sys.executable, "-P", "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            timeout=120.0,
        )
        backend, count = seen.stdout.split()
    except (subprocess.TimeoutExpired, ValueError):
        raise CongraspError("JAX does not start here.", "Check 'congrasp doctor'.") from None
    return backend, int(count)


def engine_of(name: PhysicsName, gpus: bool) -> PhysicsName:
    """Resolves `auto` for the ranks, even if this process sees no GPU but they do."""
    return resolve_physics(name, "cuda" if gpus else "")


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
    launch = plan.launch
    # One more for the ports through which the ranks join
    endpoint = launch.listen or local_url(launch.ranks + 1)
    logs = run_dir / LOGS
    logs.mkdir(exist_ok=True)
    learners = _learners(run_dir, plan, endpoint)
    actors = _actors(run_dir, plan, config.name, endpoint)
    try:
        with stage("start of the learner's process"):
            for child in (*learners, *actors):
                child.start()
            transport = _connect(reachable_url(endpoint), learners[0], stop, launch.certs)
        if transport is not None:
            shown = shlex.join(command("congrasp", "view", run_dir, certs=launch.certs))
            notify(f"Watch it in the browser with: {shown}")
            with transport:
                _supervise(learners, actors, transport, config.name, stop, report, notify)
    finally:
        end_all([*learners, *actors])


def _learners(run_dir: pathlib.Path, plan: Plan, endpoint: str) -> list[Child]:
    """Returns the learner processes; rank 0 listens at the endpoint, and has the metrics."""
    launch = plan.launch
    learners: list[Child] = []
    coordinator = rank_url(reachable_url(endpoint), launch.ranks).partition("/")[2]
    for rank in range(launch.ranks):
        name = f"rank-{rank}" if launch.ranks > 1 else "learner"
        arguments = command(
            "learner", run_dir=run_dir, resume=True, listen=endpoint, certs=launch.certs
        )
        arguments += command(insecure=launch.insecure, inside=not plan.actors)
        arguments += command(no_audit=not launch.audit)
        if launch.ranks > 1:
            arguments += command(rank=rank, ranks=launch.ranks, coordinator=coordinator)
        if rank == 0:
            arguments += command(
                metrics_port=launch.metrics_port, metric_writers=launch.metric_writers
            )
        environment = {"CUDA_VISIBLE_DEVICES": _gpu(rank)} if plan.gpus else {}
        learners.append(Child(name, arguments, run_dir / LOGS / f"{name}.log", environment))
    return learners


def _actors(run_dir: pathlib.Path, plan: Plan, run: str, endpoint: str) -> list[Child]:
    """Returns the actor processes of all ranks; rank 0 listens at the endpoint."""
    launch = plan.launch
    actors: list[Child] = []
    threads = max(1, cores() // max(1, launch.ranks * plan.actors))
    for number in range(launch.ranks * plan.actors):
        name = f"actor-{number}"
        url = rank_url(reachable_url(endpoint), number // plan.actors)
        arguments = command("actor", connect=url, certs=launch.certs, run=run, id=name)
        arguments += command(physics=plan.physics, threads=threads)
        arguments += command(references=references_file(run_dir, name))
        if launch.audit:
            arguments += command(audit=run_dir / AUDIT / f"{name}.jsonl")
        else:
            arguments += command(no_audit=True)
        actors.append(Child(name, arguments, run_dir / LOGS / f"{name}.log"))
    return actors


def _gpu(rank: int) -> str:
    """Identifier of a rank's GPU for CUDA, among those available to this process."""
    visible = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    return visible[rank] if visible else str(rank)


def _connect(
    url: str, learner: Child, stop: threading.Event, certs: pathlib.Path | None
) -> Transport | None:
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
    raise ProcessDied(f"The learner did not start: {learner.cause()}", learner.log)


def _supervise(
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
        while event := events.receive(0.0):
            if event[1].meta.get("level") == "error":
                notify(str(event[1].meta.get("text")))
        alive = sum(child.code is None for child in actors) or len(learners)
        report({**latest, "actors": alive})


def _latest(metrics: Subscription) -> dict[str, Any]:
    """Waits a moment for metrics of the learner; returns the newest ones, empty if there are
    none.
    """
    newest = metrics.receive(_POLL)
    while newer := metrics.receive(0.0):
        newest = newer
    return dict(newest[1].meta) if newest else {}


def _restart_actor(child: Child, notify: Callable[[str], None]) -> None:
    """Restarts an actor that died, later each time."""
    if child.again_at == 0.0:
        _check_can_restart(child)
        notify(f"{child.death()} Restarting it.")
        child.again_at = time.monotonic() + _pause(child)
    if time.monotonic() >= child.again_at:
        _restart(child)


def _restart_learners(
    learners: Sequence[Child], stop: threading.Event, notify: Callable[[str], None]
) -> None:
    """Restarts all ranks after one died; the others notice and end, or are terminated."""
    first = next(child for child in learners if child.code)
    wait_for([child.process for child in learners if child.process], CHILD_GRACE)
    # A rank that lost another one reports no more than that.
    dead = [
        child for child in learners if child.code and child.code != TransportError.exit_code
    ] or [first]
    died = " ".join(child.death() for child in dead)
    end_all(learners)
    for child in (*dead, *learners):
        _check_can_restart(child)
    notify(f"{died} Restarting {'it' if len(learners) == 1 else 'all ranks'}.")
    stop.wait(_pause(learners[0]))
    for child in learners:
        if not stop.is_set():
            _restart(child)


def _pause(child: Child) -> float:
    """Seconds before the next restart of a process: 0, 1, 3, 7, then 14."""
    return min(2.0**child.deaths, _LONGEST_PAUSE) - 1.0


def _restart(child: Child) -> None:
    """Starts a process that died again."""
    child.deaths += 1
    child.restarts += 1
    child.again_at = 0.0
    child.start()


def _check_can_restart(child: Child) -> None:
    """Raises a `ProcessDied` if a restart would end in the same way."""
    if child.code == _BAD_INPUT:
        raise ProcessDied(child.death(), child.log)
    if child.deaths >= MAX_RESTARTS:
        times = f" It died {child.deaths + 1} times without an update of the run between."
        repeated = times if child.deaths else ""
        raise ProcessDied(f"{child.death()}{repeated}", child.log)


_TRAINED = "trained.json"
_LARGEST = 1 << 16


def train_in_background(
    run_dir: pathlib.Path,
    chosen: Sequence[str],
    options: Sequence[str] = (),
    *,
    patience: float,
    progress: Callable[[str], None] = lambda line: None,
) -> None:
    """Trains until the run's end; the output goes to a log next to the run's folder.

    Args:
      run_dir: the run, which is resumed; one without a checkpoint is restarted.
      chosen: options of `congrasp train` for a new run, such as `--preset`.
      options: further options, also for a resumed run.
      patience: seconds after which the training is stopped, to be resumed later.
      progress: called with its last line of output.

    Raises:
      CongraspError: it failed, or took too long.
    """
    name = run_dir.name
    resume = has_checkpoints(run_dir)
    if not resume and (run_dir / CONFIG_FILE).exists():
        shutil.rmtree(run_dir)  # it ended before its first checkpoint
    begin = command(resume=True) if resume else list(chosen)
    arguments = ["train", *begin, *command(run_dir=run_dir, evaluation=0), *options]
    run_dir.parent.mkdir(parents=True, exist_ok=True)
    child = Child(name, arguments, run_dir.with_name(f"{name}.log"))
    began = time.monotonic()
    code = run_child(child, patience, progress)
    if code is None:
        raise CongraspError(
            f"The training of {name} was stopped after {patience / 60:.0f} min.",
            "Repeat the command to resume it; --patience gives it more time.",
        )
    if code or not (run_dir / POLICY_FILE).exists():
        raise CongraspError(
            f"The training of {name} failed: {child.cause()}", f"Its log is {child.log}."
        )
    write_atomically(
        run_dir / _TRAINED, json.dumps({"seconds": round(time.monotonic() - began, 1)}).encode()
    )


def trained(run_dir: pathlib.Path) -> pathlib.Path | None:
    """Policy file of a finished run; None if it is not finished."""
    policy = run_dir / POLICY_FILE
    return policy if (run_dir / _TRAINED).exists() and policy.exists() else None


def training_seconds(run_dir: pathlib.Path) -> float | None:
    """Duration of its training in seconds; for a resumed one, that of the last session."""
    try:
        return float(read_json(run_dir / _TRAINED, _LARGEST)["seconds"])
    except (LookupError, TypeError, ValueError, CongraspError):
        return None
