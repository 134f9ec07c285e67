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
import select
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import psutil

from congrasp.common.runtime.environment import child_environment

Result = TypeVar("Result")
_MIN_CALLS = 64  # with fewer, starting processes takes longer than it saves
_MIN_CALLS_PER_WORKER = 16
_MAX_WORKERS = 16
_CALLS_PER_CHUNK = 4  # sent to a worker at a time
_PRELOADED = ("congrasp.common.objects.procedural", "congrasp.common.task.constraints")
"""Modules imported once, before the workers fork; workers import anything else their functions
need.
"""
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"), "1")
"""Environment of processes that share the cores: each would otherwise start a thread for every
core, for products so small that the threads cost several times the work."""
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
        for line in CGROUP_MEMBERSHIP.read_text().splitlines():
            _, controllers, group = line.split(":", 2)
            if controllers and controller not in controllers.split(","):
                continue
            is_version_1 = bool(controllers)
            mount = CGROUPS / controller if is_version_1 else CGROUPS
            files = separate if is_version_1 else (unified,)
            path = pathlib.PurePath(group.lstrip("/"))
            for folder in (path, *path.parents):
                with contextlib.suppress(OSError):
                    yield " ".join((mount / folder / file).read_text().strip() for file in files)


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


class _Helper:
    """A process that forks workers, since forking this one could deadlock if it has started JAX.

    Python's fork server would import the caller's `__main__` in each worker, and is shared with the
    caller's own use.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: (
            tuple[subprocess.Popen[bytes], multiprocessing.connection.Connection] | None
        ) = None

    def start(self) -> None:
        """Starts the process if it is not running."""
        with self._lock:
            self._connected()

    def results(
        self, workers: int, function: Callable[..., Result], rows: list[Any]
    ) -> list[tuple[Result] | None]:
        """Returns the result of each call, None for those that failed."""
        with self._lock:
            try:
                connection = self._connected()
                connection.send((os.getcwd(), workers, function, rows))
                return connection.recv() or [None] * len(rows)
            except (OSError, EOFError):  # it cannot start here, or was killed
                self._stop()
                return [None] * len(rows)
            except BaseException:
                self._stop()
                raise

    def _connected(self) -> multiprocessing.connection.Connection:
        """The connection to the process, which starts if necessary."""
        if self._running is None:
            connection, helper_connection = multiprocessing.connection.Pipe()
            paths = [str(path) for path in sys.path]
            descriptor = helper_connection.fileno()
            code = (
                f"import sys; sys.path[:] = {paths}; from {__name__} import serve; "
                f"serve({descriptor})"
            )
            environment = child_environment(JAX_PLATFORMS="cpu", PYTHONWARNINGS="ignore")
            with helper_connection:
                process = subprocess.Popen(
                    [multiprocessing.spawn.get_executable(), "-P", "-c", code],
                    stdin=subprocess.DEVNULL,
                    pass_fds=[descriptor],
                    start_new_session=True,  # Ctrl-C on a terminal reaches only the caller
                    env={**_ONE_THREAD, **environment},
                )
            self._running = (process, connection)
        return self._running[1]

    def _stop(self) -> None:
        """Ends the process; its workers end because the connection closes."""
        if self._running:
            process, connection = self._running
            self._running = None
            connection.close()
            process.kill()
            process.wait()


_helpers: dict[int, _Helper] = {}


def _helper() -> _Helper:
    """The helper of this process; a fork of it has another."""
    return _helpers.setdefault(os.getpid(), _Helper())


def serve(descriptor: int) -> None:
    """Makes the calls of the process at the other end of a socket, until that ends.

    Args:
      descriptor: file descriptor of the socket.
    """
    for module in _PRELOADED:
        importlib.import_module(module)
    connection = multiprocessing.connection.Connection(descriptor)
    with contextlib.suppress(EOFError, OSError):
        while True:
            _answer(connection, descriptor)


def _answer(connection: multiprocessing.connection.Connection, descriptor: int) -> None:
    """Makes the calls of one message; sends no results if they cannot be made.

    Raises:
      EOFError, OSError: the process at the other end is gone.
    """
    try:
        results = _results(descriptor, *connection.recv())
    except (EOFError, OSError):
        raise
    except Exception:  # for instance, a class of the caller's `__main__`
        results = []
    connection.send(results)


def _results(
    descriptor: int, folder: str, workers: int, function: Callable[..., Result], rows: list[Any]
) -> list[tuple[Result] | None]:
    """The result of each call, None for those that failed, by workers that end with the socket."""
    os.chdir(folder)
    context = multiprocessing.get_context("fork")
    with concurrent.futures.ProcessPoolExecutor(workers, context, _end_with, (descriptor,)) as pool:
        calls = [(function, row) for row in rows]
        return list(pool.map(_call, calls, chunksize=_CALLS_PER_CHUNK))


def _call(call: tuple[Callable[..., Result], tuple[Any, ...]]) -> tuple[Result] | None:
    """The result of a call; None if it fails."""
    function, row = call
    try:
        return (function(*row),)
    except Exception:
        return None


def _end_with(descriptor: int) -> None:
    """Ends this process as soon as the other end of the socket closes."""
    poll = select.poll()
    poll.register(descriptor, 0)  # a hang-up alone

    def wait() -> None:
        """Waits for the end of the process that this one works for."""
        poll.poll()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
