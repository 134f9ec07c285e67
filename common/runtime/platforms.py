"""Differences between Linux, macOS and Windows, and replacements for what a system lacks.

The other modules call these functions and never ask for the name of the system. Only the standard
library is imported here at first, since a policy client has NumPy and Zenoh alone.
"""

import contextlib
import ctypes
import os
import pathlib
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

try:
    import resource
except ModuleNotFoundError:  # Windows
    resource = None  # type: ignore[assignment]

_IS_LINUX = sys.platform == "linux"
_CHECK_S = 0.5
"""Time between two checks whether another process runs."""
_REPLACE_S = 2.0
"""Time for other processes to close a file that Windows does not replace while it is open."""
_RETRY_S = 0.02
_SIGBREAK = getattr(signal, "SIGBREAK", None)
"""Signal of Windows that one process can send to another, as Ctrl-Break."""

HAS_LOOPBACK_NETWORK = _IS_LINUX
"""True if this machine has all addresses that begin with 127, and not 127.0.0.1 alone."""
HAS_FOLDER_FLUSH = hasattr(os, "O_DIRECTORY")
"""True if folders can be opened, and so flushed to disk."""
NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
"""Flag of `os.open` that refuses symbolic links; Windows has none, since links need privileges."""
NO_WAIT = getattr(os, "O_NONBLOCK", 0)
"""Flag of `os.open` that does not wait for the other end of a pipe."""
BYTES = getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
"""Flags of `os.open` for bytes without translated line ends, in this process alone."""
BROKEN_PIPE_CODE = 128 + getattr(signal, "SIGPIPE", 13)
"""Exit code of a command whose output is no longer read."""
STOP_SIGNALS = tuple(
    number
    for number in signal.Signals
    if number.name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
)
"""Signals that stop a process: Ctrl-C, the request to end, and a closed terminal."""


def signals_named(*names: str) -> tuple[signal.Signals, ...]:
    """Returns those of the named signals that this system has."""
    return tuple(signal.Signals[name] for name in names if name in signal.Signals.__members__)


def stop_signal(number: int) -> int:
    """Returns SIGTERM for its stand-in of Windows, and other signals unchanged."""
    if number == _SIGBREAK:
        return int(signal.SIGTERM)
    return number


def request_end(process: subprocess.Popen[bytes]) -> None:
    """Sends SIGTERM to a child in a `separate_session`, or on Windows its stand-in."""
    if _SIGBREAK is None:
        process.terminate()
        return
    try:
        process.send_signal(signal.CTRL_BREAK_EVENT)  # type: ignore[attr-defined]
    except OSError:  # without a console
        process.terminate()


def separate_session() -> dict[str, Any]:
    """Returns options of `subprocess.Popen` for a child that Ctrl-C on the terminal spares."""
    new_group = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", None)
    if new_group is None:
        return {"start_new_session": True}
    return {"creationflags": new_group}


def replace_process(command: list[str], environment: Mapping[str, str]) -> NoReturn:
    """Runs a command in place of this process.

    Windows has no such call: there the command is a child, and its exit code that of this process.
    """
    if os.name == "nt":
        sys.exit(subprocess.run(command, env=environment, check=False).returncode)
    os.execve(command[0], command, environment)


def start_method() -> str:
    """Returns the start method of `multiprocessing` for workers: `fork` on Linux, else `spawn`.

    Libraries of macOS crash in forked processes, and Windows has none.
    """
    if _IS_LINUX and hasattr(os, "fork"):
        return "fork"
    return "spawn"


def after_fork(call: Callable[[], None]) -> None:
    """Registers a function that each forked child of this process calls, if the system forks."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=call)


def terminate_with(parent: int) -> None:
    """Makes this process receive SIGTERM when its parent, whose id is given, has ended."""
    if not _IS_LINUX:
        _call_after(_send_sigterm, parent)
        return
    pr_set_pdeathsig = 1
    ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGTERM)
    if os.getppid() != parent:
        _send_sigterm()


def end_with(*processes: int) -> None:
    """Ends this process at once after any of some others, whose ids are given, has ended."""
    _call_after(_end, *processes)


def _send_sigterm() -> None:
    signal.raise_signal(signal.SIGTERM)


def _end() -> None:
    os._exit(1)


def _call_after(call: Callable[[], None], *processes: int) -> None:
    """Calls a function in a thread as soon as one of some processes has ended."""
    import psutil

    try:
        others = [psutil.Process(process) for process in processes]
    except psutil.NoSuchProcess:
        call()
        return

    def wait() -> None:
        while all(other.is_running() and not _is_zombie(other) for other in others):
            time.sleep(_CHECK_S)
        call()

    threading.Thread(target=wait, daemon=True, name="parent").start()


def _is_zombie(process: Any) -> bool:
    """True if a process has ended, and its parent has not read its exit code."""
    import psutil

    with contextlib.suppress(psutil.Error):
        return bool(process.status() == psutil.STATUS_ZOMBIE)
    return False


def replace(source: pathlib.Path, target: pathlib.Path) -> pathlib.Path:
    """Renames a file, in place of an existing one; returns the target.

    Windows refuses this while another process has one of them open: it is tried for `_REPLACE_S`.

    Raises:
      OSError: the file cannot be renamed.
    """
    if os.name != "nt":
        return source.replace(target)
    deadline = time.monotonic() + _REPLACE_S
    while True:
        try:
            return source.replace(target)
        except PermissionError:
            if time.monotonic() > deadline:
                raise
        time.sleep(_RETRY_S)


def reserve_for_listener(probe: socket.socket) -> None:
    """Prepares a socket for a bind that fails if another process listens at the port.

    SO_REUSEADDR allows a port whose last connections are about to be forgotten. On Windows it would
    also allow one in use.
    """
    exclusive = getattr(socket, "SO_EXCLUSIVEADDRUSE", None)
    if exclusive is not None:
        probe.setsockopt(socket.SOL_SOCKET, exclusive, 1)
        return
    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)


def raise_open_files(most: int) -> int:
    """Raises the limit of files that this process may have open, where the system allows it.

    Args:
      most: requested limit.

    Returns:
      The limit, `most` if there is none.
    """
    if resource is None:
        return most
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = most if hard == resource.RLIM_INFINITY else min(hard, most)
    if soft == resource.RLIM_INFINITY or soft >= limit:
        return limit
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
    except (OSError, ValueError):  # macOS has another limit, below its unlimited one
        return soft
    return limit


def address_space_limit() -> int:
    """Limit of the address space of this process and its children in bytes; 0 for none."""
    if resource is None:
        return 0
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    return 0 if soft == resource.RLIM_INFINITY else soft


def enforces_limits() -> bool:
    """True if this system enforces the limits of `limit_this_process`.

    macOS ignores the limit of the address space, and Windows has none: there,
    `common.runtime.confinement` watches child processes.
    """
    return _IS_LINUX and resource is not None


def limit_this_process(memory: int, processor_s: float, file_bytes: int = 0) -> None:
    """Limits this process for the rest of its life, where the system enforces it.

    Args:
      memory: limit of the address space in bytes; beyond it, allocations fail.
      processor_s: limit of the processor time in seconds; SIGPROF then ends the process.
      file_bytes: limit of the size of files that it writes; 0 for none.
    """
    if not enforces_limits():
        return
    signal.setitimer(signal.ITIMER_PROF, processor_s)
    _lower(resource.RLIMIT_AS, memory)
    _lower(resource.RLIMIT_CORE, 0)
    if file_bytes:
        _lower(resource.RLIMIT_FSIZE, file_bytes)


def _lower(kind: int, limit: int) -> None:
    """Lowers a limit of this process."""
    hard = resource.getrlimit(kind)[1]
    if hard != resource.RLIM_INFINITY:
        limit = min(limit, hard)
    resource.setrlimit(kind, (limit, limit))
