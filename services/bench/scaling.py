"""Weak scaling of a training: its steps per second with 1, 2, … learner ranks, each a separate
process with a separate GPU.
"""

import dataclasses
import json
import math
import pathlib
import platform
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
from rich.console import Console
from rich.table import Table

from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.runtime.resources import cores
from congrasp.learner.run_directory import create_run
from congrasp.services.train.accelerators import engine_of, leave_gpus_to
from congrasp.services.train.launch import Launch, LearnerOptions, Plan
from congrasp.services.train.processes import train

_WARM_UPDATES = 5
"""Updates before the measurement: the first ones compile, and all environments begin with new
episodes.
"""
_LEAST_UPDATES = 3
_ENDLESS_UPDATES = 10**9
"""Length of a run that the measurement stops."""
_NOTICE_INTERVAL_S = 10.0
_LOG_LINES = 15
"""Last lines of a log that are printed after a failure."""
_COLUMNS = ("ranks", "steps/s", "efficiency", "wait, s", "update, s", "updates", "start, s")


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
        """Begins to wait for the first update.

        Args:
          seconds: duration of the measurement.
          deadline: longest time until its end, s.
          stop: set at its end.
          notify: prints a line about the progress.
        """
        self.metrics: list[dict[str, Any]] = []
        """Metrics of the measured updates, preceded by those of the last warm one."""
        self._seconds = seconds
        self._stop = stop
        self._notify = notify
        self._began = time.monotonic()
        self._notified = self._began
        self._deadline = self._began + deadline
        self._start_seconds = math.nan

    def show(self, status: dict[str, Any]) -> None:
        """Stores the newest metrics, if there are any."""
        now = time.monotonic()
        if "values" in status:
            self._store(status, now)
        is_complete = self._span >= self._seconds and len(self.metrics) > _LEAST_UPDATES
        if is_complete or now > self._deadline:
            self._stop.set()
        if now - self._notified > _NOTICE_INTERVAL_S:
            self._notified = now
            activity = f"measured {self._span:.0f} s" if self._span else "starting"
            self._notify(f"{now - self._began:.0f} s, {activity}")

    def _store(self, status: dict[str, Any], now: float) -> None:
        """Stores the metrics of an update, unless it is one of the first."""
        if math.isnan(self._start_seconds) and status["update"] >= 1:
            self._start_seconds = now - self._began
        if status["update"] >= _WARM_UPDATES:
            self.metrics.append(status)

    @property
    def _span(self) -> float:
        """Duration of the measurement so far, s."""
        if not self.metrics:
            return 0.0
        return float(self.metrics[-1]["time"] - self.metrics[0]["time"])

    def stage(self, ranks: int, first: Stage | None) -> Stage:
        """Result of the measurement; `first` is that of the first number of ranks."""
        begin = self.metrics[0]
        end = self.metrics[-1]
        steps = end["values"]["transitions"] - begin["values"]["transitions"]
        rate = steps / self._span
        rate_of_rank = rate / ranks
        if first is not None:
            rate_of_rank = first.steps_per_second / first.ranks
        return Stage(
            ranks=ranks,
            updates=end["update"] - begin["update"],
            seconds=self._span,
            steps_per_second=rate,
            efficiency=rate / ranks / rate_of_rank,
            wait_seconds=self._mean("wait_seconds"),
            update_seconds=self._mean("update_seconds"),
            start_seconds=self._start_seconds,
        )

    def _mean(self, metric: str) -> float:
        """Mean of a metric over the measured updates."""
        measured = self.metrics[1:]
        return sum(entry["values"][metric] for entry in measured) / len(measured)


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
    config = dataclasses.replace(
        config, updates=_ENDLESS_UPDATES, physics=physics, collapse_patience=0
    )
    console = Console(highlight=False)
    stages: list[Stage] = []
    for count in ranks:
        console.print(f"{count} rank(s): at most {deadline:.0f} s …")
        launch = Launch(ranks=count, learner=LearnerOptions(metric_writers=()))
        plan = Plan(launch, actors, physics, gpus)
        first = stages[0] if stages else None
        stages.append(_measure(config, plan, seconds, deadline, first, console))
        _write(out, config, plan, stages)
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
        _print_logs(console, run_dir / "logs")
        raise
    shutil.rmtree(run_dir, ignore_errors=True)
    return meter.stage(ranks, first)


def _print_logs(console: Console, folder: pathlib.Path) -> None:
    """Prints the last lines of each log of a failed run."""
    for log in sorted(folder.glob("*.log")):
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
        console.print(f"{log}", *lines[-_LOG_LINES:], sep="\n", markup=False)


def _write(out: pathlib.Path, config: RunConfig, plan: Plan, stages: Sequence[Stage]) -> None:
    """Writes the completed stages, with the machine and the configuration, as JSON."""
    result = {
        "machine": {
            "host": platform.node(),
            "cores": cores(),
            "jax": jax.__version__,
            "gpus": plan.gpus,
        },
        "config": dataclasses.asdict(config),
        "actors": plan.actors,
        "stages": [dataclasses.asdict(stage) for stage in stages],
    }
    out.write_text(json.dumps(result, indent=2), encoding="utf-8")


def _print(console: Console, config: RunConfig, stages: Sequence[Stage]) -> None:
    """Prints the table of the completed stages."""
    steps = config.environments * config.rollout_steps * config.rollouts_per_update
    table = Table(
        title=(
            f"{config.environments} environments, {steps} steps an update of each rank, "
            f"'{config.physics}'"
        )
    )
    for column in _COLUMNS:
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
