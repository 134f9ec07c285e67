"""Ctrl-C where a library swallows its exception, and the last line of a stopped command.

Python raises KeyboardInterrupt between any two bytecodes of the main thread, also inside callbacks
whose exceptions it only prints, such as those of the garbage collector, of weak references and of
`__del__`: the command would continue as if there had been no signal.
"""

import contextlib
import ctypes
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

from congrasp.services.ops.lifetime import Stop

_AGAIN = 0.05  # seconds until a swallowed interrupt is raised again
_current: list[Stop] = []
"""Stops of the commands that run in this process, the innermost last."""


@contextlib.contextmanager
def interrupts_reach(stop: Stop) -> Iterator[None]:
    """Context of a command in the main thread: an interrupt that a callback swallowed is raised
    again, and `check_stopped` raises it wherever the command calls that.
    """
    before = sys.unraisablehook
    ended = threading.Event()

    def raise_unless_ended() -> None:
        if not ended.is_set():
            _raise_in_main_thread()

    def hook(unraisable: Any) -> None:
        if unraisable.exc_type is not KeyboardInterrupt:
            before(unraisable)
            return
        # Not here: it would be raised inside this hook, and be swallowed as well.
        again = threading.Timer(_AGAIN, raise_unless_ended)
        again.daemon = True
        again.start()

    sys.unraisablehook = hook
    _current.append(stop)
    try:
        yield
    finally:
        ended.set()
        _current.remove(stop)
        sys.unraisablehook = before


def check_stopped() -> None:
    """Raises KeyboardInterrupt in the main thread of a command that a signal has stopped."""
    in_main_thread = threading.current_thread() is threading.main_thread()
    if in_main_thread and _current and _current[-1].is_set():
        raise KeyboardInterrupt


def _raise_in_main_thread() -> None:
    """Raises KeyboardInterrupt in the main thread, between two bytecodes.

    It is no signal, since a second one ends the process at once (`lifetime.on_signal`).
    """
    identifier = ctypes.c_ulong(threading.main_thread().ident or 0)
    interrupt = ctypes.py_object(KeyboardInterrupt)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(identifier, interrupt)


def ending(code: int) -> str:
    """Returns the last line of a command with the exit code of a signal."""
    if code == 128 + signal.SIGINT:
        return "Stopped by Ctrl-C."
    return f"Stopped by {signal.Signals(code - 128).name}."
