"""Handling of Ctrl-C and SIGTERM: drains within a few seconds."""

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Iterator

GRACE = 3.5
"""Longest time between a signal and the end of the process, s."""
PARENT_VARIABLE = "CONGRASP_PARENT"
"""Environment variable with which a process makes its children end with it."""
SIGNALS = "signals"
"""Name of the thread that acts on signals; it runs no native code."""
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
    """Context with a `Stop` that signals set; outside the main thread, which alone Python signals, nothing sets it.

    Python runs handlers between two bytecodes of the main thread, which may be inside a compiler for a minute. The
    interpreter's wake-up file descriptor is written at once, so a thread that reads it sets the event. It ends the
    process if it is still running after `grace` seconds, or at once on a second signal, from the user or from the
    kernel because the parent has ended (`follow_parent`).

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


def register_child(child: subprocess.Popen[bytes]) -> None:
    """Registers a child, which a forced end of this process kills as well."""
    _children.add(child)


def _end(code: int) -> None:
    """Ends this process at once, after its children."""
    children = list(_children)
    for child in children:
        child.kill()
    deadline = time.monotonic() + _REAP
    for child in children:
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(max(0.0, deadline - time.monotonic()))
    os._exit(code)


def follow_parent() -> None:
    """Requests SIGTERM from the kernel for the parent's death, if the parent asked for it (Linux only)."""
    parent = os.environ.pop(PARENT_VARIABLE, None)
    if parent is None or not sys.platform.startswith("linux"):
        return
    pr_set_pdeathsig = 1
    ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGTERM)
    if os.getppid() != int(parent):
        os.kill(os.getpid(), signal.SIGTERM)
