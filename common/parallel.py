"""Work that is divided among processes when there is enough of it to pay for starting them."""

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

Result = TypeVar("Result")
_WORTH_IT = 64  # calls; below, starting processes takes longer than it saves
_MOST_WORKERS = 16


def parallel_map(function: Callable[..., Result], *columns: Iterable[Any]) -> list[Result]:
    """`map` over processes, in order; in this one if there are few calls or few cores.

    Args:
      function: of a module's top level; it must not use an accelerator.
      columns: arguments, as `map` takes them.
    """
    rows = list(zip(*columns, strict=True))
    workers = min(len(os.sched_getaffinity(0)), _MOST_WORKERS, len(rows) // (_WORTH_IT // 4))
    if len(rows) < _WORTH_IT or workers < 2:
        return [function(*row) for row in rows]
    # Forking a process that has started JAX can lock up; spawned ones start afresh.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=_prepare_worker) as pool:
        return list(pool.map(function, *zip(*rows, strict=True), chunksize=4))


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
