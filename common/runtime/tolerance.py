"""Python's warnings while the library works, for callers that turn warnings into errors."""

import contextlib
import threading
import warnings
from collections.abc import Iterator


class _Tolerance:
    """Ignores warnings while at least one thread is inside.

    Filters belong to the process, so only the first thread to enter replaces them, and only the
    last one to leave restores them.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._filters: contextlib.AbstractContextManager[object] | None = None

    def enter(self) -> None:
        """Ignores all warnings if the caller has made errors of some."""
        with self._lock:
            if self._inside == 0 and _are_errors():
                self._filters = warnings.catch_warnings()
                self._filters.__enter__()
                warnings.simplefilter("ignore")
            self._inside += 1

    def leave(self) -> None:
        """Restores the caller's filters, unless another thread is still inside."""
        with self._lock:
            self._inside -= 1
            if self._inside == 0 and self._filters is not None:
                self._filters.__exit__(None, None, None)
                self._filters = None


_tolerance = _Tolerance()


@contextlib.contextmanager
def tolerated_warnings() -> Iterator[None]:
    """Context in which no warning is an error; without such filters, nothing changes.

    For imports and for calls that compile, which run code of many libraries. Calls of a control
    loop do without it, since it briefly replaces the filters of all threads.
    """
    _tolerance.enter()
    try:
        yield
    finally:
        _tolerance.leave()


def _are_errors() -> bool:
    """True if a filter turns warnings into errors."""
    return any(action == "error" for action, *_ in warnings.filters)
