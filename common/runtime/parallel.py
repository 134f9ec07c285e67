"""Distributes work among processes if there is enough of it to pay for starting them."""

import multiprocessing
import multiprocessing.context
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import forkserver
from typing import Any, TypeVar

Result = TypeVar("Result")
_WORTH_IT = 64  # calls; below this, starting processes takes longer than it saves
_MOST_WORKERS = 16
_PRELOADED = [
    "congrasp.common.runtime.one_thread",
    "congrasp.common.objects.procedural",
    "congrasp.common.task.constraints",
]
"""Modules imported once, in this order, by the fork server; workers import anything else their functions need."""


def cores() -> int:
    """Number of processor cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def parallel_map(function: Callable[..., Result], *columns: Iterable[Any]) -> list[Result]:
    """`map` over processes, in order; runs in this process if there are few calls or few cores.

    Args:
      function: a top-level function of a module; it must not use an accelerator.
      columns: arguments, as for `map`.
    """
    rows = list(zip(*columns, strict=True))
    workers = _workers(len(rows))
    if not workers:
        return [function(*row) for row in rows]
    context = _context()
    with ProcessPoolExecutor(workers, context, initializer=_prepare_worker) as pool:
        return list(pool.map(function, *zip(*rows, strict=True), chunksize=4))


def prepare_workers(calls: int) -> None:
    """Starts the fork server if `calls` calls will need workers: its imports take seconds."""
    if _workers(calls):
        _context()
        forkserver.ensure_running()


def _workers(calls: int) -> int:
    """Number of processes for `calls` calls; 0 if they would cost more than they save."""
    workers = min(cores(), _MOST_WORKERS, calls // (_WORTH_IT // 4))
    return workers if calls >= _WORTH_IT and workers > 1 else 0


def _context() -> multiprocessing.context.ForkServerContext:
    """Context of the workers: a fork server, since forking this process could deadlock if it has started JAX."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    return context


def _prepare_worker() -> None:
    """Keeps this process off the accelerators, and ends it whenever its parent ends."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        """Waits for the parent's end, then ends this process."""
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
    os.environ["JAX_PLATFORMS"] = "cpu"
