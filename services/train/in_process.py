"""A learner and an actor in one process: rollouts never leave the device."""

import contextlib
import dataclasses
import functools
import os
import pathlib
import threading
from collections.abc import Callable, Iterator, Sequence

from actors.process import run_actor
from common.config import MetricWriter, RunConfig
from common.engines import PhysicsName
from common.transport import urls
from common.transport.base import Transport
from common.transport.pair import PairTransport
from learner.process import run_learner
from learner.ranks import ROUND_SECONDS, Ranks
from services.ops.metrics import LearnerMetrics, exposed
from services.ops.shutdown import GRACE
from services.ops.status import ask
from services.train.metric_writers import recorded

_START_SECONDS = 0.5
"""By which the learner, which must listen first, is ahead of the actor."""


def train_in_process(
    run_dir: pathlib.Path,
    config: RunConfig,
    *,
    physics: PhysicsName,
    stop: threading.Event,
    resume: bool,
    ranks: Ranks | None = None,
    wire: Transport | None = None,
    on_update: Callable[[dict[str, float]], None] = lambda values: None,
    on_event: Callable[[str, str], None] = lambda level, text: None,
    writers: Sequence[MetricWriter] = (),
    metrics_port: int = 0,
) -> None:
    """The same learner and one actor in this process, over the in-memory transport.

    The two share their processors: to act under old weights while the learner updates would gain nothing. So updates
    are on-policy, whatever `max_staleness` is.

    Args:
      run_dir: see `run_learner`, as `config`, `resume`, `ranks`, `on_update` and `on_event`.
      physics: engine of the actor.
      stop: ends training.
      wire: a transport that listens, where others may ask how things stand, and send rollouts, too.
      writers: which metric writers get its metrics.
      metrics_port: port of a Prometheus endpoint on the loopback interface; 0 for none.
    """
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, max_staleness=0))
    rank, url = 0 if ranks is None else ranks.rank, f"memory/{run_dir}"
    with urls.listen(url, "learner") as memory:
        metrics = LearnerMetrics(functools.partial(ask, memory, config.name))

        def updated(values: dict[str, float]) -> None:
            metrics.update(values)
            on_update(values)

        with (
            exposed(metrics_port, "127.0.0.1", metrics) if metrics_port else contextlib.nullcontext(),
            _actor_thread(url, config, f"actor-{rank}", physics, stop),
        ):
            run_learner(
                run_dir,
                config,
                memory if wire is None else PairTransport(memory, wire),
                stop_event=stop,
                resume=resume,
                ranks=ranks,
                audit=False,
                recorder=recorded(memory, config, run_dir, writers) if rank == 0 else None,
                on_update=updated,
                on_event=on_event,
            )


@contextlib.contextmanager
def _actor_thread(
    url: str, config: RunConfig, name: str, physics: PhysicsName, stop: threading.Event
) -> Iterator[None]:
    """An actor in a thread of its own while the block runs; should it fail, it sets `stop`, and its error is raised."""
    failures: list[BaseException] = []
    ended = threading.Event()

    def act() -> None:
        try:
            with urls.connect(url, "actor") as transport:
                run_actor(
                    transport,
                    run=config.name,
                    actor=name,
                    stop=ended,
                    physics=physics,
                    threads=os.cpu_count() or 1,
                    patience=ROUND_SECONDS,
                )
        except BaseException as error:
            failures.append(error)
            stop.set()

    thread = threading.Thread(target=act, name="actor", daemon=True)
    start = threading.Timer(_START_SECONDS, thread.start)
    start.start()
    try:
        yield
    finally:
        ended.set()
        start.cancel()
        if thread.ident is not None:
            thread.join(GRACE)
    if failures:
        raise failures[0]
