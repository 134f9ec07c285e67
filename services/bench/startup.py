"""Seconds from the start of a process to its first update, by stage: with empty caches, and with full ones."""

import collections
import json
import multiprocessing
import os
import tempfile
import threading
from multiprocessing.connection import Connection

import jax
from rich.console import Console
from rich.table import Table

from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.stages import imported, since_start, stages
from congrasp.services.train.learn import until_first_update

_STOPPED_SECONDS = 30.0
_EVENTS = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lowering",
    "/jax/core/compile/backend_compile_duration": "compiling or reading",
}


def bench_startup(config: RunConfig, physics: PhysicsName, deadline: float) -> None:
    """Prints the stages of two starts of a training in one process, the second with the caches of the first.

    Args:
      config: configuration of the run.
      physics: engine.
      deadline: deadline of one start, s.

    Raises:
      CongraspError: a start missed the deadline, or its process ended.
    """
    with tempfile.TemporaryDirectory() as folder:
        caches = {"XDG_CACHE_HOME": folder, "JAX_COMPILATION_CACHE_DIR": f"{folder}/jax"}
        starts = {name: _start(config, physics, caches, deadline) for name in ("empty caches", "warm")}
    names = list(dict.fromkeys(name for found in starts.values() for name in found))
    table = Table(title=f"{config.name}: {config.environments} environments, {config.objects.count} objects, {physics}")
    table.add_column("seconds")
    for name in starts:
        table.add_column(name, justify="right")
    for name in names:
        table.add_row(name, *(found.get(name, "") for found in starts.values()))
    console = Console()
    console.print(table)
    console.print(
        "Stages of different threads overlap. Warp's kernels are in a separate cache, which is used unchanged; "
        "'congrasp warmup' fills it."
    )


def _start(config: RunConfig, physics: PhysicsName, caches: dict[str, str], deadline: float) -> dict[str, str]:
    """The rows of one start, in a separate process."""
    here, there = multiprocessing.Pipe()
    before = {name: os.environ.get(name) for name in caches}
    os.environ.update(caches)
    process = multiprocessing.get_context("spawn").Process(target=_first_update, args=(config, physics, there))
    process.start()
    for name, value in before.items():
        os.environ.pop(name) if value is None else os.environ.update({name: value})
    try:
        there.close()
        if not here.poll(deadline):
            raise CongraspError(f"There was no first update in {deadline:.0f} s.", "Set a longer --deadline.")
        rows: dict[str, str] = json.loads(here.recv_bytes())
        process.join(_STOPPED_SECONDS)
    except EOFError:
        raise CongraspError("The training ended before its first update.", "See its output above.") from None
    finally:
        process.kill()
    return rows


def _first_update(config: RunConfig, physics: PhysicsName, results: Connection) -> None:
    """Trains until the first update, and sends the stages of the start."""
    imported()
    seconds, programs = collections.defaultdict[str, float](float), collections.Counter[str]()

    def timed(event: str, duration_secs: float, **about: str | int) -> None:
        if event in _EVENTS:
            seconds[_EVENTS[event]] += duration_secs
            if event.endswith("backend_compile_duration"):
                programs[str(about.get("fun_name"))] += 1

    jax.monitoring.register_event_duration_secs_listener(timed)

    def report() -> None:
        rows = {one.name: f"{one.ended - one.began:.2f} (at {one.began:.1f})" for one in stages()}
        rows |= {f"{name}, all threads": f"{total:.2f}" for name, total in seconds.items()}
        rows["compiled programs"] = str(programs.total())
        rows["of these more than once"] = ", ".join(f"{name} {n}" for name, n in programs.items() if n > 1)
        rows["in all, from the start of the process"] = f"{since_start():.2f}"
        results.send_bytes(json.dumps(rows).encode())

    until_first_update(config, physics, threading.Event(), report)
