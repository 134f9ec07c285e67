"""Detection of forked processes, in which Zenoh's and JAX's threads do not run.

A fork copies one thread alone. Whatever waits for another one then waits without end, inside native
code that knows no deadline, so calls are refused before they reach it.
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
    """A number that differs between a process and its forks, for `require_same_process`."""
    return _generation


def require_same_process(opened: int, what: str) -> None:
    """Raises a ForkError in a fork of the process that opened something.

    Args:
      opened: `generation` when it was opened.
      what: its name in the message, such as `policy`.
    """
    if opened != _generation:
        raise ForkError(f"This {what} was opened before the process was forked.")


def note_started(library: str) -> None:
    """Records that a library has started threads, which forks of this process will lack."""
    _started.add(library)


def detect_jax() -> None:
    """Records that JAX has started, also by the caller's code; runs before each fork."""
    if _jax_clients():
        note_started("JAX")


def require_not_inherited(library: str) -> None:
    """Raises a ForkError if this process was forked after the library had started threads."""
    if library in _inherited:
        raise ForkError(f"This process was forked after {library} had started.")


def keep_to_the_end(native: object) -> None:
    """Keeps an object alive until the process ends, for a fork in which its destructor would wait
    for threads that do not run there, or crash.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(native))


def _in_child() -> None:
    """Counts the fork; what had started is unusable from now on."""
    global _generation
    _generation += 1
    _inherited.update(_started)
    for client in _jax_clients():
        keep_to_the_end(client)


def _jax_clients() -> list[object]:
    """JAX's clients of devices; it has no public function that returns them without starting
    them.
    """
    bridge = sys.modules.get("jax._src.xla_bridge")
    return list(getattr(bridge, "_backends", {}).values())


after_fork(_in_child)
