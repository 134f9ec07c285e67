"""What a run loses when it is killed, stopped, frozen, out of disk and damaged: every kind of fault, many times.

Each kind has a run of its own, which goes on after every fault. Afterwards its journals are judged twice: by `congrasp
audit`, and by a reader that shares no code with it.
"""

import contextlib
import functools
import pathlib
import random
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from congrasp.common.errors import CongraspError
from congrasp.services.ops.audit import FAULTS as KINDS
from congrasp.services.ops.audit import Report, audit
from tests.benchmarks.run_under_test import RunUnderTest, until
from tests.benchmarks.second_reading import Verdict, read_again

_DISK = 24 << 20  # bytes of the disk that is filled
_FROZEN = 4.0  # seconds, longer than a lease
_FULL = 3.0  # seconds that a disk stays full
_TRAINS = (0.5, 3.0)  # seconds of training before a fault
_OPTIONS = ("--checkpoint-every", "2", "--log-rollout-every", "0", "--episode-every", "1000000")
_RESTARTS = 4  # deaths of one child after which `congrasp train` is started again
Fault = Callable[[RunUnderTest, random.Random], None]


class Result(NamedTuple):
    """What some faults of one kind came to."""

    kind: str
    seconds: list[float]
    """From each fault, or from when the disk had room again, to the next update."""
    report: Report
    second: Verdict

    @property
    def fine(self) -> bool:
        """Whether nothing was lost, duplicated, unmatched or corrupted, in both readings."""
        first = tuple(self.report.counts[name] for name in Verdict._fields[:4])
        return first == self.second[:4] == (0, 0, 0, 0)


def bench_faults(actors: int, repeats: int, kinds: Sequence[str], seed: int = 0) -> bool:
    """Prints what every kind of fault cost.

    Args:
      actors: actor processes.
      repeats: faults of each kind.
      kinds: of `FAULTS`; all of them if none is named.
      seed: of the moments, and of the bits that are flipped.

    Returns:
      Whether it cost nothing that was acknowledged, and both readings agree on that.

    Raises:
      CongraspError: a kind is unknown; a run did not recover.
    """
    if unknown := set(kinds) - FAULTS.keys():
        raise CongraspError(f"There is no fault '{min(unknown)}'.", f"Choose from: {', '.join(FAULTS)}.")
    console = Console(width=None if sys.stdout.isatty() else 140)
    results: list[Result] = []
    for kind in kinds or FAULTS:
        with tempfile.TemporaryDirectory(prefix="congrasp-") as folder, _disk(folder, kind) as disk:
            if disk is None:
                console.print(f"{kind}: left out, for file systems cannot be mounted here.")
                continue
            results.append(_measure(kind, RunUnderTest(disk / "run", actors, _OPTIONS), repeats, random.Random(seed)))
        last = results[-1]
        console.print(f"{kind}: {'nothing lost' if last.fine else last.report.faults[:5]}; {_rest(last)}")
    console.print(_table(results, actors))
    return all(result.fine for result in results)


def _measure(kind: str, run: RunUnderTest, repeats: int, rng: random.Random) -> Result:
    """Faults of one kind in one run, and the verdict on it."""
    seconds: list[float] = []
    try:
        for number in range(repeats):
            if number % _RESTARTS == 0 and run.alive:
                run.stop()
            if not run.alive:
                run.start()
            version = until(run.status)["version"]
            time.sleep(rng.uniform(*_TRAINS))
            FAULTS[kind](run, rng)
            began = time.monotonic()
            if not run.alive:
                run.start()
            until(functools.partial(_is_past, run, version + 1))
            seconds.append(time.monotonic() - began)
    finally:
        run.stop()
    return Result(kind, seconds, audit(run.run_dir), read_again(run.run_dir))


def _is_past(run: RunUnderTest, version: int) -> bool:
    """Whether the learner has published a newer version."""
    return bool(run.status().get("version", -1) > version)


def _stop(number: signal.Signals) -> Fault:
    """Signals `congrasp train`, and waits until it has ended."""

    def stop(run: RunUnderTest, rng: random.Random) -> None:
        run.stop(number)

    return stop


def _kill_all(run: RunUnderTest, rng: random.Random) -> None:
    """Kills learner, actors and what started them, all at once."""
    run.kill()


def _kill_child(role: str) -> Fault:
    """Kills the oldest process of a role."""

    def kill(run: RunUnderTest, rng: random.Random) -> None:
        run.child(role).kill()

    return kill


def _freeze_child(role: str) -> Fault:
    """Freezes the oldest process of a role for some seconds; its connections stay open and silent."""

    def freeze(run: RunUnderTest, rng: random.Random) -> None:
        child = run.child(role)
        child.suspend()
        time.sleep(_FROZEN)
        child.resume()

    return freeze


def _fill_disk(run: RunUnderTest, rng: random.Random) -> None:
    """Lets the disk of the run be full for some seconds, and kills all processes at the end of every second time."""
    filler = run.run_dir.parent / "filler"
    with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(4096))
    time.sleep(_FULL)
    if rng.random() < 0.5:
        run.kill()
    filler.unlink()


def _damage(pattern: str, newest: int) -> Fault:
    """Kills all processes, and flips a bit in one of the `newest` files of a pattern, by their names."""

    def damage(run: RunUnderTest, rng: random.Random) -> None:
        until(lambda: list(run.run_dir.glob(pattern)))
        run.kill()
        if found := sorted(run.run_dir.glob(pattern))[-newest:]:
            path = rng.choice(found)
            data = bytearray(path.read_bytes())
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            path.write_bytes(data)

    return damage


FAULTS: dict[str, Fault] = {
    "sigterm": _stop(signal.SIGTERM),
    "ctrl-c": _stop(signal.SIGINT),
    "kill-learner": _kill_child("learner"),
    "kill-actor": _kill_child("actor"),
    "kill-all": _kill_all,
    "freeze-learner": _freeze_child("learner"),
    "freeze-actor": _freeze_child("actor"),
    "full-disk": _fill_disk,
    "damage-checkpoint": _damage("checkpoints/checkpoint_*.safetensors", 1),
    "damage-accepted": _damage("accepted/*/*.safetensors", 8),
    "damage-journal": _damage("audit/*.jsonl", 8),
    "damage-policy": _damage("policy.safetensors", 1),
}
"""Kinds of faults by name."""


@contextlib.contextmanager
def _disk(folder: str, kind: str) -> Iterator[pathlib.Path | None]:
    """Where a run can be: the folder, or a small disk of its own there; None if that cannot be mounted."""
    if kind != "full-disk":
        yield pathlib.Path(folder)
        return
    command = ["mount", "-t", "tmpfs", "-o", f"size={_DISK}", "tmpfs", folder]
    if not shutil.which("mount") or subprocess.run(command, capture_output=True, timeout=10).returncode:
        yield None
        return
    try:
        yield pathlib.Path(folder)
    finally:
        subprocess.run(["umount", "-l", folder], timeout=10, check=True)


def _rest(result: Result) -> str:
    """The outcomes of a kind's rollouts that are no fault, and damage to the journals."""
    counts = {name: count for name, count in result.report.counts.items() if count}
    return f"{counts}, lines damaged {result.report.damaged}, missing {result.report.holes}"


def _table(results: Sequence[Result], actors: int) -> Table:
    """A row for each kind: both verdicts where they differ."""
    columns = ("repeats", "accepted", "survived", *KINDS, "damaged on disk", "median, s", "longest, s")
    table = Table("fault", title=f"{actors} actors")
    for column in columns:
        table.add_column(column, justify="right")
    for kind, seconds, report, second in results:
        counts = report.counts
        verdicts = [
            f"{counts[name]}" + (f" ({other})" if (other := getattr(second, name)) != counts[name] else "")
            for name in KINDS
        ]
        survived = counts["used"] + counts.get("waiting", 0)
        numbers = [len(seconds), counts["accepted"], survived, *verdicts, counts.get("damaged on disk", 0)]
        times = [f"{statistics.median(seconds):.1f}", f"{max(seconds):.1f}"]
        table.add_row(kind, *map(str, numbers), *times)
    return table
