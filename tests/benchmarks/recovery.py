"""How long a small run takes to recover: its processes are killed and stopped, one after another."""

import pathlib
import tempfile
import time
from collections.abc import Callable, Collection
from typing import Any

from rich.console import Console
from rich.table import Table

from congrasp.common.errors import CongraspError
from congrasp.services.ops.audit import audit
from tests.benchmarks.run_under_test import RunUnderTest, until

_WINDOW = 10.0  # seconds over which throughput is measured
_AFTER = 5.0  # seconds after a death
Measure = Callable[[str, float, Callable[[], Any]], None]
"""Given a name, a time of `time.monotonic`, and what is true once that which is waited for has happened."""


def bench_recovery(actors: int, repeats: int) -> None:
    """Prints seconds from each fault until it is noticed and until the run has recovered, and the run's audit."""
    seconds: dict[str, list[float]] = {}
    shares: list[float] = []
    starts: list[float] = []

    def measure(what: str, since: float, look: Callable[[], Any]) -> None:
        until(look)
        seconds.setdefault(what, []).append(time.monotonic() - since)

    with tempfile.TemporaryDirectory() as folder:
        run = RunUnderTest(pathlib.Path(folder, "run"), actors, ("--checkpoint-every", "1"))
        try:
            run.start()
            for _ in range(repeats):
                share, busy = _kill_actor(run, actors, measure)
                shares.append(share)
                starts.append(busy)
                _stop_actor(run, actors, measure)
                _kill_learner(run, measure)
        finally:
            run.stop()
        table = Table("", "median, s", "longest, s", title=f"{actors} actors, {repeats} times each")
        for what, values in seconds.items():
            table.add_row(what, f"{sorted(values)[len(values) // 2]:.2f}", f"{max(values):.2f}")
        console = Console()
        console.print(table)
        console.print(
            f"Throughput in the 5 s after a death, as a share of that before: "
            f"{', '.join(f'{share:.2f}' for share in shares)} ((N-1)/N is {(actors - 1) / actors:.2f})."
        )
        console.print(
            f"Processor seconds of a replacement until it contributed: {', '.join(f'{x:.1f}' for x in starts)}."
        )
        report = audit(run.run_dir)
        console.print("Audit:", ", ".join(f"{name} {value}" for name, value in report.counts.items()))
        console.print(f"Lag: mean {report.lag_mean:.2f}, at most {report.lag_max} of {report.max_staleness}.")


def _kill_actor(run: RunUnderTest, actors: int, measure: Measure) -> tuple[float, float]:
    """Kills the oldest actor; returns the throughput of the next seconds as a share of that before, and the processor
    seconds that its replacement took until it contributed."""
    before, known = _rate(run), run.actors()
    run.children("actor")[0].kill()
    killed = time.monotonic()
    measure("actor killed: noticed", killed, lambda: len(run.actors()) < actors)
    counted, since = run.accepted(), time.monotonic()
    measure("actor killed: next rollout of the others", killed, lambda: run.accepted() > counted)
    time.sleep(max(0.0, killed + _AFTER - time.monotonic()))
    share = (run.accepted() - counted) / (time.monotonic() - since) / before
    measure("actor killed: replacement contributes", killed, lambda: _new_contributes(run, known))
    times = run.children("actor")[-1].cpu_times()
    return share, times.user + times.system


def _rate(run: RunUnderTest) -> float:
    """Accepted rollouts a second, over a while."""
    began, before = time.monotonic(), run.accepted()
    time.sleep(_WINDOW)
    return (run.accepted() - before) / (time.monotonic() - began)


def _stop_actor(run: RunUnderTest, actors: int, measure: Measure) -> None:
    """Stops the oldest actor, whose links then stay open and silent, until that is noticed."""
    victim, known = run.children("actor")[0], run.actors()
    victim.suspend()
    halted = time.monotonic()
    measure("actor stopped, its link silent: noticed", halted, lambda: len(run.actors()) < actors)
    victim.resume()
    measure("actor goes on: contributes", time.monotonic(), lambda: _all_contribute(run, known))


def _kill_learner(run: RunUnderTest, measure: Measure) -> None:
    """Kills the learner, whose actors must survive it."""
    pids, version = {child.pid for child in run.children("actor")}, until(run.status)["version"]
    run.children("learner")[0].kill()
    # The first version of the new session is the checkpoint's policy, the second is new.
    measure("learner killed: an update later", time.monotonic(), lambda: run.status().get("version", -1) > version + 2)
    if {child.pid for child in run.children("actor")} != pids:
        raise CongraspError("An actor did not survive the learner's restart.")


def _new_contributes(run: RunUnderTest, known: Collection[str]) -> bool:
    """Whether an actor that was not known has made a rollout."""
    return any(count for name, count in run.actors().items() if name not in known)


def _all_contribute(run: RunUnderTest, before: dict[str, int]) -> bool:
    """Whether every actor has made rollouts since."""
    now = run.actors()
    return bool(now) and all(now.get(name, 0) > count for name, count in before.items())
