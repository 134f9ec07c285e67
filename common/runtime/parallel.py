"""Calls of a function distributed among processes, if there are enough of them to pay for starting
the processes.
"""

import concurrent.futures
import contextlib
import importlib
import logging
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

from congrasp.common.runtime import platforms
from congrasp.common.runtime.resources import cores
from congrasp.common.runtime.worker_process import Messages, WorkerProcess, decode

Result = TypeVar("Result")
_log = logging.getLogger(__name__)
_MIN_CALLS = 64
"""Calls below which starting processes takes longer than it saves."""
_MIN_CALLS_PER_WORKER = 16
"""Calls for which one more worker pays; as many workers as cores start, but at least four if
there are so many cores.
"""
_MAX_WORKERS = 16
_CALLS_PER_CHUNK = 4
"""Calls that a worker receives at a time."""
_PRELOADED = ("congrasp.common.objects.procedural", "congrasp.common.task.constraints")
"""Modules imported once, before workers fork; workers import anything else their functions
need.
"""


class _Done(NamedTuple):
    """A call that was made; None stands for one that was not."""

    result: Any


class _Request(NamedTuple):
    """Calls for the helper process."""

    caller: int
    """Process id of the caller, with which the workers end."""
    folder: str
    """Current folder of the caller."""
    workers: int
    """Number of processes."""
    function: Callable[..., Any]
    rows: Sequence[tuple[Any, ...]]
    """Arguments of each call."""


_Outcomes = list[_Done | None]
"""Outcome of each call of a request; None for a call that failed."""


def parallel_map(function: Callable[..., Result], *columns: Iterable[Any]) -> list[Result]:
    """`map` over processes, in order; runs in this process if there are few calls or few cores.

    The workers are children of a helper process that imports congrasp alone: they never run the
    caller's `__main__`. Calls that fail there, for instance because they need something that only
    this process has registered, are repeated here, one after another. An error of the function
    itself is raised by that repetition.

    Args:
      function: a top-level function of a module; it must not use an accelerator.
      columns: arguments, as for `map`.
    """
    rows = list(zip(*columns, strict=True))
    workers = _worker_count(len(rows))
    if not workers:
        return [function(*row) for row in rows]
    outcomes = _helper().run(workers, function, rows)
    if outcomes is None:
        _log.info(
            "%d calls run in this process: workers could not start, or one was killed.", len(rows)
        )
        return [function(*row) for row in rows]
    results: list[Result] = []
    for row, outcome in zip(rows, outcomes, strict=True):
        results.append(function(*row) if outcome is None else outcome.result)
    return results


def prepare_workers(calls: int) -> None:
    """Starts the helper process if `calls` calls will need workers: its imports take seconds."""
    if _worker_count(calls):
        _helper().start()


def _worker_count(calls: int) -> int:
    """Number of processes for `calls` calls; 0 if they would cost more than they save."""
    if calls < _MIN_CALLS:
        return 0
    workers = min(cores(), _MAX_WORKERS, calls // _MIN_CALLS_PER_WORKER)
    return workers if workers > 1 else 0


class _Helper:
    """A process that starts workers: forking this one could deadlock if it has started JAX.

    The fork server of Python would be shared with the caller's own use.
    """

    def __init__(self) -> None:
        """Does not start the process yet."""
        self._lock = threading.Lock()
        self._process: WorkerProcess | None = None

    def start(self) -> None:
        """Starts the process if it is not running."""
        with self._lock:
            self._ensure_started()

    def run(
        self, workers: int, function: Callable[..., Any], rows: Sequence[tuple[Any, ...]]
    ) -> _Outcomes | None:
        """Makes calls in worker processes; returns None if these cannot start or were killed."""
        with self._lock:
            try:
                request = _Request(os.getpid(), os.getcwd(), workers, function, rows)
                helper = self._ensure_started()
                helper.send(request)
                outcomes: _Outcomes | None = helper.receive()
                return outcomes
            except (OSError, EOFError):  # it cannot start here, or was killed
                self._stop()
                return None
            except BaseException:
                self._stop()
                raise

    def _ensure_started(self) -> WorkerProcess:
        """Returns the process, and starts it if necessary."""
        if self._process is None:
            self._process = WorkerProcess(serve)
        return self._process

    def _stop(self) -> None:
        """Ends the process; its workers end with it."""
        if self._process is None:
            return
        helper = self._process
        self._process = None
        helper.stop()


_helpers: dict[int, _Helper] = {}


def _helper() -> _Helper:
    """Returns the helper of this process; a fork of this process has another."""
    return _helpers.setdefault(os.getpid(), _Helper())


def serve(caller: Messages) -> None:
    """Answers the requests of the process at the other end, until it ends."""
    for module in _PRELOADED:
        importlib.import_module(module)
    with contextlib.suppress(EOFError, OSError):
        while True:
            _answer(caller)


def _answer(caller: Messages) -> None:
    """Answers one request by the outcomes of its calls, or by None if no call can be made.

    Raises:
      EOFError, OSError: the process at the other end is gone.
    """
    data = caller.receive_bytes()
    outcomes: _Outcomes | None = None
    # Fails for a class of the caller's `__main__`, for a folder that was deleted, or if a worker
    # was killed or cannot start.
    with contextlib.suppress(Exception):
        outcomes = _run_calls(decode(data))
    caller.send(outcomes)


def _run_calls(request: _Request) -> _Outcomes:
    """Makes the calls of a request in workers that end with the caller and with this process."""
    os.chdir(request.folder)
    context = multiprocessing.get_context(platforms.start_method())
    with concurrent.futures.ProcessPoolExecutor(
        request.workers, context, platforms.end_with, (request.caller, os.getpid())
    ) as pool:
        calls = [(request.function, row) for row in request.rows]
        return list(pool.map(_call, calls, chunksize=_CALLS_PER_CHUNK))


def _call(call: tuple[Callable[..., Any], tuple[Any, ...]]) -> _Done | None:
    """Makes a call in a worker; returns None if it fails."""
    function, row = call
    try:
        return _Done(function(*row))
    except Exception:
        return None
