"""Ctrl-C where a library swallows its exception.

Python raises KeyboardInterrupt between any two bytecodes of the main thread, also inside callbacks
whose exceptions it only prints, such as those of the garbage collector, of weak references and of
`__del__`: the command would continue as if there had been no signal.
"""

import contextlib
import ctypes
import sys
import threading
from collections.abc import Iterator
from typing import Any

from congrasp.services.ops.lifetime import Stop

_RAISE_AGAIN_AFTER_S = 0.05
"""Time from a swallowed interrupt until it is raised again."""
_stops: list[Stop] = []
"""Stops of the commands that run in this process, the innermost last."""


@contextlib.contextmanager
def interrupts_reach(stop: Stop) -> Iterator[None]:
    """Context of a command in the main thread: an interrupt that a callback swallowed is raised
    again, and `check_stopped` raises it wherever the command calls that.
    """
    previous_hook = sys.unraisablehook
    ended = threading.Event()
    # Held while the interrupt is raised again, so that the context ends either before or after it.
    ending = threading.Lock()

    def raise_unless_ended() -> None:
        with ending:
            if not ended.is_set():
                raise_in_main_thread()

    def hook(unraisable: Any) -> None:
        if unraisable.exc_type is not KeyboardInterrupt:
            previous_hook(unraisable)
            return
        # Not here: it would be raised inside this hook, and be swallowed as well.
        timer = threading.Timer(_RAISE_AGAIN_AFTER_S, raise_unless_ended)
        timer.daemon = True
        timer.start()

    sys.unraisablehook = hook
    _stops.append(stop)
    try:
        yield
    finally:
        try:
            with ending:
                ended.set()
        finally:  # also if the interrupt that was raised again arrives in the lines above
            _stops.pop()
            sys.unraisablehook = previous_hook


def check_stopped() -> None:
    """Raises KeyboardInterrupt in the main thread of a command that a signal has stopped."""
    in_main_thread = threading.current_thread() is threading.main_thread()
    if in_main_thread and _stops and _stops[-1].is_set():
        raise KeyboardInterrupt


def raise_in_main_thread() -> None:
    """Raises KeyboardInterrupt in the main thread, between two bytecodes.

    It sends no signal, since a second one would end the process at once (`lifetime.on_signal`).
    """
    thread_id = ctypes.c_ulong(threading.main_thread().ident or 0)
    exception = ctypes.py_object(KeyboardInterrupt)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(thread_id, exception)
