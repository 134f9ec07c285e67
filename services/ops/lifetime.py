"""Lifetime of a process and its children: signals drain it within a few seconds, and its children
end with it.
"""

import contextlib
import ctypes
import dataclasses
import os
import pathlib
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence

from congrasp.common.errors import os_errors_as
from congrasp.common.io.opening import open_to_append
from congrasp.common.runtime.environment import child_environment

GRACE = 3.5
"""Longest time between a signal and the end of the process, s."""
CHILD_GRACE = 2.0
"""Seconds for a child to drain; the rest of `GRACE` remains to kill it before this process must
end.
"""
SIGNALS = "signals"
"""Name of the thread that acts on signals; it runs no native code."""
_PARENT = (
    "CONGRASP_PARENT"  # environment variable with which a process makes its children end with it
)
_POLL = 0.5
_LAST = 10_000  # bytes of a log in which its last line is looked for
_REAP = 0.5  # deadline for the end of all children, s
_children: weakref.WeakSet[subprocess.Popen[bytes]] = weakref.WeakSet()


class Stop(threading.Event):
    """Event set by the first SIGINT or SIGTERM; loops poll it or wait on it.

    Attributes:
      signal: number of the received signal, or None.
    """

    def __init__(self) -> None:
        super().__init__()
        self.signal: int | None = None

    @property
    def exit_code(self) -> int:
        """Exit code of a process that a signal ended, for the shell; zero without a signal."""
        return 128 + self.signal if self.signal else 0


@contextlib.contextmanager
def on_signal(grace: float = GRACE, *, interrupt: bool = False) -> Iterator[Stop]:
    """Context with a `Stop` that signals set; outside the main thread, which alone Python signals,
    nothing sets it.

    Python runs handlers between two bytecodes of the main thread, which may be inside a compiler
    for a minute. The interpreter's wake-up file descriptor is written at once, so a thread that
    reads it sets the event. It ends the process if it is still running after `grace` seconds, or at
    once on a second signal, from the user or from the kernel because the parent has ended
    (`follow_parent`).

    Args:
      grace: seconds from the signal to the forced end.
      interrupt: also raises KeyboardInterrupt in the main thread, for code that does not poll.
    """
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)

    def watch() -> None:
        number = reader.recv(1)
        if not number:
            return
        stop.signal = number[0]
        stop.set()
        ends = time.monotonic() + grace
        reader.settimeout(grace)
        with contextlib.suppress(TimeoutError):
            if not reader.recv(1):  # the block has ended; later code has the remaining time
                time.sleep(max(0.0, ends - time.monotonic()))
        _end(stop.exit_code)

    def handle(number: int, frame: object) -> None:
        if interrupt:
            raise KeyboardInterrupt

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    wakeup = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=watch, daemon=True, name=SIGNALS).start()
    try:
        yield stop
    finally:
        signal.set_wakeup_fd(wakeup)
        for number, handler in previous.items():
            signal.signal(number, handler)
        writer.close()


def _end(code: int) -> None:
    """Ends this process at once, after its children."""
    children = list(_children)
    for child in children:
        child.kill()
    wait_for(children, _REAP)
    os._exit(code)


def follow_parent() -> None:
    """Requests SIGTERM from the kernel for the parent's death, if the parent asked for it (Linux
    only).
    """
    parent = os.environ.pop(_PARENT, None)
    if parent is None or not sys.platform.startswith("linux"):
        return
    pr_set_pdeathsig = 1
    ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGTERM)
    if os.getppid() != int(parent):
        os.kill(os.getpid(), signal.SIGTERM)


def command(*words: object, **options: object) -> list[str]:
    """Arguments of congrasp: words, then options by name; None and False leave one out, and a tuple
    has many values.
    """
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
    begun: int = 0
    """Bytes of the log when the process started."""

    @property
    def program(self) -> list[str]:
        """Command line of the process."""
        return [sys.executable, "-P", "-m", "congrasp", *self.arguments]

    def start(self) -> int:
        """Starts it in a separate session, so that Ctrl-C reaches only the orchestrator; it dies
        with its parent.
        """
        # Unfiltered, so that the last line of the log is the error, and not JAX's note on filtered
        # frames.
        jax = {"JAX_TRACEBACK_FILTERING": "off"}
        own = {**self.environment, _PARENT: str(os.getpid())}
        environment = {**jax, **child_environment(**own)}
        with os_errors_as(f"{self.log} cannot be opened"):
            opened = open_to_append(self.log)
        with opened as log:
            self.begun = log.seek(0, os.SEEK_END)
            self.process = subprocess.Popen(
                self.program,
                stdout=log,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env=environment,
                start_new_session=True,
            )
        _children.add(self.process)  # which a forced end of this process kills as well
        return self.process.pid

    @property
    def code(self) -> int | None:
        """Its exit code; None before it starts and while it runs."""
        return self.process.poll() if self.process else None

    def last_line(self) -> str:
        """The last line that it wrote to its log."""
        with contextlib.suppress(FileNotFoundError), self.log.open("rb") as log:
            log.seek(max(self.begun, log.seek(0, os.SEEK_END) - _LAST))
            if lines := log.read().decode(errors="replace").strip().splitlines():
                return lines[-1].removeprefix("congrasp: error: ")
        return "its log is empty"

    def death(self) -> str:
        """Its end in a sentence: the signal that killed it, or its exit code and last line."""
        if self.code is not None and self.code < 0:
            return f"The {self.name} was killed by {signal.Signals(-self.code).name}."
        return f"The {self.name} died (exit code {self.code}): {self.last_line().rstrip('. ')}."


def wait_for(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> None:
    """Waits until all have ended, for at most `seconds`."""
    deadline = time.monotonic() + seconds
    for process in processes:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, deadline - time.monotonic()))


def end_all(children: Sequence[Child]) -> None:
    """Sends SIGTERM to all, and SIGKILL to those that have not drained within `CHILD_GRACE`
    seconds.
    """
    running = [child.process for child in children if child.process and child.code is None]
    for process in running:
        process.terminate()
    wait_for(running, CHILD_GRACE)
    for process in running:
        if process.poll() is None:
            process.kill()
            process.wait()


def run_child(
    child: Child, patience: float, progress: Callable[[str], None] = lambda line: None
) -> int | None:
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
