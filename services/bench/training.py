"""Benchmarks of a training: seconds to its first update by stage, and weak scaling over learner
ranks.

Weak scaling is the trained steps per second of 1, 2, … ranks, each a separate process with a
separate GPU.
"""

import collections
import dataclasses
import json
import math
import multiprocessing
import os
import pathlib
import platform
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import jax
from rich.console import Console
from rich.table import Table

from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.parallel import cores
from congrasp.common.runtime.stages import imported, since_start, stages
from congrasp.learner.run_directory import create_run
from congrasp.services.train.accelerators import engine_of, leave_gpus_to
from congrasp.services.train.launch import Launch, LearnerOptions, Plan
from congrasp.services.train.learn import until_first_update
from congrasp.services.train.processes import train

_WARM_UPDATES = 5
"""Updates before the measurement: the first ones compile, and all environments begin with new
episodes.
"""
_LEAST_UPDATES = 3


@dataclasses.dataclass(frozen=True)
class Stage:
    """Result of one number of ranks."""

    ranks: int
    updates: int
    """Number of measured updates."""
    seconds: float
    """Their duration, from the end of the update before them."""
    steps_per_second: float
    """Environment steps of all ranks consumed by updates, by the clock of rank 0."""
    efficiency: float
    """Steps per second and rank over those of the first stage."""
    wait_seconds: float
    """Mean time from one update to the next batch of all ranks, which waits for the rollouts of the
    slowest one.
    """
    update_seconds: float
    """Mean time of an update with its collectives."""
    start_seconds: float
    """Time from the start of the processes to the end of the first update: imports, compilation,
    connections.
    """


class _Meter:
    """Collects a run's metrics, and stops it after `seconds` of measurement, or at the deadline."""

    def __init__(
        self, seconds: float, deadline: float, stop: threading.Event, notify: Callable[[str], None]
    ):
        self.metrics: list[dict[str, Any]] = []
        self._seconds, self._stop, self._notify = seconds, stop, notify
        self._began = self._notified = time.monotonic()
        self._deadline = self._began + deadline
        self.start_seconds = float("nan")

    def show(self, status: dict[str, Any]) -> None:
        """Stores the newest metrics, if there are any."""
        now = time.monotonic()
        if "values" in status:
            if math.isnan(self.start_seconds) and status["update"] >= 1:
                self.start_seconds = now - self._began
            if status["update"] >= _WARM_UPDATES:
                self.metrics.append(status)
        span = self.metrics[-1]["time"] - self.metrics[0]["time"] if self.metrics else 0.0
        if (span >= self._seconds and len(self.metrics) > _LEAST_UPDATES) or now > self._deadline:
            self._stop.set()
        if now - self._notified > 10.0:
            self._notified = now
            self._notify(
                f"{now - self._began:.0f} s, " + (f"measured {span:.0f} s" if span else "starting")
            )

    def stage(self, ranks: int, first: Stage | None) -> Stage:
        """Result of the measurement; `first` is that of the first number of ranks."""
        begin, end = self.metrics[0], self.metrics[-1]
        seconds = end["time"] - begin["time"]
        rate = (end["values"]["transitions"] - begin["values"]["transitions"]) / seconds
        measured = [entry["values"] for entry in self.metrics[1:]]
        alone = rate / ranks if first is None else first.steps_per_second / first.ranks
        return Stage(
            ranks,
            end["update"] - begin["update"],
            seconds,
            rate,
            rate / ranks / alone,
            sum(values["wait_seconds"] for values in measured) / len(measured),
            sum(values["update_seconds"] for values in measured) / len(measured),
            self.start_seconds,
        )


def bench_scaling(
    config: RunConfig,
    ranks: Sequence[int],
    *,
    seconds: float,
    actors: int | None,
    deadline: float,
    out: pathlib.Path,
) -> None:
    """Measures every number of ranks in turn, prints a table, and writes JSON after each of them.

    Args:
      config: the run of every rank; it is trained, and deleted afterwards.
      ranks: numbers of ranks; efficiency is relative to the first.
      seconds: duration of each measurement.
      actors: actor processes of each rank; by default none on GPUs (one runs inside each rank),
        otherwise one.
      deadline: total time of one number of ranks, s.
      out: file for the results.

    Raises:
      CongraspError: the machine has too few GPUs, a process failed permanently, or a deadline
        passed.
    """
    if not ranks or min(ranks) < 1:
        raise CongraspError("Name numbers of ranks from 1 on.", "For example --ranks 1 2 4.")
    gpus = leave_gpus_to(max(ranks))
    physics = engine_of(config.physics, gpus)
    if actors is None:
        actors = 0 if gpus else 1
    config = dataclasses.replace(config, updates=10**9, physics=physics, collapse_patience=0)
    console = Console(highlight=False)
    stages: list[Stage] = []
    for count in ranks:
        console.print(f"{count} rank(s): at most {deadline:.0f} s …")
        launch = Launch(ranks=count, learner=LearnerOptions(metric_writers=()))
        plan = Plan(launch, actors, physics, gpus)
        stages.append(
            _measure(config, plan, seconds, deadline, stages[0] if stages else None, console)
        )
        result = {
            "machine": {
                "host": platform.node(),
                "cores": cores(),
                "jax": jax.__version__,
                "gpus": gpus,
            },
            "config": dataclasses.asdict(config),
            "actors": actors,
            "stages": [dataclasses.asdict(stage) for stage in stages],
        }
        out.write_text(json.dumps(result, indent=2))
        _print(console, config, stages)
    console.print(f"Written to {out}.", soft_wrap=True, markup=False)


def _measure(
    config: RunConfig,
    plan: Plan,
    seconds: float,
    deadline: float,
    first: Stage | None,
    console: Console,
) -> Stage:
    """Trains with one number of ranks until the measurement is complete."""
    ranks = plan.launch.ranks
    run_dir = pathlib.Path(tempfile.mkdtemp(prefix=f"congrasp-scaling-{ranks}-"))
    stop = threading.Event()
    meter = _Meter(seconds, deadline, stop, lambda text: console.print(f"  {text}", markup=False))
    create_run(run_dir, config)
    try:
        train(
            run_dir,
            config,
            plan,
            stop=stop,
            report=meter.show,
            notify=lambda text: console.print(f"  {text}", soft_wrap=True, markup=False),
        )
        if len(meter.metrics) <= _LEAST_UPDATES:
            raise TransportError(
                f"{ranks} rank(s) made {len(meter.metrics)} update(s) to measure within "
                f"{deadline:.0f} s.",
                f"See {run_dir}/logs, or set a longer --deadline.",
            )
    except CongraspError:
        for log in sorted((run_dir / "logs").glob("*.log")):
            console.print(
                f"{log}",
                *log.read_text(errors="replace").splitlines()[-15:],
                sep="\n",
                markup=False,
            )
        raise
    shutil.rmtree(run_dir, ignore_errors=True)
    return meter.stage(ranks, first)


def _print(console: Console, config: RunConfig, stages: Sequence[Stage]) -> None:
    """Prints the table of the completed stages."""
    steps = config.environments * config.rollout_steps * config.rollouts_per_update
    table = Table(
        title=(
            f"{config.environments} environments, {steps} steps an update of each rank, "
            f"'{config.physics}'"
        )
    )
    for column in ("ranks", "steps/s", "efficiency", "wait, s", "update, s", "updates", "start, s"):
        table.add_column(column, justify="right")
    for stage in stages:
        table.add_row(
            str(stage.ranks),
            f"{stage.steps_per_second:,.0f}",
            f"{100 * stage.efficiency:.1f} %",
            f"{stage.wait_seconds:.3f}",
            f"{stage.update_seconds:.3f}",
            str(stage.updates),
            f"{stage.start_seconds:.0f}",
        )
    console.print(table)


_STOPPED_SECONDS = 30.0


def bench_startup(config: RunConfig, physics: PhysicsName, deadline: float) -> None:
    """Prints the stages of two starts of a training in one process, the second with the caches of
    the first.

    Args:
      config: configuration of the run.
      physics: engine.
      deadline: deadline of one start, s.

    Raises:
      CongraspError: a start missed the deadline, or its process ended.
    """
    with tempfile.TemporaryDirectory() as folder:
        caches = {"XDG_CACHE_HOME": folder, "JAX_COMPILATION_CACHE_DIR": f"{folder}/jax"}
        starts = {
            name: _start(config, physics, caches, deadline) for name in ("empty caches", "warm")
        }
    names = list(dict.fromkeys(name for found in starts.values() for name in found))
    table = Table(
        title=(
            f"{config.name}: {config.environments} environments, {config.objects.count} objects, "
            f"{physics}"
        )
    )
    table.add_column("seconds")
    for name in starts:
        table.add_column(name, justify="right")
    for name in names:
        table.add_row(name, *(found.get(name, "") for found in starts.values()))
    console = Console(markup=False)
    console.print(table)
    console.print(
        "Stages of different threads overlap. Warp's kernels are in a separate cache, which is "
        "used unchanged; "
        "'congrasp warmup' fills it."
    )


def _start(
    config: RunConfig, physics: PhysicsName, caches: dict[str, str], deadline: float
) -> dict[str, str]:
    """The rows of one start, in a separate process."""
    here, there = multiprocessing.Pipe()
    before = {name: os.environ.get(name) for name in caches}
    os.environ.update(caches)
    process = multiprocessing.get_context("spawn").Process(
        target=_first_update, args=(config, physics, there)
    )
    process.start()
    for name, value in before.items():
        os.environ.pop(name) if value is None else os.environ.update({name: value})
    try:
        there.close()
        if not here.poll(deadline):
            raise CongraspError(
                f"There was no first update in {deadline:.0f} s.", "Set a longer --deadline."
            )
        rows: dict[str, str] = json.loads(here.recv_bytes())
        process.join(_STOPPED_SECONDS)
    except EOFError:
        raise CongraspError(
            "The training ended before its first update.", "See its output above."
        ) from None
    finally:
        process.kill()
    return rows


def _first_update(config: RunConfig, physics: PhysicsName, results: Connection) -> None:
    """Trains until the first update, and sends the stages of the start."""
    imported()
    programs = collections.Counter[str]()

    def count(event: str, duration_secs: float, **about: str | int) -> None:
        if event.endswith("backend_compile_duration"):
            programs[str(about.get("fun_name"))] += 1

    jax.monitoring.register_event_duration_secs_listener(count)

    def report() -> None:
        rows = {one.name: f"{one.ended - one.began:.2f} (at {one.began:.1f})" for one in stages()}
        rows["compiled programs"] = str(programs.total())
        rows["compiled more than once"] = ", ".join(
            f"{name} {n}" for name, n in programs.items() if n > 1
        )
        rows["total, from the start of the process"] = f"{since_start():.2f}"
        results.send_bytes(json.dumps(rows).encode())

    until_first_update(config, physics, threading.Event(), report)
