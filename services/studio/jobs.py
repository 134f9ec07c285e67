"""Work that takes longer than a click: one job at a time, with its progress."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from congrasp.common.errors import CongraspError
from congrasp.services.ops.logs import log

SECONDS = "{seconds}"
"""In the text of a job: stands for how long it runs already."""
Progress = Callable[[str, float], None]
"""(what is being done, how much of it is done from 0 to 1)."""


class Jobs:
    """Runs one job at a time in a thread of its own."""

    def __init__(self) -> None:
        """Nothing runs."""
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="studio")
        self._lock = threading.RLock()
        self._number = 0
        self._since = 0.0
        self._state: dict[str, Any] = _state(0, running=False)

    def start(self, text: str, work: Callable[[Progress], str | None]) -> dict[str, Any]:
        """Begins a job, which may return the name of what it made; returns its state.

        Raises:
          CongraspError: another one is still running.
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
        """The present job, or the last one: number, running, text, share, error, and what it made."""
        with self._lock:
            seconds = f"{time.monotonic() - self._since:.0f}"
            return {**self._state, "text": self._state["text"].replace(SECONDS, seconds)}

    def close(self) -> None:
        """Takes no more jobs, and waits for none."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _run(self, work: Callable[[Progress], str | None]) -> None:
        """Runs a job to its end and notes how it ended."""
        error, made = "", None
        try:
            made = work(self._progress)
        except CongraspError as found:
            error = str(found)
        except Exception as found:  # whatever goes wrong in a job, the page shows it and the studio continues
            error = f"This went wrong and is a fault of congrasp: {type(found).__name__}: {found}."
            log("error", error)
        with self._lock:
            self._state |= {"running": False, "share": 1.0, "error": error, "made": made}

    def _progress(self, text: str, share: float) -> None:
        """Notes how far the job is."""
        with self._lock:
            self._state |= {"text": text, "share": min(1.0, max(0.0, share))}


def _state(number: int, *, running: bool = True, text: str = "") -> dict[str, Any]:
    """A job's state at its start."""
    return {"number": number, "running": running, "text": text, "share": 0.0, "error": "", "made": None}
