"""A real run of `congrasp train` that benchmarks kill, stop and start again, and a look at it from outside."""

import contextlib
import pathlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import psutil

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message

_RUN = "quickstart"
_SMALL = (
    *("--updates", "1000000", "--environments", "8", "--rollout-steps", "25"),
    *("--objects.count", "2", "--objects.families", "box", "--network.hidden", "32", "--network.encoder", "8"),
    *("--ppo.epochs", "1", "--ppo.minibatches", "2", "--collapse-patience", "0"),
)
_DEADLINE = 180.0
END_SECONDS = 15.0
"""In which a run must end that was told to."""


class RunUnderTest:
    """A small run in a directory; its processes can be looked up, and what its learner says of it."""

    def __init__(self, run_dir: pathlib.Path, actors: int, options: Sequence[str]):
        """Starts nothing yet.

        Args:
          run_dir: where the run is, or will be.
          actors: actor processes.
          options: of `congrasp train` for a new run, beside those that make it small.
        """
        self.run_dir, self.count = run_dir, actors
        self._options = options
        self._transport: Transport | None = None
        self.process: psutil.Popen | None = None

    def start(self) -> None:
        """Begins the run, or resumes it, and waits until its learner has taken rollouts from all actors."""
        command = [sys.executable, "-m", "congrasp", "train", "--run-dir", str(self.run_dir)]
        begun = (self.run_dir / "config.json").exists()
        command += [
            "--metric-writers",
            "--actors",
            str(self.count),
            "--evaluation",
            "0",
            *(["--resume"] if begun else []),
        ]
        command += [] if begun else [*_SMALL, *self._options]
        self.process = psutil.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        endpoint = until(lambda: self._argument("learner", "--listen"))
        self._transport = urls.connect(endpoint, "observer", wait=_DEADLINE)
        until(lambda: len(seen := self.actors()) >= self.count and min(seen.values()) > 1)

    def stop(self, number: signal.Signals = signal.SIGINT) -> None:
        """Signals the run and waits until it has ended; it is killed if that takes too long."""
        if self.process is None:
            return
        with contextlib.suppress(psutil.NoSuchProcess):
            self.process.send_signal(number)
        try:
            self.process.wait(END_SECONDS)
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
        psutil.wait_procs(family, END_SECONDS)
        self.close()

    def close(self) -> None:
        """Stops looking; the run goes on."""
        if self._transport is not None:
            self._transport.close()
        self._transport = None

    @property
    def alive(self) -> bool:
        """Whether it has been started, and goes on."""
        return self.process is not None and self.process.poll() is None

    def children(self, role: str) -> list[psutil.Process]:
        """The run's processes of a role, oldest first."""
        assert self.process is not None
        with contextlib.suppress(psutil.NoSuchProcess):
            return sorted((c for c in self.process.children() if role in c.cmdline()), key=lambda c: c.create_time())
        return []

    def child(self, role: str) -> psutil.Process:
        """The oldest process of a role, once there is one."""
        found: list[psutil.Process] = until(lambda: self.children(role))
        return found[0]

    def status(self) -> dict[str, Any]:
        """The learner's; empty while there is none."""
        assert self._transport is not None
        with contextlib.suppress(TransportError):
            return dict(self._transport.query(Keys(_RUN).status, Message(), timeout=0.5).meta)
        return {}

    def actors(self) -> dict[str, int]:
        """Rollouts by incarnation of the actors that are there."""
        return {r["incarnation"]: r.get("rollouts", 0) for r in self.status().get("roles", ()) if r["role"] == "actor"}

    def accepted(self) -> int:
        """Rollouts so far."""
        return int(until(self.status)["counters"]["accepted"])

    def _argument(self, role: str, name: str) -> str | None:
        """An option's value in the command line of the oldest process of a role."""
        if not self.alive:
            raise CongraspError(f"The run in {self.run_dir} ended by itself.", f"Look at {self.run_dir / 'logs'}.")
        return next((c.cmdline()[c.cmdline().index(name) + 1] for c in self.children(role)), None)


def until(look: Callable[[], Any]) -> Any:
    """What `look` gives once that is something; a CongraspError if it takes too long."""
    deadline = time.monotonic() + _DEADLINE
    while not (seen := look()):
        if time.monotonic() > deadline:
            raise CongraspError(f"Nothing happened within {_DEADLINE:g} s.", "Is the machine busy otherwise?")
        time.sleep(0.02)
    return seen
