"""A dataset on several GPUs of one machine: a process for each, which makes some of the shards."""

import concurrent.futures
import contextlib
import os
from collections.abc import Callable, Sequence
from typing import NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.runtime import platforms
from congrasp.common.runtime.worker_process import Messages, WorkerProcess
from congrasp.services.dataset.make import Recipe, make, pools_of
from congrasp.services.dataset.shards import Shards

_REPORT_S = 0.5
"""Time between calls of the progress function, s."""


class _End(NamedTuple):
    """Last message of a process; its others are numbers of episodes."""

    error: str
    """Its CongraspError; empty if there was none."""


def make_on_gpus(
    recipe: Recipe,
    shards: Shards,
    numbers: Sequence[int],
    gpus: Sequence[str],
    progress: Callable[[int], None] = lambda episodes: None,
) -> None:
    """Makes and writes shards; see `services.dataset.make.make`.

    Args:
      recipe: contents of the dataset.
      shards: locations of the shards.
      numbers: numbers of the shards to make.
      gpus: identifiers of the GPUs for CUDA.
      progress: called with the number of episodes that all GPUs have simulated.

    Raises:
      CongraspError: a process ended or raised it. Finished shards remain.
    """
    # Without more shards than GPUs the others have nothing to do
    gpus = gpus[: len(numbers)]
    episodes = dict.fromkeys(gpus, 0)

    def watch(gpu: str, worker: WorkerProcess, of_gpu: Sequence[int]) -> None:
        """Counts the episodes of a GPU until its process has made its shards."""
        try:
            worker.send((recipe, shards, of_gpu))
            while not isinstance(message := worker.receive(), _End):
                episodes[gpu] = message
        except (EOFError, OSError):
            raise CongraspError(
                f"The process of GPU {gpu} ended.",
                "See its output above, and repeat the command to make the missing shards.",
            ) from None
        if message.error:
            raise CongraspError(message.error)

    with contextlib.ExitStack() as stack:
        watchers = stack.enter_context(concurrent.futures.ThreadPoolExecutor(len(gpus)))
        pending: set[concurrent.futures.Future[None]] = set()
        for number, gpu in enumerate(gpus):
            # An empty JAX_PLATFORMS leaves the choice to JAX
            worker = WorkerProcess(serve, CUDA_VISIBLE_DEVICES=gpu, JAX_PLATFORMS="")
            stack.callback(worker.stop)
            of_gpu = list(numbers[number :: len(gpus)])
            pending.add(watchers.submit(watch, gpu, worker, of_gpu))
        while pending:
            ended, pending = concurrent.futures.wait(
                pending, _REPORT_S, concurrent.futures.FIRST_COMPLETED
            )
            progress(sum(episodes.values()))
            for watcher in ended:
                watcher.result()


def serve(caller: Messages) -> None:
    """Makes the shards of the first message of the process at the other end."""
    platforms.end_with(os.getppid())
    recipe, shards, numbers = caller.receive()
    error = ""
    try:
        make(recipe, shards, pools_of(recipe), numbers, caller.send)
    except CongraspError as failure:
        error = str(failure)
    caller.send(_End(error))
