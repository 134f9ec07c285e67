"""Seconds from the start of a training to its first update, by stage."""

import collections
import contextlib
import json
import multiprocessing
import os
import tempfile
import threading
from collections.abc import Iterator, Mapping
from multiprocessing.connection import Connection

import jax
from rich.console import Console
from rich.table import Table

from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.stages import record_import_stage, since_start, stages
from congrasp.services.train.learn import until_first_update

_STOPPED_SECONDS = 30.0
"""Longest wait for the end of a process that has sent its stages, s."""


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
        starts = {}
        for name in ("empty caches", "warm"):
            starts[name] = _start(config, physics, caches, deadline)
    table = Table(
        title=(
            f"{config.name}: {config.environments} environments, {config.objects.count} objects, "
            f"{physics}"
        )
    )
    table.add_column("seconds")
    stage_names: dict[str, None] = {}
    for name, seconds in starts.items():
        table.add_column(name, justify="right")
        stage_names |= dict.fromkeys(seconds)
    for stage_name in stage_names:
        cells = [seconds.get(stage_name, "") for seconds in starts.values()]
        table.add_row(stage_name, *cells)
    console = Console(markup=False)
    console.print(table)
    console.print(
        "Stages of different threads overlap. Warp's kernels are in a separate cache, which is "
        "used unchanged; "
        "'congrasp warmup' fills it."
    )


def _start(
    config: RunConfig, physics: PhysicsName, caches: Mapping[str, str], deadline: float
) -> dict[str, str]:
    """Durations by stage of one start, in a separate process with these caches."""
    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(
        target=_first_update, args=(config, physics, there)
    )
    with _environment(caches):
        process.start()
    try:
        there.close()
        if not here.poll(deadline):
            raise CongraspError(
                f"There was no first update in {deadline:.0f} s.", "Set a longer --deadline."
            )
        seconds: dict[str, str] = json.loads(here.recv_bytes())
        process.join(_STOPPED_SECONDS)
    except EOFError:
        raise CongraspError(
            "The training ended before its first update.", "See its output above."
        ) from None
    finally:
        process.kill()
    return seconds


@contextlib.contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Context with these variables in the environment, for a process that starts in it."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _first_update(config: RunConfig, physics: PhysicsName, results: Connection) -> None:
    """Trains until the first update, and sends the stages of the start."""
    record_import_stage()
    programs = collections.Counter[str]()

    def count(event: str, duration_secs: float, **about: str | int) -> None:
        """Counts a program that is compiled."""
        if event.endswith("backend_compile_duration"):
            programs[str(about.get("fun_name"))] += 1

    def report() -> None:
        """Sends the stages and the number of programs."""
        results.send_bytes(json.dumps(_report(programs)).encode())

    jax.monitoring.register_event_duration_secs_listener(count)
    until_first_update(config, physics, threading.Event(), report)


def _report(programs: Mapping[str, int]) -> dict[str, str]:
    """Durations of this process by stage, and its compiled programs."""
    rows = {}
    for stage in stages():
        rows[stage.name] = f"{stage.ended - stage.began:.2f} (at {stage.began:.1f})"
    repeated = [f"{name} {count}" for name, count in programs.items() if count > 1]
    rows["compiled programs"] = str(sum(programs.values()))
    rows["compiled more than once"] = ", ".join(repeated)
    rows["total, from the start of the process"] = f"{since_start():.2f}"
    return rows
