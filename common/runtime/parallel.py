"""Cores and memory available to this process, and work distributed among processes if that pays for
starting them.
"""

import concurrent.futures
import contextlib
import importlib
import math
import multiprocessing.connection
import multiprocessing.spawn
import os
import pathlib
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.reduction import ForkingPickler
from typing import IO, Any, NamedTuple, TypeVar

import psutil

from congrasp.common.runtime import platforms
from congrasp.common.runtime.environment import child_environment

Result = TypeVar("Result")
_MIN_CALLS = 64  # with fewer, starting processes takes longer than it saves
_MIN_CALLS_PER_WORKER = 16
_MAX_WORKERS = 16
_CALLS_PER_CHUNK = 4  # sent to a worker at a time
_PRELOADED = ("congrasp.common.objects.procedural", "congrasp.common.task.constraints")
"""Modules imported once, before workers fork; workers import anything else their functions
need.
"""
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"), "1")
"""Environment of processes that share the cores: each would otherwise start a thread for every
core, for products so small that the threads cost several times the work."""
_LENGTH_BYTES = 8
"""Size of the length before each message."""
CGROUPS = pathlib.Path("/sys/fs/cgroup")
"""Folder of the kernel's control groups."""
CGROUP_MEMBERSHIP = pathlib.Path("/proc/self/cgroup")
"""File with the control groups of this process."""


def cores() -> int:
    """Number of cores available to this process, by its affinity and the quotas of its control
    groups, rounded up.
    """
    if hasattr(os, "sched_getaffinity"):
        available: float = len(os.sched_getaffinity(0))
    else:
        available = os.cpu_count() or 1
    for text in _limits("cpu", "cpu.max", "cpu.cfs_quota_us", "cpu.cfs_period_us"):
        quota, period = text.split()
        if quota not in ("max", "-1"):
            available = min(available, int(quota) / int(period))
    return max(1, math.ceil(available))


def memory() -> int:
    """Bytes of memory available to this process: free ones, and what the limits of its control
    groups leave.
    """
    used = psutil.Process().memory_info().rss
    available = psutil.virtual_memory().available
    for limit in _limits("memory", "memory.max", "memory.limit_in_bytes"):
        if limit != "max":
            available = min(available, int(limit) - used)
    return max(0, available)


def memory_kills() -> int:
    """Number of processes that the kernel has killed for lack of memory in this control group and
    those above it.
    """
    counters = _limits("memory", "memory.events", "memory.oom_control")
    counts = [re.search(r"\boom_kill (\d+)", text) for text in counters]
    return sum(int(count[1]) for count in counts if count)


def _limits(controller: str, unified: str, *separate: str) -> Iterator[str]:
    """Yields the limits of this process's control group and of the groups above it.

    Args:
      controller: name of the controller.
      unified: file of the limit in cgroup version 2.
      separate: its files in version 1, whose texts are joined.
    """
    with contextlib.suppress(OSError):
        for line in CGROUP_MEMBERSHIP.read_text(encoding="utf-8").splitlines():
            _, controllers, group = line.split(":", 2)
            if controllers and controller not in controllers.split(","):
                continue
            is_version_1 = bool(controllers)
            mount = CGROUPS / controller if is_version_1 else CGROUPS
            files = separate if is_version_1 else (unified,)
            path = pathlib.PurePath(group.lstrip("/"))
            for folder in (path, *path.parents):
                with contextlib.suppress(OSError):
                    yield " ".join(
                        (mount / folder / file).read_text(encoding="utf-8").strip()
                        for file in files
                    )


def parallel_map(function: Callable[..., Result], *columns: Iterable[Any]) -> list[Result]:
    """`map` over processes, in order; runs in this process if there are few calls or few cores.

    The workers are children of a helper process that imports congrasp alone: they never run the
    caller's `__main__`. What fails there, for instance for something that only this process has
    registered, runs in this process.

    Args:
      function: a top-level function of a module; it must not use an accelerator.
      columns: arguments, as for `map`.
    """
    rows = list(zip(*columns, strict=True))
    workers = _workers(len(rows))
    if not workers:
        return [function(*row) for row in rows]
    results: list[Result] = []
    for row, outcome in zip(rows, _helper().results(workers, function, rows), strict=True):
        results.append(function(*row) if outcome is None else outcome[0])
    return results


def prepare_workers(calls: int) -> None:
    """Starts the helper process if `calls` calls will need workers: its imports take seconds."""
    if _workers(calls):
        _helper().start()


def _workers(calls: int) -> int:
    """Number of processes for `calls` calls; 0 if they would cost more than they save."""
    if calls < _MIN_CALLS:
        return 0
    workers = min(cores(), _MAX_WORKERS, calls // _MIN_CALLS_PER_WORKER)
    return workers if workers > 1 else 0


class _Running(NamedTuple):
    """The helper's process and its standard streams."""

    process: subprocess.Popen[bytes]
    calls: IO[bytes]
    answers: IO[bytes]


class _Helper:
    """A process that starts workers: forking this one could deadlock if it has started JAX.

    Other ways of Python to start workers would import the caller's `__main__` in each of them, and
    its fork server is shared with the caller's own use. Messages pass through the helper's standard
    input and output.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: _Running | None = None

    def start(self) -> None:
        """Starts the process if it is not running."""
        with self._lock:
            self._started()

    def results(
        self, workers: int, function: Callable[..., Result], rows: list[Any]
    ) -> list[tuple[Result] | None]:
        """Returns the result of each call, None for those that failed."""
        with self._lock:
            try:
                helper = self._started()
                _send(helper.calls, (os.getpid(), os.getcwd(), workers, function, rows))
                return _receive(helper.answers) or [None] * len(rows)
            except (OSError, EOFError):  # it cannot start here, or was killed
                self._stop()
                return [None] * len(rows)
            except BaseException:
                self._stop()
                raise

    def _started(self) -> _Running:
        """The process, which starts if necessary."""
        if self._running is None:
            paths = [str(path) for path in sys.path]
            code = f"import sys; sys.path[:] = {paths}; from {__name__} import serve; serve()"
            environment = child_environment(JAX_PLATFORMS="cpu", PYTHONWARNINGS="ignore")
            process = subprocess.Popen(
                [multiprocessing.spawn.get_executable(), "-P", "-c", code],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env={**_ONE_THREAD, **environment},
                **platforms.separate_session(),  # Ctrl-C on a terminal reaches only the caller
            )
            assert process.stdin is not None and process.stdout is not None
            self._running = _Running(process, process.stdin, process.stdout)
        return self._running

    def _stop(self) -> None:
        """Ends the process; its workers end with it."""
        if self._running:
            helper = self._running
            self._running = None
            helper.process.kill()
            for pipe in (helper.calls, helper.answers):
                with contextlib.suppress(OSError):  # the rest of a message
                    pipe.close()
            helper.process.wait()


def _send(pipe: IO[bytes], message: Any) -> None:
    """Writes a message.

    Raises:
      OSError: the process at the other end is gone.
    """
    data = ForkingPickler.dumps(message)
    pipe.write(len(data).to_bytes(_LENGTH_BYTES, "little"))
    pipe.write(data)
    pipe.flush()


def _receive(pipe: IO[bytes]) -> Any:
    """Reads a message.

    Raises:
      EOFError: the process at the other end is gone.
    """
    length = int.from_bytes(_read(pipe, _LENGTH_BYTES), "little")
    return ForkingPickler.loads(_read(pipe, length))


def _read(pipe: IO[bytes], count: int) -> bytes:
    """Reads bytes; raises an EOFError if there are fewer."""
    data = pipe.read(count)
    if len(data) < count:
        raise EOFError
    return data


_helpers: dict[int, _Helper] = {}


def _helper() -> _Helper:
    """The helper of this process; a fork of it has another."""
    return _helpers.setdefault(os.getpid(), _Helper())


def serve() -> None:
    """Makes the calls of the process at the other end of the standard streams, until that ends.

    What the calls print goes to the standard error.
    """
    calls = sys.stdin.buffer
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as answers:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        for module in _PRELOADED:
            importlib.import_module(module)
        with contextlib.suppress(EOFError, OSError):
            while True:
                _answer(calls, answers)


def _answer(calls: IO[bytes], answers: IO[bytes]) -> None:
    """Makes the calls of one message; sends no results if they cannot be made.

    Raises:
      EOFError, OSError: the process at the other end is gone.
    """
    try:
        results = _results(*_receive(calls))
    except (EOFError, OSError):
        raise
    except Exception:  # for instance, a class of the caller's `__main__`
        results = []
    _send(answers, results)


def _results(
    caller: int, folder: str, workers: int, function: Callable[..., Result], rows: list[Any]
) -> list[tuple[Result] | None]:
    """The result of each call, None for those that failed, by workers that end with the caller and
    with this process.
    """
    os.chdir(folder)
    context = multiprocessing.get_context(platforms.start_method())
    with concurrent.futures.ProcessPoolExecutor(
        workers, context, platforms.end_with, (caller, os.getpid())
    ) as pool:
        calls = [(function, row) for row in rows]
        return list(pool.map(_call, calls, chunksize=_CALLS_PER_CHUNK))


def _call(call: tuple[Callable[..., Result], tuple[Any, ...]]) -> tuple[Result] | None:
    """The result of a call; None if it fails."""
    function, row = call
    try:
        return (function(*row),)
    except Exception:
        return None
