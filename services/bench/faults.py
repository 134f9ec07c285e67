"""How long a small run takes to recover: its processes are killed and stopped, one after another."""

import contextlib
import pathlib
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

from common.errors import CongraspError, TransportError
from common.transport import urls
from common.transport.keys import Keys
from common.wire.codec import Message
from services.ops.audit import audit

_RUN = "quickstart"
_SMALL = (
    *("--updates", "1000000", "--environments", "8", "--rollout-steps", "25", "--checkpoint-every", "1"),
    *("--objects.count", "2", "--objects.families", "box", "--network.hidden", "32", "--network.encoder", "8"),
    *("--ppo.epochs", "1", "--ppo.minibatches", "2", "--evaluation", "0", "--collapse-patience", "0"),
)
_WINDOW = 10.0  # seconds over which throughput is measured
_AFTER = 5.0  # seconds after a death
_DEADLINE = 180.0
Measure = Callable[[str, float, Callable[[], Any]], None]
"""Given a name, a time of `time.monotonic`, and what is true once that which is waited for has happened."""


class RunUnderTest:
    """A run of `congrasp train` and a look at it from outside."""

    def __init__(self, process: psutil.Process):
        """Waits until the run's learner listens."""
        self._process = process
        endpoint = _until(lambda: self._argument("learner", "--listen"))
        self._transport = urls.connect(endpoint, "observer", wait=_DEADLINE)

    def _argument(self, role: str, name: str) -> str | None:
        """An option's value in the command line of the oldest process of a role."""
        return next((c.cmdline()[c.cmdline().index(name) + 1] for c in self.children(role)), None)

    def children(self, role: str) -> list[psutil.Process]:
        """The run's processes of a role, oldest first."""
        with contextlib.suppress(psutil.NoSuchProcess):
            return sorted((c for c in self._process.children() if role in c.cmdline()), key=lambda c: c.create_time())
        return []

    def status(self) -> dict[str, Any]:
        """The learner's; empty while there is none."""
        with contextlib.suppress(TransportError):
            return dict(self._transport.query(Keys(_RUN).status, Message(), timeout=0.5).meta)
        return {}

    def actors(self) -> dict[str, int]:
        """Rollouts by incarnation of the actors that are there."""
        return {r["incarnation"]: r.get("rollouts", 0) for r in self.status().get("roles", ()) if r["role"] == "actor"}

    def accepted(self) -> int:
        """Rollouts so far."""
        return _until(self.status)["ledger"]["accepted"]

    def rate(self) -> float:
        """Accepted rollouts a second, over a while."""
        began, before = time.monotonic(), self.accepted()
        time.sleep(_WINDOW)
        return (self.accepted() - before) / (time.monotonic() - began)

    def close(self) -> None:
        """Stops looking."""
        self._transport.close()


@contextlib.contextmanager
def _running(run_dir: pathlib.Path, actors: int) -> Iterator[RunUnderTest]:
    """A run with so many actors that all contribute, while the block runs."""
    command = [sys.executable, "-m", "services.cli.main", "train", "--run-dir", str(run_dir), "--actors", str(actors)]
    process = subprocess.Popen([*command, *_SMALL], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        victim = RunUnderTest(psutil.Process(process.pid))
        with contextlib.closing(victim):
            _until(lambda: len(victim.actors()) == actors and min(victim.actors().values()) > 2)
            yield victim
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(15.0)
        except subprocess.TimeoutExpired:
            process.kill()


def _until(look: Callable[[], Any]) -> Any:
    """What `look` gives once that is something."""
    deadline = time.monotonic() + _DEADLINE
    while not (seen := look()):
        if time.monotonic() > deadline:
            raise CongraspError(f"Nothing happened within {_DEADLINE:g} s.", "Is the machine busy otherwise?")
        time.sleep(0.02)
    return seen


def bench_faults(actors: int, repeats: int) -> None:
    """Prints seconds from each fault until it is noticed and until the run has recovered, and the run's audit."""
    seconds: dict[str, list[float]] = {}
    shares: list[float] = []
    starts: list[float] = []

    def measure(what: str, since: float, look: Callable[[], Any]) -> None:
        _until(look)
        seconds.setdefault(what, []).append(time.monotonic() - since)

    with tempfile.TemporaryDirectory() as folder:
        run_dir = pathlib.Path(folder, "run")
        with _running(run_dir, actors) as run:
            for _ in range(repeats):
                share, busy = _kill_actor(run, actors, measure)
                shares.append(share)
                starts.append(busy)
                _stop_actor(run, actors, measure)
                _kill_learner(run, measure)
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
        report = audit(run_dir)
        console.print("Audit:", ", ".join(f"{name} {value}" for name, value in report.counts.items()))
        console.print(f"Lag: mean {report.lag_mean:.2f}, at most {report.lag_max} of {report.max_staleness}.")


def _kill_actor(run: RunUnderTest, actors: int, measure: Measure) -> tuple[float, float]:
    """Kills the oldest actor; returns the throughput of the next seconds as a share of that before, and the processor
    seconds that its replacement took until it contributed."""
    before, known = run.rate(), run.actors()
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
    pids, version = {child.pid for child in run.children("actor")}, _until(run.status)["version"]
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
