"""Builds the kernels of a control step: lists them without launching any, and builds them in
parallel, in one process of a machine at a time.
"""

import concurrent.futures
import contextlib
import functools
import hashlib
import logging
import pathlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, BinaryIO

import warp as wp

from congrasp.actors.physics.warp_kernels import set_environments
from congrasp.common.errors import CongraspError
from congrasp.common.io.locks import try_lock
from congrasp.common.io.opening import open_to_append
from congrasp.common.runtime.resources import cores
from congrasp.common.runtime.stages import stage

Variant = tuple[wp.Module, int]
"""A module of kernels, and the block size of their launch."""

PATIENCE_S = 300.0
"""Time until a process builds what another one builds."""
_SILENT_S = 2.0
"""Time until a waiting process logs that it waits."""
_BLOCK = 256
"""Warp's block size of a launch without one; on a CPU all are 1."""
_log = logging.getLogger(__name__)
_building = threading.Lock()
"""Held while kernels are listed and built; the next list then contains what they share."""


def build_kernels(device: wp.Device, list_variants: Callable[[], list[Variant]]) -> None:
    """Builds the listed kernels in parallel, or reads them from Warp's cache.

    Launches would do this one after another. Warp compiles without Python's lock.
    """
    with _building:
        with stage("list of the kernels"):
            variants = list_variants()
        with (
            stage("kernels"),
            one_builder(variants),
            concurrent.futures.ThreadPoolExecutor(cores()) as threads,
        ):
            builds = [threads.submit(wp.force_load, device, [m], size) for m, size in variants]
            for build in builds:
                build.result()


def variants_of(device: wp.Device, launch_all: Callable[[], None]) -> list[Variant]:
    """Modules with the kernels that `launch_all` launches, and their block sizes, the largest
    modules first.

    Its launches in this thread are listed and not made. It also queries the occupancy of its
    largest kernels, each of which Warp would build for the answer.
    """
    queried: list[Variant] = []
    launched: list[Variant] = [(set_environments.module, _BLOCK)]
    this_thread = threading.get_ident()
    launch = wp.launch
    launch_tiled = wp.launch_tiled
    query = wp.get_suggested_block_size

    def record_launch(
        make: Callable[..., None], kernel: wp.Kernel, *args: Any, **options: Any
    ) -> None:
        if threading.get_ident() == this_thread:
            launched.append((kernel.module, options.get("block_dim") or _BLOCK))
        else:
            make(kernel, *args, **options)

    def record_query(kernel: wp.Kernel, device: Any = None) -> tuple[int, int]:
        if threading.get_ident() != this_thread:
            return query(kernel, device)
        queried.append((kernel.module, kernel.module.options["block_dim"]))
        return 1, 1

    wp.launch = functools.partial(record_launch, launch)
    wp.launch_tiled = functools.partial(record_launch, launch_tiled)
    wp.get_suggested_block_size = record_query
    try:
        with wp.ScopedDevice(device):
            launch_all()
    finally:
        wp.launch = launch
        wp.launch_tiled = launch_tiled
        wp.get_suggested_block_size = query
    variants = []
    for module, size in (*queried, *launched):
        variants.append((module, size if device.is_cuda else 1))
    return list(dict.fromkeys(variants))


@contextlib.contextmanager
def one_builder(variants: Sequence[Variant]) -> Iterator[None]:
    """Context that one process of this machine enters first, to build the kernels.

    The other processes then read these kernels from Warp's cache. They wait for `PATIENCE_S`
    seconds at most, and then build the kernels, too.
    """
    names = ",".join(sorted(f"{module.name} {size}" for module, size in variants))
    name = f"builder-{hashlib.sha256(names.encode()).hexdigest()[:16]}"
    path = pathlib.Path(str(wp.config.kernel_cache_dir), name)
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(open_to_append(path))
            if not _wait_for_lock(file):
                file.close()
        except (OSError, CongraspError) as error:
            _log.info("Kernels are built without waiting for other processes: %s.", error)
        yield


def _wait_for_lock(file: BinaryIO) -> bool:
    """Takes the lock, or waits until the first builder is done, for `PATIENCE_S` seconds.

    Returns:
      True if this process is the first builder, which keeps the lock.
    """
    start = time.monotonic()
    is_reported = False
    waited = 0.0
    while waited < PATIENCE_S:
        if try_lock(file):
            return waited == 0.0
        if waited > _SILENT_S and not is_reported:
            is_reported = True
            _log.info(
                "Waiting for the kernels that another process builds, at most %d s.", PATIENCE_S
            )
        time.sleep(0.1)
        waited = time.monotonic() - start
    return False
