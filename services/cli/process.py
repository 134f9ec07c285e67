"""The process of a command: its output streams, the interpreter's options, and its end."""

import io
import os
import signal
import sys
import threading
import warnings
from typing import NoReturn, TextIO

from congrasp.common.runtime.platforms import STOP_SIGNALS, replace_process
from congrasp.common.runtime.process_variables import child_environment
from congrasp.services.ops.lifetime import SIGNALS

SIGNALLED = tuple(128 + number for number in STOP_SIGNALS)
"""Exit codes after a signal."""
_INSPECT = "PYTHONINSPECT"
_NEEDED_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGCHLD")
"""Signals that a command or its children need."""
_QUIET_WARNINGS = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)
"""Categories that Python itself ignores."""


def prepare_streams() -> None:
    """Replaces output streams that the shell closed; unencodable characters become escapes."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def restore_signals() -> None:
    """Undoes settings of signals that a command inherits from the program that starts it.

    If the ends of children are ignored, their exit codes are lost: a process that died would count
    as finished. Blocked signals would not stop the command.
    """
    if not hasattr(signal, "pthread_sigmask"):
        return
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.Signals[name] for name in _NEEDED_SIGNALS])


def undo_interpreter_options() -> None:
    """Undoes the interpreter's options that change what a command does: removed docstrings, which
    are the help, an interactive end, which loses the exit code, and filters that turn warnings into
    errors.
    """
    is_inspected = sys.flags.inspect and _INSPECT in os.environ
    if sys.flags.optimize > 1 or is_inspected:
        command = [sys.executable, "-m", "congrasp", *sys.argv[1:]]
        replace_process(command, child_environment())
    if sys.warnoptions:
        sys.warnoptions.clear()
        warnings.resetwarnings()
        for category in _QUIET_WARNINGS:
            warnings.simplefilter("ignore", category)


def write_if_possible(stream: TextIO, text: str = "") -> bool:
    """Writes and flushes, and returns True; on an error, such as a full disk of a log, discards
    this and later output, and returns False. The exit code then stays the command's.
    """
    try:
        stream.write(text)
        stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        return False
    return True


def end_process(code: int, *, owns_process: bool) -> NoReturn:
    """Ends the process with an exit code, without the interpreter's shutdown where that may hang.

    Native code of a daemon thread that is late, such as one that closes Zenoh, aborts in the
    shutdown. The shutdown also waits for other threads, such as one that compiles kernels for
    minutes: after a failure, for nothing.

    Args:
      code: the exit code.
      owns_process: True if no other code uses this process.
    """
    write_if_possible(sys.stdout)
    if code in SIGNALLED or (owns_process and _has_late_thread(code)):
        write_if_possible(sys.stderr)
        os._exit(code)
    sys.exit(code)


def _has_late_thread(code: int) -> bool:
    """Returns True if a thread runs for which the shutdown must not, or need not, wait."""
    for thread in threading.enumerate():
        if thread is threading.main_thread() or thread.name == SIGNALS:
            continue
        if thread.daemon or code:
            return True
    return False
