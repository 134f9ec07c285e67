"""Lifetime of a process and its children: signals drain it within a few seconds, and its children
end with it.
"""

import contextlib
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
from typing import Any

from congrasp.common.errors import os_errors_as
from congrasp.common.io.opening import open_to_append
from congrasp.common.runtime import platforms
from congrasp.common.runtime.process_variables import child_environment
from congrasp.services.ops import causes

GRACE_S = 3.5
"""Longest time between a signal and the end of the process."""
GRACE_WITHOUT_CHILDREN_S = 1.7
"""The same for a command that a signal interrupts and that has no children: it has nothing to
drain, and its files are complete or absent."""
CHILD_GRACE_S = 2.0
"""Longest time for a child to drain. It is shorter than `GRACE_S`, so that this process has time
left to kill the child.
"""
SIGNALS = "signals"
"""Name of the thread that acts on signals; it runs no native code."""
PARENT_VARIABLE = "CONGRASP_PARENT"
"""Environment variable with the parent's process number, which makes a child end with it."""
POLL_S = 0.5
"""Time between two checks of a child."""
MAX_PAUSE_S = 15.0
"""Limit of the time before a restart of a child that died."""
_KILL_TIMEOUT_S = 0.5
"""Deadline for the end of all killed children."""
_children: weakref.WeakSet[subprocess.Popen[bytes]] = weakref.WeakSet()


class Stop(threading.Event):
    """Event set by the first signal of `STOP_SIGNALS`; loops poll it or wait on it.

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

    @property
    def reason(self) -> str:
        """Phrase for the last line of a process that was stopped."""
        return f"stopped by {signal.Signals(self.signal).name}" if self.signal else "stopped"


def stopped_line(exit_code: int) -> str:
    """Returns the last line of a command that ended with the exit code of a signal."""
    number = signal.Signals(exit_code - 128)
    if number == signal.SIGINT:
        return "Stopped by Ctrl-C."
    return f"Stopped by {number.name}."


@contextlib.contextmanager
def on_signal(grace: float | None = None, *, interrupt: bool = False) -> Iterator[Stop]:
    """Yields a Stop that the first signal sets. Python handles signals only in the main thread;
    elsewhere it is never set.

    Python runs handlers between two bytecodes of the main thread, which may be inside a compiler
    for a minute. The interpreter writes to its wake-up file descriptor at once, so a thread that
    reads it sets the event. That thread ends the process after `grace` seconds, or at once on a
    second signal: from the user, or from the kernel because the parent has ended (`follow_parent`).

    Args:
      grace: seconds from the signal to the forced end; by default that of `_default_grace`.
      interrupt: also raises KeyboardInterrupt in the main thread, for code that does not poll.
    """
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)

    def handle(number: int, frame: object) -> None:
        if interrupt:
            raise KeyboardInterrupt

    obeyed = [number for number in platforms.STOP_SIGNALS if _is_obeyed(number)]
    previous_handlers = {number: signal.signal(number, handle) for number in obeyed}
    previous_wakeup = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    watch = threading.Thread(
        target=_watch_signals, args=(reader, stop, grace, interrupt), daemon=True, name=SIGNALS
    )
    watch.start()
    try:
        yield stop
    finally:
        signal.set_wakeup_fd(previous_wakeup)
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)
        writer.close()


def _is_obeyed(number: signal.Signals) -> bool:
    """False for the signal of a closed terminal under `nohup`, which ignores it."""
    return number.name != "SIGHUP" or signal.getsignal(number) is not signal.SIG_IGN


def _default_grace(interrupt: bool) -> float:
    """Seconds from a signal to the forced end of this process."""
    has_children = any(child.poll() is None for child in list(_children))
    if interrupt and not has_children:
        return GRACE_WITHOUT_CHILDREN_S
    return GRACE_S


def _watch_signals(reader: socket.socket, stop: Stop, grace: float | None, interrupt: bool) -> None:
    """Sets `stop` at the first signal, and ends the process after some seconds or at the second
    signal.

    Args:
      reader: has a byte for each signal; its other end is closed when the context has ended.
      stop: the event.
      grace: seconds to the forced end; by default `GRACE_S`, or `GRACE_WITHOUT_CHILDREN_S`.
      interrupt: True if signals also raise KeyboardInterrupt in the main thread.
    """
    numbers = reader.recv(1)
    if not numbers:
        return
    stop.signal = platforms.stop_signal(numbers[0])
    stop.set()
    grace_s = grace or _default_grace(interrupt)
    deadline = time.monotonic() + grace_s
    cause = f"it did not end within {grace_s:g} s"
    reader.settimeout(grace_s)
    try:
        if reader.recv(1):
            cause = "a second signal came"
        else:
            # The context has ended; later code has the remaining time.
            time.sleep(max(0.0, deadline - time.monotonic()))
    except TimeoutError:
        pass
    _write_last_line(f"The process was {stop.reason} and ended at once: {cause}.")
    _end(stop.exit_code)


def _write_last_line(text: str) -> None:
    """Writes a line to the standard error, even while another thread holds its lock."""
    with contextlib.suppress(OSError):
        os.write(2, f"congrasp: {text}\n".encode())


def _end(code: int) -> None:
    """Kills this process's children and ends it at once."""
    children = list(_children)
    for child in children:
        child.kill()
    wait_for(children, _KILL_TIMEOUT_S)
    os._exit(code)


def follow_parent() -> None:
    """Makes this process receive SIGTERM when its parent has ended, if the parent requested it (a
    `Child` sets `PARENT_VARIABLE`).
    """
    parent = os.environ.pop(PARENT_VARIABLE, None)
    if parent is not None:
        platforms.terminate_with(int(parent))


def command(*words: object, **options: object) -> list[str]:
    """Returns the arguments of a congrasp command: words, then options by name.

    An option with None or False is left out, True is a flag, and a tuple has several values.
    """
    arguments = [str(word) for word in words]
    for name, value in options.items():
        if value is None or value is False:
            continue
        arguments.append(f"--{name.replace('_', '-')}")
        if isinstance(value, tuple):
            arguments += map(str, value)
        elif value is not True:
            arguments.append(str(value))
    return arguments


@dataclasses.dataclass
class Child:
    """A process of the run."""

    name: str
    arguments: list[str]
    """Words of its command after `congrasp`."""
    log: pathlib.Path | None
    """File that gets its output; None if it writes to the output of this process."""
    environment: dict[str, str] = dataclasses.field(default_factory=dict)
    """Variables in addition to those of this process."""
    process: subprocess.Popen[bytes] | None = None
    """None before it starts."""
    restarts: int = 0
    deaths: int = 0
    """Deaths since the run last made progress."""
    again_at: float = 0.0
    """Time of its next start (`time.monotonic`) after it died; 0 while none is planned."""
    log_start: int = 0
    """Size of the log when the process started, bytes."""
    memory_kills: int = 0
    """Processes that the kernel had killed for memory when this one started."""

    @property
    def program(self) -> list[str]:
        """Command line of the process; modules in the working folder, such as a user's random.py,
        are not imported.
        """
        return [sys.executable, "-P", "-m", "congrasp", *self.arguments]

    def start(self) -> int:
        """Starts it in a separate session, so that Ctrl-C reaches only the orchestrator; it dies
        with its parent.
        """
        additions = {**self.environment, PARENT_VARIABLE: str(os.getpid())}
        environment = child_environment(**additions)
        # Unfiltered, so that the last line of the log is the error, and not JAX's note on filtered
        # frames.
        environment.setdefault("JAX_TRACEBACK_FILTERING", "off")
        self.memory_kills = _memory_kills()
        with contextlib.ExitStack() as opened:
            streams: dict[str, Any] = {}
            if self.log is not None:
                with os_errors_as(f"{self.log} cannot be opened"):
                    log = opened.enter_context(open_to_append(self.log))
                self.log_start = log.seek(0, os.SEEK_END)
                streams = {"stdout": log, "stderr": subprocess.STDOUT}
            self.process = subprocess.Popen(
                self.program,
                stdin=subprocess.DEVNULL,
                env=environment,
                **streams,
                **platforms.separate_session(),
            )
        _children.add(self.process)  # a forced end of this process kills it as well
        return self.process.pid

    def restart(self) -> None:
        """Starts it again after it died."""
        self.deaths += 1
        self.restarts += 1
        self.again_at = 0.0
        self.start()

    @property
    def pause(self) -> float:
        """Seconds before its next restart: 0, 1, 3, 7, then 14."""
        return min(2.0**self.deaths, MAX_PAUSE_S) - 1.0

    @property
    def code(self) -> int | None:
        """Its exit code; None before it starts and while it runs."""
        if self.process is None:
            return None
        return self.process.poll()

    def last_line(self) -> str:
        """The last line that it wrote to its log."""
        return causes.last_line(self._output()) or "its log is empty"

    def cause(self) -> str:
        """The cause of its end by its log, else the log's last line, as a sentence."""
        cause = causes.cause_in(self._output()) or self.last_line()
        return f"{cause.rstrip('. ')}."

    def death(self) -> str:
        """Describes its end in a sentence: the signal or the exit code, and the cause."""
        code = self.code or 0
        kernel_killed = _memory_kills() > self.memory_kills
        return causes.end_of(self.name, code, self._output(), kernel_killed=kernel_killed)

    def _output(self) -> str:
        """Its log since it started, or the end of it."""
        if self.log is None:
            return "its last lines are above"
        return causes.read_end(self.log, self.log_start)


def _memory_kills() -> int:
    """See `common.runtime.resources.memory_kills`, whose module a client's installation lacks."""
    from congrasp.common.runtime.resources import memory_kills

    return memory_kills()


def wait_for(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> None:
    """Waits until all have ended, for at most `seconds`."""
    deadline = time.monotonic() + seconds
    for process in processes:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, deadline - time.monotonic()))


def end_all(children: Sequence[Child]) -> None:
    """Sends SIGTERM to all, and SIGKILL to those that have not drained within `CHILD_GRACE_S`
    seconds.
    """
    running = [child.process for child in children if child.process and child.code is None]
    for process in running:
        platforms.request_end(process)
    wait_for(running, CHILD_GRACE_S)
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
    deadline = time.monotonic() + patience
    try:
        child.start()
        while child.code is None and time.monotonic() < deadline:
            progress(child.last_line())
            time.sleep(POLL_S)
        code = child.code
    finally:
        end_all([child])
    return code
