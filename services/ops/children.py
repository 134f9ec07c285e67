"""Child processes of congrasp: their command lines, start and end."""

import contextlib
import dataclasses
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

from congrasp.services.ops.shutdown import PARENT_VARIABLE, register_child

CHILD_GRACE = 2.0
"""Seconds for a child to drain; the rest of `GRACE` remains to kill it before this process must end."""
_POLL = 0.5


def command(*words: object, **options: object) -> list[str]:
    """Arguments of congrasp: words, then options by name; None and False leave one out, and a tuple has many values."""
    arguments = list(map(str, words))
    for name, value in options.items():
        if value is not None and value is not False:
            values = value if isinstance(value, tuple) else () if value is True else (value,)
            arguments += [f"--{name.replace('_', '-')}", *map(str, values)]
    return arguments


@dataclasses.dataclass
class Child:
    """A process of the run."""

    name: str
    arguments: list[str]
    log: pathlib.Path
    environment: dict[str, str] = dataclasses.field(default_factory=dict)
    process: subprocess.Popen[bytes] | None = None
    restarts: int = 0
    again_at: float = 0.0

    def start(self) -> int:
        """Starts it in a separate session, so that Ctrl-C reaches only the orchestrator; it dies with its parent."""
        # Unfiltered, so that the last line of the log is the error, and not JAX's note on filtered frames.
        jax = {"JAX_TRACEBACK_FILTERING": "off"}
        environment = {**jax, **os.environ, **self.environment, PARENT_VARIABLE: str(os.getpid())}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "congrasp", *self.arguments],
                stdout=log,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env=environment,
                start_new_session=True,
            )
        register_child(self.process)
        return self.process.pid

    @property
    def code(self) -> int | None:
        """Its exit code; None before it starts and while it runs."""
        return self.process.poll() if self.process else None

    def last_line(self) -> str:
        """The last line of its log."""
        lines = self.log.read_text(errors="replace").strip().splitlines() if self.log.exists() else []
        return lines[-1].removeprefix("congrasp: error: ") if lines else "its log is empty"


def wait_for(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> None:
    """Waits until all have ended, for at most `seconds`."""
    deadline = time.monotonic() + seconds
    for process in processes:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, deadline - time.monotonic()))


def end_all(children: Sequence[Child]) -> None:
    """Sends SIGTERM to all, and SIGKILL to those that have not drained within `CHILD_GRACE` seconds."""
    running = [child.process for child in children if child.process and child.code is None]
    for process in running:
        process.terminate()
    wait_for(running, CHILD_GRACE)
    for process in running:
        if process.poll() is None:
            process.kill()
            process.wait()


def run_child(child: Child, patience: float, progress: Callable[[str], None] = lambda line: None) -> int | None:
    """Runs a command in a separate process, which has ended on return in any case.

    Args:
      child: the command, not started yet.
      patience: seconds after which it is terminated.
      progress: called several times a second with its last line of output.

    Returns:
      Its exit code; None if it was terminated.
    """
    began = time.monotonic()
    try:
        child.start()
        while (code := child.code) is None and time.monotonic() - began < patience:
            progress(child.last_line())
            time.sleep(_POLL)
    finally:
        end_all([child])
    return code
