"""How a run ends on a signal: sends one to a small real run at random times, and looks for processes left behind."""

import os
import pathlib
import random
import secrets
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import psutil
from rich.progress import track

LIMIT = 5.0
"""Seconds that a run may take to end."""
_MARK = "CONGRASP_ATTEMPT"  # environment variable by which all processes of an attempt are found
PATIENCE = 3 * LIMIT
"""Seconds after which an attempt is given up."""
_LOOK = 0.02
SMALL = (
    *("train", "--preset", "quickstart", "--updates", "1000000", "--environments", "4", "--checkpoint-every", "3"),
    *("--objects.count", "2", "--objects.families", "box", "--network.hidden", "32", "--network.encoder", "8"),
    *("--ppo.epochs", "1", "--ppo.minibatches", "2", "--evaluation", "0", "--actors", "2", "--physics", "native"),
)
"""A run with a learner and two actors that trains until it is signalled."""


class Attempt(NamedTuple):
    """Outcome of one signal."""

    signal: str
    after: float
    """Seconds from the start of the run to the signal."""
    processes: int
    """Processes that the run consisted of at the signal."""
    seconds: float
    """From the signal until none of them lived; infinite if that took so long that they were killed."""
    orphans: tuple[str, ...]
    """Command lines of those that lived on when the one that was signalled had ended."""
    code: int

    @property
    def fine(self) -> bool:
        """Whether all ended together and in time."""
        return self.seconds <= LIMIT and not self.orphans


def bench_shutdown(count: int, within: float, seed: int) -> bool:
    """Prints every attempt that failed, and a summary; returns whether none did. For the arguments see `attempts`."""
    results: list[Attempt] = []
    try:
        for one in track(attempts(count, within, seed), "shutting down", total=count):
            results.append(one)
            if not one.fine:
                left = f", left behind: {'; '.join(one.orphans)}" if one.orphans else ""
                print(f"{one.signal} after {one.after:.1f} s: took {one.seconds:.1f} s{left}", flush=True)
    finally:
        print(summary(results), flush=True)
    return all(one.fine for one in results)


def attempts(count: int, within: float, seed: int = 0) -> Iterator[Attempt]:
    """Starts a small run again and again, and ends it by SIGINT and SIGTERM in turn.

    Args:
      count: how often.
      within: seconds in which the time of the signal is drawn uniformly; the start of the run is part of them.
      seed: of the times.
    """
    times = random.Random(seed)
    for number in range(count):
        with tempfile.TemporaryDirectory(prefix="congrasp-") as folder:
            command = [sys.executable, "-m", "congrasp", *SMALL, "--run-dir", str(pathlib.Path(folder, "run"))]
            yield attempt(command, times.uniform(0.0, within), signal.SIGTERM if number % 2 else signal.SIGINT)


def summary(results: Sequence[Attempt]) -> str:
    """One line about attempts."""
    seconds = [one.seconds for one in results] or [0.0]
    return (
        f"{sum(one.fine for one in results)} of {len(results)} ended within {LIMIT:g} s with no orphan; "
        f"median {statistics.median(seconds):.2f} s, longest {max(seconds):.2f} s, "
        f"{sum(len(one.orphans) for one in results)} orphan(s)"
    )


def attempt(command: Sequence[str], after: float, number: signal.Signals) -> Attempt:
    """Starts a command, signals it after some seconds, and waits until it and all that it started have ended."""
    mark = secrets.token_hex(8)
    run = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, _MARK: mark},
        start_new_session=True,
    )
    try:
        time.sleep(after)
        processes = len(_marked(mark))
        run.send_signal(number)
        began = time.monotonic()
        orphans: tuple[str, ...] | None = None
        while time.monotonic() - began < PATIENCE:
            ended = run.poll() is not None
            alive = _marked(mark)
            if ended and orphans is None:
                orphans = tuple(map(_command_line, alive))
            if ended and not alive:
                return Attempt(number.name, after, processes, time.monotonic() - began, orphans or (), run.returncode)
            time.sleep(_LOOK)
        left = tuple(map(_command_line, _marked(mark)))
        return Attempt(number.name, after, processes, float("inf"), left, run.poll() or 0)
    finally:
        for process in _marked(mark):
            process.kill()
        run.wait()


def _marked(mark: str) -> list[psutil.Process]:
    """Processes of an attempt that live, whoever their parent is by now."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get(_MARK) == mark and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except (psutil.Error, OSError):
            continue
    return found


def _command_line(process: psutil.Process) -> str:
    """How a process was started."""
    try:
        return " ".join(process.cmdline()[2:]) or process.name()
    except psutil.Error:
        return "a process that has just ended"
