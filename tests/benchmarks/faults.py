"""What a run loses when it is killed, stopped, frozen, out of disk and damaged: every kind of
fault, many times.

Each kind has a run of its own, which continues after every fault; afterwards `congrasp audit`
judges its journals.
"""

import contextlib
import errno
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
from typing import Any, NamedTuple

import psutil
from rich.console import Console
from rich.table import Table

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message
from congrasp.services.ops.audit import FAULTS as KINDS
from congrasp.services.ops.audit import Report
from congrasp.services.ops.audit import compare as audit
from congrasp.services.train.launch import LAUNCH_FILE, read_launch
from tests.children import following

_RUN = "quickstart"
_OPTIONS = (
    *(
        "--updates",
        "1000000",
        "--environments",
        "8",
        "--rollout-steps",
        "25",
        "--checkpoint-every",
        "2",
    ),
    *(
        "--objects.count",
        "2",
        "--objects.families",
        "box",
        "--network.hidden",
        "32",
        "--network.encoder",
        "8",
    ),
    *("--ppo.epochs", "1", "--ppo.minibatches", "2", "--collapse-patience", "0"),
    *("--log-rollout-every", "0", "--episode-every", "1000000", "--metric-writers"),
)
_DEADLINE = 180.0  # seconds that anything may take
_END = 15.0  # seconds in which a run must end that was signalled
_DISK = 24 << 20  # bytes of the disk that is filled
_FROZEN = 4.0  # seconds, longer than a lease
_FULL = 3.0  # seconds that a disk stays full
_TRAINS = (0.5, 3.0)  # seconds of training before a fault
_OF_A_CHILD = ("kill-learner", "kill-actor", "freeze-learner", "freeze-actor")
"""Faults after which `congrasp train` must continue, however often they occur."""


class Run:
    """A small real run of `congrasp train` in a directory, which can be killed, stopped, resumed
    and observed.
    """

    def __init__(
        self,
        run_dir: pathlib.Path,
        actors: int,
        options: Sequence[str] = _OPTIONS,
        output: int = subprocess.DEVNULL,
    ):
        """Starts nothing yet; `output` takes what it prints."""
        self.run_dir = run_dir
        self._count = actors
        self._options = options
        self._output = output
        self._transport: Transport | None = None
        self.process: psutil.Popen | None = None

    def start(self) -> None:
        """Begins the run, or resumes it, and waits until its learner has taken rollouts from all
        actors.
        """
        command = [
            sys.executable,
            "-m",
            "congrasp",
            "train",
            "--run-dir",
            str(self.run_dir),
            *self._options,
        ]
        command += ["--actors", str(self._count), "--evaluation", "0"]
        command += ["--resume"] if (self.run_dir / "config.json").exists() else []
        self.process = psutil.Popen(
            command, stdout=self._output, stderr=subprocess.STDOUT, text=True, env=following()
        )
        self._transport = urls.connect(self.until(self._endpoint), "observer", wait=_DEADLINE)
        self.until(lambda: len(seen := self._rollouts()) >= self._count and min(seen) > 1)

    def stop(self, number: signal.Signals = signal.SIGINT) -> None:
        """Signals the run and waits until it has ended; it is killed if that takes too long."""
        if self.process is None:
            return
        with contextlib.suppress(psutil.NoSuchProcess):
            self.process.send_signal(number)
        try:
            self.process.wait(_END)
        except psutil.TimeoutExpired:
            self.kill()
        self.close()

    def kill(self) -> None:
        """Kills all processes of the run at once."""
        assert self.process is not None
        family = [self.process, *self.process.children(recursive=True)]
        for one in family:
            with contextlib.suppress(psutil.NoSuchProcess):
                one.kill()
        psutil.wait_procs(family, _END)
        self.close()

    def close(self) -> None:
        """Closes the observer; the run continues."""
        if self._transport is not None:
            self._transport.close()
        self._transport = None

    @property
    def alive(self) -> bool:
        """True while the run is there."""
        return self.process is not None and self.process.poll() is None

    def children(self, role: str) -> list[psutil.Process]:
        """The run's processes of a role, oldest first."""
        assert self.process is not None
        with contextlib.suppress(psutil.NoSuchProcess):
            return sorted(
                (c for c in self.process.children() if role in c.cmdline()),
                key=lambda c: c.create_time(),
            )
        return []

    def child(self, role: str) -> psutil.Process:
        """The oldest process of a role, once there is one."""
        children: list[psutil.Process] = self.until(lambda: self.children(role))
        return children[0]

    def until(self, look: Callable[[], Any]) -> Any:
        """As the function `until`; a CongraspError with the run's output if that ends before."""
        seen = until(lambda: look() or not self.alive)
        if not self.alive:
            assert self.process is not None
            output = self.process.communicate()[0] or ""
            raise CongraspError(
                f"The run ended by itself. {output}", f"Look at {self.run_dir / 'logs'}."
            )
        return seen

    def status(self) -> dict[str, Any]:
        """The learner's status; empty while there is none."""
        assert self._transport is not None
        with contextlib.suppress(TransportError):
            return dict(self._transport.query(Keys(_RUN).status, Message(), timeout=0.5).meta)
        return {}

    def _rollouts(self) -> list[int]:
        """Rollouts of each actor that is there."""
        return [
            role.get("rollouts", 0)
            for role in self.status().get("roles", ())
            if role["role"] == "actor"
        ]

    def _endpoint(self) -> str | None:
        """Where the learner listens; None before it has started."""
        if not self.children("learner"):
            return None
        return read_launch(self.run_dir / LAUNCH_FILE).endpoint


def until(look: Callable[[], Any]) -> Any:
    """Returns what `look` does once that is something; a CongraspError if it takes too long."""
    deadline = time.monotonic() + _DEADLINE
    while not (seen := look()):
        if time.monotonic() > deadline:
            raise CongraspError(
                f"Nothing happened within {_DEADLINE:g} s.", "Is the machine busy otherwise?"
            )
        time.sleep(0.02)
    return seen


Fault = Callable[[Run, random.Random], None]


class Result(NamedTuple):
    """What some faults of one kind came to."""

    kind: str
    seconds: list[float]
    """From each fault, or from when the disk had room again, to the next update."""
    report: Report
    starts: int
    """Times that `congrasp train` was started."""

    @property
    def fine(self) -> bool:
        """True if nothing was lost, duplicated, unmatched or corrupted, and no fault of a child ended
        the run.
        """
        if self.kind in _OF_A_CHILD and self.starts > 1:
            return False
        return not any(self.report.counts[name] for name in KINDS)


def faults(actors: int = 2, repeats: int = 20, kinds: tuple[str, ...] = (), seed: int = 0) -> int:
    """What kills, stops, freezes, full disks and damaged files cost a real run of what it had
    acknowledged: nothing.

    Every kind of fault has a run of its own, whose journals are audited. The exit code is 1 if
    anything was lost, duplicated, unmatched or corrupted, or if deaths of the learner or an actor
    ended the run.

    Args:
      actors: Actor processes.
      repeats: Faults of each kind.
      kinds: Kinds of faults: sigterm, ctrl-c, kill-learner, kill-actor, kill-all, freeze-learner,
        freeze-actor, full-disk (which needs the right to mount), damage-checkpoint, damage-accepted
        (rollouts), damage-journal, damage-policy. All of them if none is named.
      seed: Seed of the moments, and of the bits that are flipped.

    Examples:
      python -m tests.benchmarks faults
      python -m tests.benchmarks faults --kinds kill-learner kill-actor --repeats 20
    """
    if unknown := set(kinds) - FAULTS.keys():
        raise CongraspError(
            f"There is no fault '{min(unknown)}'.", f"Choose from: {', '.join(FAULTS)}."
        )
    console = Console(width=None if sys.stdout.isatty() else 140)
    results: list[Result] = []
    for kind in kinds or FAULTS:
        disk = _DISK if kind == "full-disk" else 0
        with (
            tempfile.TemporaryDirectory(prefix="congrasp-") as folder,
            small_disk(folder, disk) as there,
        ):
            if not there:
                console.print(f"{kind}: left out, for file systems cannot be mounted here.")
                continue
            results.append(
                _measure(
                    kind, Run(pathlib.Path(folder, "run"), actors), repeats, random.Random(seed)
                )
            )
        last = results[-1]
        verdict = "nothing lost" if last.fine else f"{last.report.faults[:5]}"
        console.print(f"{kind}: {verdict}; {_rest(last)}; `train` started {last.starts} times")
    console.print(_table(results, actors))
    return 0 if all(result.fine for result in results) else 1


def _measure(kind: str, run: Run, repeats: int, rng: random.Random) -> Result:
    """Faults of one kind in one run, and the verdict on it."""
    seconds: list[float] = []
    starts = 0
    try:
        for _ in range(repeats):
            if not run.alive:
                run.start()
                starts += 1
            version = run.until(run.status)["version"]
            time.sleep(rng.uniform(*_TRAINS))
            FAULTS[kind](run, rng)
            began = time.monotonic()
            if not run.alive:
                run.start()
                starts += 1
            run.until(functools.partial(_is_past, run, version + 1))
            seconds.append(time.monotonic() - began)
    finally:
        run.stop()
    return Result(kind, seconds, audit(run.run_dir), starts)


def _is_past(run: Run, version: int) -> bool:
    """Whether the learner has published a newer version."""
    return bool(run.status().get("version", -1) > version)


def _stop(number: signal.Signals) -> Fault:
    """Signals `congrasp train`, and waits until it has ended."""

    def stop(run: Run, rng: random.Random) -> None:
        run.stop(number)

    return stop


def _kill_all(run: Run, rng: random.Random) -> None:
    """Kills learner, actors and what started them, all at once."""
    run.kill()


def _kill_child(role: str) -> Fault:
    """Kills the oldest process of a role."""

    def kill(run: Run, rng: random.Random) -> None:
        run.child(role).kill()

    return kill


def _freeze_child(role: str) -> Fault:
    """Freezes the oldest process of a role for some seconds; its connections stay open and
    silent.
    """

    def freeze(run: Run, rng: random.Random) -> None:
        child = run.child(role)
        child.suspend()
        time.sleep(_FROZEN)
        child.resume()

    return freeze


def _fill_disk(run: Run, rng: random.Random) -> None:
    """Lets the disk of the run be full for some seconds, and kills all processes at the end of
    every second time.
    """
    filler = fill(run.run_dir.parent)
    time.sleep(_FULL)
    if rng.random() < 0.5:
        run.kill()
    filler.unlink()


def _damage(pattern: str, newest: int) -> Fault:
    """Kills all processes, and flips a bit in one of the `newest` files of a pattern, by their
    names.
    """

    def damage(run: Run, rng: random.Random) -> None:
        until(lambda: list(run.run_dir.glob(pattern)))
        run.kill()
        if files := sorted(run.run_dir.glob(pattern))[-newest:]:
            path = rng.choice(files)
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
def small_disk(folder: str, size: int) -> Iterator[bool]:
    """Makes a folder a disk of `size` bytes, if that is above 0; yields False if that cannot be
    mounted.
    """
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder]
    if size and (
        not shutil.which("mount")
        or subprocess.run(command, capture_output=True, timeout=10).returncode
    ):
        yield False
        return
    try:
        yield True
    finally:
        if size:
            subprocess.run(["umount", "-l", folder], timeout=10, check=True)


def fill(disk: pathlib.Path) -> pathlib.Path:
    """Fills a disk; returns the file that does."""
    filler = disk / "filler"
    try:
        with filler.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(1024))
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
    return filler


def _rest(result: Result) -> str:
    """The outcomes of a kind's rollouts that are no fault, and damage to the journals."""
    counts = {name: count for name, count in result.report.counts.items() if count}
    return f"{counts}, lines damaged {result.report.damaged}, missing {result.report.holes}"


def _table(results: Sequence[Result], actors: int) -> Table:
    """A row for each kind."""
    columns = (
        "repeats",
        "starts",
        "accepted",
        "survived",
        *KINDS,
        "damaged on disk",
        "median, s",
        "longest, s",
    )
    table = Table("fault", title=f"{actors} actors")
    for column in columns:
        table.add_column(column, justify="right")
    for kind, seconds, report, starts in results:
        counts = report.counts
        survived = counts["used"] + counts.get("waiting", 0)
        numbers = [
            len(seconds),
            starts,
            counts["accepted"],
            survived,
            *(counts[name] for name in KINDS),
            counts.get("damaged on disk", 0),
        ]
        times = [f"{statistics.median(seconds):.1f}", f"{max(seconds):.1f}"]
        table.add_row(kind, *map(str, numbers), *times)
    return table
