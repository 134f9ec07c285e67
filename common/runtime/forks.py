"""Detection of forked processes, in which Zenoh's and JAX's threads do not run.

A fork copies one thread alone. A call into one of these libraries that waits for another thread
would then never return, because their native code has no deadline. So a fork refuses these calls.
"""

import ctypes
import sys

from congrasp.common.errors import CongraspError
from congrasp.common.runtime.platforms import after_fork

_REMEDY = "Start processes with the start method spawn: multiprocessing.get_context('spawn')."
_generation = 0
"""Number of forks between the process that imported this module and the current one."""
_started: set[str] = set()
"""Libraries with threads in this process, or in one from which it was forked."""
_inherited: set[str] = set()
"""Libraries that had threads in a process from which this one was forked."""


class ForkError(CongraspError):
    """The process was forked from one whose connections or threads it would need."""

    def __init__(self, what: str):
        super().__init__(what, _REMEDY)


def generation() -> int:
    """Returns a number that differs between a process and its forks, for
    `require_same_process`.
    """
    return _generation


def require_same_process(generation_at_opening: int, what: str) -> None:
    """Raises a ForkError in a fork of the process that opened something.

    Args:
      generation_at_opening: the return value of `generation` in the process that opened it.
      what: name of what was opened, such as `policy`, for the message.
    """
    if generation_at_opening != _generation:
        raise ForkError(f"This {what} was opened before the process was forked.")


def note_started(library: str) -> None:
    """Records that a library has started threads, which forks of this process will lack."""
    _started.add(library)


def detect_jax() -> None:
    """Records that JAX has started, if it has. The package's `__init__` registers a call before
    each fork, because code outside this package may have started JAX.
    """
    if _jax_clients():
        note_started("JAX")


def require_not_inherited(library: str) -> None:
    """Raises a ForkError if this process was forked after the library had started threads."""
    if library in _inherited:
        raise ForkError(f"This process was forked after {library} had started.")


def keep_to_the_end(native: object) -> None:
    """Keeps an object alive until the process ends. In a fork its destructor would crash, or wait
    for threads that do not run there.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(native))


def _mark_forked() -> None:
    """Counts the fork, and records the libraries that cannot be used in it."""
    global _generation
    _generation += 1
    _inherited.update(_started)
    # The clients' destructors would wait for threads that do not run here
    for client in _jax_clients():
        keep_to_the_end(client)


def _jax_clients() -> list[object]:
    """Returns JAX's clients of devices, if JAX has started. No public function of JAX returns them
    without starting them.
    """
    bridge = sys.modules.get("jax._src.xla_bridge")
    return list(getattr(bridge, "_backends", {}).values())


after_fork(_mark_forked)
