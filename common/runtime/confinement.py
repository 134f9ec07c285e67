"""Child processes with limits of memory, time and output.

The system enforces the limits where it can: the child calls `platforms.limit_this_process`. Where
it cannot, this process watches the child's memory, processor time and files, and kills it.
"""

import contextlib
import functools
import logging
import pathlib
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import psutil

from congrasp.common.runtime import platforms

Excess = Literal["", "memory", "time", "file", "killed"]
"""Limit that a child has exceeded; `killed` if the system killed it, as it does without memory."""
_LOOK_S = 0.05
"""Time between two looks at a watched child."""
_WAIT_S = 0.5
"""Time between two calls while a child runs."""
_log = logging.getLogger(__name__)


class Limits(NamedTuple):
    """Limits of a child process."""

    memory: int
    """Bytes: of its address space where the system enforces it, else of its memory in use."""
    processor_s: float
    """Seconds of processor time, so that a busy machine changes no result."""
    patience_s: float
    """Seconds until it is killed in any case."""
    file: pathlib.Path | None = None
    """A file that it writes, of limited size."""
    file_bytes: int = 0
    """Limit of the size of that file."""


class Ending(NamedTuple):
    """End of a child process."""

    code: int
    """Exit code of the process."""
    output: bytes
    """Bytes of the captured stream."""
    excess: Excess
    """Limit that ended it, if that is known."""


def run_confined(
    command: Sequence[str],
    limits: Limits,
    environment: Mapping[str, str],
    stream: Literal["stdout", "stderr"],
    data: bytes = b"",
    on_wait: Callable[[], None] = lambda: None,
) -> Ending:
    """Runs a child process until it ends or exceeds a limit.

    Args:
      command: the command line of a program that calls `platforms.limit_this_process`.
      limits: its limits.
      environment: its environment.
      stream: stream that is captured; the other one is discarded.
      data: its standard input.
      on_wait: called twice a second while the child runs; what it raises ends the child.

    Raises:
      TimeoutError: it did not end within `patience_s`.
    """
    stdout = subprocess.PIPE if stream == "stdout" else subprocess.DEVNULL
    stderr = subprocess.PIPE if stream == "stderr" else subprocess.DEVNULL
    excess: list[Excess] = []
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=stdout, stderr=stderr, env=environment
    ) as child:
        if not platforms.enforces_limits():
            _report_watching()
            _watch(child, limits, excess)
        try:
            outputs = _communicate(child, data, limits.patience_s, on_wait)
        finally:
            child.kill()
    output = outputs[0] if stream == "stdout" else outputs[1]
    return Ending(child.returncode, output, excess[0] if excess else _excess_of(child.returncode))


def _communicate(
    child: subprocess.Popen[bytes], data: bytes, patience: float, on_wait: Callable[[], None]
) -> tuple[bytes, bytes]:
    """Sends a child its input and returns its standard output and error.

    Args:
      child: the child.
      data: its standard input.
      patience: time until a TimeoutError, s.
      on_wait: called while the child runs.
    """
    deadline = time.monotonic() + patience
    remaining_data: bytes | None = data
    while True:
        remaining_s = max(0.0, deadline - time.monotonic())
        try:
            return child.communicate(remaining_data, min(_WAIT_S, remaining_s))
        except subprocess.TimeoutExpired:
            if time.monotonic() >= deadline:
                raise TimeoutError from None
        remaining_data = None  # the first call keeps what it has not sent
        on_wait()


@functools.cache
def _report_watching() -> None:
    """Logs once that limits are watched and not enforced."""
    _log.info(
        "This system does not limit the memory of a process. Files from elsewhere are read in a "
        "process whose memory and time are watched instead."
    )


def _excess_of(code: int) -> Excess:
    """The limit whose signal ended a child."""
    if -code in platforms.signals_named("SIGPROF"):
        return "time"
    if -code in platforms.signals_named("SIGKILL"):
        return "killed"
    return ""


def _watch(child: subprocess.Popen[bytes], limits: Limits, excess: list[Excess]) -> None:
    """Starts a thread that kills a child beyond a limit, and appends that limit to a list."""

    def watch() -> None:
        while child.poll() is None:
            exceeded = _exceeded(child.pid, limits)
            if exceeded:
                excess.append(exceeded)
                _kill(child.pid)
                return
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(_LOOK_S)

    threading.Thread(target=watch, daemon=True, name="limits").start()


def _exceeded(process: int, limits: Limits) -> Excess:
    """The limit that a process and its children exceed."""
    memory = 0
    processor_s = 0.0
    for each in _with_children(process):
        with contextlib.suppress(psutil.Error):
            memory += each.memory_info().rss
            times = each.cpu_times()
            processor_s += times.user + times.system
    if memory > limits.memory:
        return "memory"
    if processor_s > limits.processor_s:
        return "time"
    if limits.file is not None and _size(limits.file) > limits.file_bytes:
        return "file"
    return ""


def _with_children(process: int) -> list[psutil.Process]:
    """A process, and its children: Python of a virtual environment on Windows is such a child."""
    try:
        parent = psutil.Process(process)
        return [parent, *parent.children(recursive=True)]
    except psutil.Error:
        return []


def _kill(process: int) -> None:
    """Kills a process and its children."""
    for each in _with_children(process):
        with contextlib.suppress(psutil.Error):
            each.kill()


def _size(path: pathlib.Path) -> int:
    """Size of a file in bytes; 0 while it does not exist."""
    with contextlib.suppress(OSError):
        return path.stat().st_size
    return 0
