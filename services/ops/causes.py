"""Causes of a process's end, from its log, its exit code and the limits of this machine.

A lack of memory has many symptoms: a broken pipe of a helper, SIGABRT of the C++ runtime, a thread
that does not start. The first fatal error in the log is the cause, later ones are its consequences.
"""

import os
import pathlib
import re
import signal
from typing import NamedTuple

from congrasp.common.errors import printable
from congrasp.common.runtime import platforms

_MAX_READ_BYTES = 1 << 20
"""Bytes at the end of a log that are searched for a cause."""
_MAX_QUOTED_CHARACTERS = 300
"""Limit of a quoted line."""
_OUR_ERROR = "congrasp: error: "
_PREFIX = re.compile(r"^(?:[EWFI]\d{4} [\d:.]+ +\d+ \S+\] |(?:error|fatal|warning|info): )+")
"""Level, time and place in a line of XLA's log, and the level in a line of ours."""
_HARMLESS = re.compile(r"not a failure|performance gains|retrying", re.IGNORECASE)
"""Lines about memory after which the allocator of a GPU tries again."""
_TRACE = "Traceback (most recent call last):"
_EXCEPTION = re.compile(r"^[A-Za-z_][\w.]*(?:: .*)?$")
"""Line of an exception after its trace."""
_CONSEQUENCES = re.compile(
    r"^(?:[\w.]*\.)?(?:BrokenPipeError|ConnectionResetError|ConnectionAbortedError|EOFError"
    r"|BrokenProcessPool|BrokenExecutor|KeyboardInterrupt|SystemExit)\b"
)
"""Exceptions of a process that lost another one, or was asked to end."""
_CRASH = re.compile(r"Fatal Python error|terminate called|panicked at|Check failed|LLVM ERROR")
"""Last words of native code: the interpreter, C++, Rust, XLA and LLVM."""
_ABORTS = platforms.signals_named("SIGABRT", "SIGSEGV", "SIGBUS", "SIGTRAP", "SIGILL")
"""Signals by which native code ends a process, for instance when it gets no memory."""
_NVIDIA_DRIVER = pathlib.Path("/dev/nvidiactl")
"""File that exists if the driver is loaded."""


class Shortage(NamedTuple):
    """A resource that a process can lack."""

    phrase: str
    """The lack in a message."""
    symptoms: re.Pattern[str]
    """Matches lines of logs that report the lack."""


_SHORTAGES = (
    Shortage(
        "out of GPU memory",
        re.compile(
            r"CUDA_ERROR_OUT_OF_MEMORY|cudaErrorMemoryAllocation|CUDA out of memory"
            r"|CUDA error 2: out of memory|\bGPU\b.*out of memory|out of memory.*\bGPU\b",
            re.IGNORECASE,
        ),
    ),
    Shortage(
        "out of device memory",
        re.compile(r"RESOURCE_EXHAUSTED|The device's memory does not suffice"),
    ),
    Shortage(
        "out of memory",
        re.compile(
            r"\bMemoryError\b|\bbad_alloc\b|cannot allocate memory|out of memory|\boom.kill"
            r"|memory allocation of \d+ bytes failed|unable to allocate|failed to map segment"
            r"|failed to allocate|can't allocate memory|not enough memory",
            re.IGNORECASE,
        ),
    ),
    Shortage(
        "out of threads or memory",
        re.compile(
            r"can't start new thread|failed to spawn thread|pthread_create failed"
            r"|Resource temporarily unavailable"
        ),
    ),
)


def read_end(path: pathlib.Path, begin: int) -> str:
    """Returns the end of a log from byte `begin` on, at most a mebibyte; empty if it is missing."""
    try:
        with path.open("rb") as log:
            size = log.seek(0, os.SEEK_END)
            log.seek(max(begin, size - _MAX_READ_BYTES))
            return log.read().decode(errors="replace")
    except OSError:
        return ""


def cause_in(text: str) -> str:
    """Returns the cause of a process's end that its log shows, in one line; empty if it shows none.

    In this order: the first line about a lack of memory or threads, the error with which a command
    ended, the last exception (if possible one that is not the consequence of another process's
    end), and the last crash of native code.
    """
    lines = text.splitlines()
    for line in lines:
        shortage = _find_shortage(line)
        if shortage:
            return f"{_phrase_of(shortage, text)} ({_quote(line)})"
    errors = [line for line in lines if line.startswith(_OUR_ERROR)]
    if errors:
        return _quote(errors[-1].removeprefix(_OUR_ERROR))
    exceptions = _exception_lines(lines)
    causes = [line for line in exceptions if not _CONSEQUENCES.match(line)]
    if causes:
        return _quote(causes[-1])
    if exceptions:
        return _quote(exceptions[-1])
    crashes = [line for line in lines if _CRASH.search(line)]
    return _quote(crashes[-1]) if crashes else ""


def is_shortage(text: str) -> bool:
    """True if a log reports a lack of memory or threads."""
    return any(_find_shortage(line) is not None for line in text.splitlines())


def last_line(text: str) -> str:
    """Returns the last line of a log that is not empty."""
    lines = text.strip().splitlines()
    return lines[-1].removeprefix(_OUR_ERROR) if lines else ""


def end_of(name: str, code: int, log: str, *, kernel_killed: bool = False) -> str:
    """Describes the end of a process in a sentence with its cause.

    Args:
      name: name of the process, such as `learner`.
      code: its exit code; a negative one is the signal that killed it.
      log: its log, or the end of it.
      kernel_killed: True if the kernel killed a process for lack of memory meanwhile.
    """
    cause = cause_in(log)
    if code >= 0:
        reason = cause or last_line(log) or "its log is empty"
        return f"The {name} died (exit code {code}): {reason.rstrip('. ')}.{_limit_sentence(cause)}"
    number = signal.Signals(-code)
    if not cause and number.name == "SIGKILL" and kernel_killed:
        cause = "out of memory (killed by the kernel)"
    if not cause and number in _ABORTS and platforms.address_space_limit():
        cause = "probably out of memory"
    if not cause:
        return f"The {name} was killed by {number.name}."
    return f"The {name} was killed by {number.name}: {cause.rstrip('. ')}.{_limit_sentence(cause)}"


def _find_shortage(line: str) -> Shortage | None:
    """Returns the lack that a line reports; None if it reports none."""
    if _HARMLESS.search(line):
        return None
    for shortage in _SHORTAGES:
        if shortage.symptoms.search(line):
            return shortage
    return None


def _phrase_of(shortage: Shortage, text: str) -> str:
    """Phrase of a shortage that a log reports. A device may be a GPU, or the CPU: it is a GPU if
    the log names one, or this machine has one that JAX may use.
    """
    if shortage.phrase != "out of device memory":
        return shortage.phrase
    if re.search(r"\bGPU|CUDA|\bgpu\b", text) or _may_use_gpu():
        return "out of GPU memory"
    return "out of memory"


def _may_use_gpu() -> bool:
    """True if this machine has an NVIDIA GPU and JAX may use it."""
    return _NVIDIA_DRIVER.exists() and os.environ.get("JAX_PLATFORMS") != "cpu"


def _exception_lines(lines: list[str]) -> list[str]:
    """The line of the exception after each trace."""
    exception_lines: list[str] = []
    in_trace = False
    for line in lines:
        if line.startswith(_TRACE):
            in_trace = True
        elif in_trace and _EXCEPTION.match(line):
            exception_lines.append(line)
            in_trace = False
    return exception_lines


def _quote(line: str) -> str:
    """A line of a log without its level, time and place, and with a limited length."""
    text = printable(_PREFIX.sub("", line.strip()).removeprefix(_OUR_ERROR)).strip().rstrip(". ")
    return text if len(text) <= _MAX_QUOTED_CHARACTERS else f"{text[:_MAX_QUOTED_CHARACTERS]} …"


def _limit_sentence(cause: str) -> str:
    """A sentence about the limit of the address space if there is one and memory is the cause, else
    an empty text.
    """
    limit = platforms.address_space_limit()
    if "memory" not in cause or not limit:
        return ""
    return f" Its address space is limited to {limit / 1e9:.1f} GB (ulimit -v)."
