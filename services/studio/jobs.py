"""Background jobs of a session: one at a time, whose progress the page polls."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.services.ops.logs import log
from congrasp.services.studio.grasping import SECONDS, Progress


class Jobs:
    """Runs one job at a time in a separate thread."""

    def __init__(self) -> None:
        """Begins without a job."""
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="studio")
        self._lock = threading.RLock()
        self._number = 0
        self._since = 0.0
        self._state: dict[str, Any] = _state(0, running=False)

    def start(self, text: str, work: Callable[[Progress], str | None]) -> dict[str, Any]:
        """Begins a job, which may return the key of its result; returns the job's state.

        Raises:
          CongraspError: another job is still running.
        """
        with self._lock:
            self.require_idle()
            self._number += 1
            self._since = time.monotonic()
            self._state = _state(self._number, text=text)
            self._pool.submit(self._run, work)
            return dict(self._state)

    def require_idle(self) -> None:
        """Raises a CongraspError while a job is running."""
        with self._lock:
            if self._state["running"]:
                raise CongraspError(f"Please wait: {self.state()['text']}.")

    def state(self) -> dict[str, Any]:
        """The current job, or the last one: number, running, text, share, error, and the key of its
        result (made).
        """
        with self._lock:
            seconds = f"{time.monotonic() - self._since:.0f}"
            return {**self._state, "text": self._state["text"].replace(SECONDS, seconds)}

    def close(self) -> None:
        """Rejects further jobs, without waiting for a running one."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _run(self, work: Callable[[Progress], str | None]) -> None:
        """Runs a job to its end and stores its result or error."""
        message = ""
        result = None
        try:
            result = work(self._progress)
        except CongraspError as error:
            message = str(error)
        except Exception as error:  # the page shows any error of a job, and the studio continues
            kind = type(error).__name__
            message = f"Internal error of congrasp: {kind}: {error}."
            log("error", message)
        with self._lock:
            self._state |= {"running": False, "share": 1.0, "error": message, "made": result}

    def _progress(self, text: str, share: float) -> None:
        """Stores the progress of the job."""
        with self._lock:
            self._state |= {"text": text, "share": min(1.0, max(0.0, share))}


def _state(number: int, *, running: bool = True, text: str = "") -> dict[str, Any]:
    """A job's state at its start."""
    return {
        "number": number,
        "running": running,
        "text": text,
        "share": 0.0,
        "error": "",
        "made": None,
    }
