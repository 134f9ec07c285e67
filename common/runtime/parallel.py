"""Work that is divided among processes when there is enough of it to pay for starting them."""

import multiprocessing
import multiprocessing.context
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import forkserver
from typing import Any, TypeVar

Result = TypeVar("Result")
_WORTH_IT = 64  # calls; below, starting processes takes longer than it saves
_MOST_WORKERS = 16
_PRELOADED = [
    "congrasp.common.runtime.one_thread",
    "congrasp.common.objects.procedural",
    "congrasp.common.task.constraints",
]
"""Imported once, in this order, by the process that workers are forked from; what else a function needs, its worker
imports."""


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def parallel_map(function: Callable[..., Result], *columns: Iterable[Any]) -> list[Result]:
    """`map` over processes, in order; in this one if there are few calls or few cores.

    Args:
      function: of a module's top level; it must not use an accelerator.
      columns: arguments, as `map` takes them.
    """
    rows = list(zip(*columns, strict=True))
    workers = _workers(len(rows))
    if not workers:
        return [function(*row) for row in rows]
    context = _context()
    with ProcessPoolExecutor(workers, context, initializer=_prepare_worker) as pool:
        return list(pool.map(function, *zip(*rows, strict=True), chunksize=4))


def prepare_workers(calls: int) -> None:
    """Starts the process that workers are forked from, if so many calls will need any: its imports take seconds."""
    if _workers(calls):
        _context()
        forkserver.ensure_running()


def _workers(calls: int) -> int:
    """Processes for so many calls; 0 where they would cost more than they save."""
    workers = min(cores(), _MOST_WORKERS, calls // (_WORTH_IT // 4))
    return workers if calls >= _WORTH_IT and workers > 1 else 0


def _context() -> multiprocessing.context.ForkServerContext:
    """Where workers come from: forking this process could lock up, because it may have started JAX."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    return context


def _prepare_worker() -> None:
    """Keeps this process off the accelerators, and ends it when its parent ends, however it does."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        """Ends this process after its parent."""
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
    os.environ["JAX_PLATFORMS"] = "cpu"
