"""A training that ends with its first update, to fill the caches of compiled programs and built data."""

import dataclasses
import pathlib
import tempfile
import threading
from collections.abc import Callable

from congrasp.common.config import RunConfig
from congrasp.common.runtime.engines import PhysicsName
from congrasp.learner.run_directory import create_run
from congrasp.services.train.launch import engine_of
from congrasp.services.train.learn import learn

_GRACE = 60.0
"""Seconds for an actor within a rollout: a process that exits meanwhile would abort."""


def until_first_update(
    config: RunConfig, physics: PhysicsName, stop: threading.Event, report: Callable[[], None]
) -> None:
    """Runs a training in this process, in a temporary folder, and ends it after its first update.

    Args:
      config: configuration of the run.
      physics: engine; `auto` uses the machine's default.
      stop: ends it earlier.
      report: called after the first update, before shutdown.
    """

    def updated(values: dict[str, float]) -> None:
        if not stop.is_set():
            report()
            stop.set()

    with tempfile.TemporaryDirectory() as folder:
        run_dir = pathlib.Path(folder, "run")
        config = dataclasses.replace(config, updates=1)
        create_run(run_dir, config, None)
        learn(
            run_dir,
            config,
            wire=None,
            inside=engine_of(physics, False),
            stop=stop,
            resume=False,
            on_update=updated,
            grace=_GRACE,
        )
