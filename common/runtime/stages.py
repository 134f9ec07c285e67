"""Timing of the stages of a run's start, up to its first update, in any thread; each is a line of
the log.
"""

import contextlib
import logging
import pathlib
import re
import threading
import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import psutil

from congrasp.common.runtime.lazy_jax import jax

PROGRAM_SECONDS = 0.5
"""Least duration of the work on a compiled program that is a stage."""
_IMPORTS = "imports"
"""Name of the first stage of a process."""
_LINE = "Start: %s took %.1f s, until %.1f s after the start of the process."
_PATTERN = re.compile(
    r"Start: (.+) took ([\d.]+) s, until ([\d.]+) s after the start of the process"
)
_RESOLUTION_S = 0.15
"""Largest error of a begin or end that is read from a log."""
_log = logging.getLogger(__name__)


class Stage(NamedTuple):
    """A stage of the start; times in seconds since this process began."""

    name: str
    began: float
    ended: float


_BEGAN = psutil.Process().create_time()
_PROGRAM_WORK = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile or read",
}
_lock = threading.Lock()
_stages: dict[str, Stage] = {}


def since_start() -> float:
    """Seconds since this process began."""
    return time.time() - _BEGAN


@contextlib.contextmanager
def stage(name: str) -> Iterator[None]:
    """Times the block as the stage of this name, unless the stage exists: later calls do not belong
    to the start.
    """
    began = since_start()
    try:
        yield
    finally:
        _add(Stage(name, began, since_start()))


def record_import_stage(ended_s: float | None = None) -> None:
    """Records the time since the start of this process as the stage of imports. From now on JAX's
    work on programs is recorded as stages.

    Args:
      ended_s: the end of the imports in seconds since this process began, if it is earlier.
    """
    _add(Stage(_IMPORTS, 0.0, since_start() if ended_s is None else ended_s))
    jax.monitoring.register_event_duration_secs_listener(_add_program)


def stages() -> list[Stage]:
    """Stages so far, ordered by their start; those of different threads overlap."""
    with _lock:
        return sorted(_stages.values(), key=lambda one: one.began)


def logged_stages(log: pathlib.Path, began: float) -> list[Stage]:
    """Returns the stages of another process, of its last start, in the order of its log.

    Stages within another one, such as the compilation of a program, are left out.

    Args:
      log: log of the process; there are no stages if it is absent.
      began: start of that process, in seconds since this process began.
    """
    if not log.is_file():
        return []
    logged: list[Stage] = []
    for name, seconds, ended in _PATTERN.findall(log.read_text(encoding="utf-8", errors="replace")):
        if name == _IMPORTS:
            logged.clear()
        logged.append(Stage(name, began + float(ended) - float(seconds), began + float(ended)))
    return [one for one in logged if not _is_within_any(one, logged)]


def _is_within_any(one: Stage, others: Sequence[Stage]) -> bool:
    """True if a stage is a part of another one."""
    return any(_is_within(one, other) for other in others)


def _is_within(one: Stage, other: Stage) -> bool:
    """True if a stage is a part of this other one."""
    is_shorter = one.ended - one.began < other.ended - other.began
    begins_within = one.began > other.began - _RESOLUTION_S
    ends_within = one.ended < other.ended + _RESOLUTION_S
    return is_shorter and begins_within and ends_within


def _add(one: Stage) -> None:
    """Records and logs a stage, if it is the first of its name."""
    with _lock:
        if one.name in _stages:
            return
        _stages[one.name] = one
    _log.info(_LINE, one.name, one.ended - one.began, one.ended)


def _add_program(event: str, duration_secs: float, **about: str | int) -> None:
    """Records JAX's work on a program, by the program's name."""
    if event in _PROGRAM_WORK and duration_secs >= PROGRAM_SECONDS:
        name = str(about.get("fun_name")).removeprefix("jit(").removesuffix(")")
        ended = since_start()
        _add(Stage(f"{_PROGRAM_WORK[event]} {name}", ended - duration_secs, ended))
