"""Runs a learner with its metrics and recordings and, if rollouts stay on the device, an actor in
the same process.
"""

import contextlib
import dataclasses
import functools
import pathlib
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from congrasp.actors.physics import prepare_physics
from congrasp.actors.process import ActorOptions, run_actor
from congrasp.actors.references_file import references_file
from congrasp.common.config import MetricWriter, RunConfig
from congrasp.common.hands import get_hand
from congrasp.common.policy.bundle import policy_spec
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.parallel import prepare_workers
from congrasp.common.runtime.resources import cores
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.memory import PairTransport
from congrasp.learner.algorithms import make_algorithm
from congrasp.learner.algorithms.protocol import rollout_form
from congrasp.learner.distributed.ranks import ROUND_SECONDS, Ranks
from congrasp.learner.process import Notify, Outputs, run_learner
from congrasp.learner.run_directory import LOGS, create_run, has_checkpoints
from congrasp.services.ops.lifetime import GRACE_S
from congrasp.services.ops.logs import MonitoringOptions
from congrasp.services.ops.metrics import LearnerMetrics
from congrasp.services.ops.status import ask
from congrasp.services.record.run_recording import recorded
from congrasp.services.train.accelerators import engine_of

_HEAD_START_S = 0.5
"""Head start of the learner, which must listen first, over the actor."""
_MAX_ROLLOUT_S = 60.0
"""Longest rollout of a first update: a process that exits within one would abort."""


class InnerActor(NamedTuple):
    """An actor in the learner's process."""

    physics: PhysicsName
    """Its engine."""
    end_timeout: float = GRACE_S
    """Deadline for its end, s."""


class Monitoring(NamedTuple):
    """Records and callbacks of a learner."""

    on_update: Callable[[dict[str, float]], None] = lambda values: None
    """See `learner.process.Outputs`."""
    on_event: Notify = lambda level, text: None
    """See `learner.process.Outputs`."""
    writers: Sequence[MetricWriter] = ()
    """Metric writers of rank 0."""
    watch: MonitoringOptions = MonitoringOptions()
    """Endpoint of the metrics."""
    audit: bool = True
    """Writes the journal, unless an actor inside keeps its rollouts on the device."""


def learn(
    run_dir: pathlib.Path,
    config: RunConfig,
    *,
    wire: Transport | None,
    inside: InnerActor | None,
    stop: threading.Event,
    ranks: Ranks | None = None,
    monitoring: Monitoring = Monitoring(),  # noqa: B008
) -> None:
    """Runs a learner from the newest checkpoint, if there is one, until it is finished or stopped.

    An actor in the same process shares the processors: acting with old weights during an update
    would gain nothing. Updates are then on-policy, regardless of `max_staleness`.

    Args:
      run_dir: see `run_learner`, also for `config` and `ranks`.
      wire: a listening transport for rollouts and status queries of others; None only with an actor
        inside.
      inside: an actor in this process, over the in-memory transport; None for no actor.
      stop: ends training.
      monitoring: records and callbacks.
    """
    rank = 0 if ranks is None else ranks.rank
    transport = wire
    memory_url = f"memory/{run_dir}"
    with contextlib.ExitStack() as stack:
        if inside is not None:
            prepare_workers(config.objects.count)
            prepare_physics(inside.physics, get_hand(config.task.hand), config.task)
            config = dataclasses.replace(config, max_staleness=0)
            memory = stack.enter_context(urls.listen(memory_url, "learner"))
            transport = memory if wire is None else PairTransport(memory, wire)
        assert transport is not None, "the learner must be reachable"
        metrics = LearnerMetrics(functools.partial(ask, transport, config.name))

        def on_update(values: dict[str, float]) -> None:
            metrics.update(values)
            monitoring.on_update(values)

        stack.enter_context(monitoring.watch.serve_metrics(metrics))
        if inside is not None:
            name = f"actor-{rank}"
            stack.enter_context(_actor_thread(memory_url, config, run_dir, name, inside, stop))
        recorder = None
        if rank == 0:
            recorder = recorded(transport, config, run_dir, run_dir / LOGS, monitoring.writers)
        run_learner(
            run_dir,
            config,
            transport,
            stop_event=stop,
            resume=rank == 0 and has_checkpoints(run_dir),
            ranks=ranks,
            outputs=Outputs(
                audit=monitoring.audit,
                on_host=inside is None,
                recorder=recorder,
                on_update=on_update,
                on_event=monitoring.on_event,
            ),
        )


def longest_rollout(config: RunConfig) -> int:
    """Limit of rollout messages: twice the size of the run's rollouts, bytes."""
    spec = policy_spec(config.task, config.network)
    form = rollout_form(config, spec, make_algorithm(spec, config).batch_schema)
    return 2 * sum(array.nbytes for array in form.zeros().values())


@contextlib.contextmanager
def _actor_thread(
    url: str,
    config: RunConfig,
    run_dir: pathlib.Path,
    name: str,
    inside: InnerActor,
    stop: threading.Event,
) -> Iterator[None]:
    """Context with an actor in a separate thread; a failure sets `stop`, and its error is
    raised.
    """
    failures: list[BaseException] = []
    ended = threading.Event()

    def act() -> None:
        try:
            with urls.connect(url, "actor") as transport:
                options = ActorOptions(
                    run=config.name,
                    actor=name,
                    physics=inside.physics,
                    threads=cores(),
                    patience=ROUND_SECONDS,
                    references=references_file(run_dir, name),
                )
                run_actor(transport, options, ended)
        except BaseException as error:
            failures.append(error)
            stop.set()

    thread = threading.Thread(target=act, name="actor", daemon=True)
    start = threading.Timer(_HEAD_START_S, thread.start)
    start.start()
    try:
        yield
    finally:
        ended.set()
        start.cancel()
        if thread.ident is not None:
            thread.join(inside.end_timeout)
    if failures:
        raise failures[0]


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

    def on_update(values: dict[str, float]) -> None:
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
            inside=InnerActor(engine_of(physics, False), end_timeout=_MAX_ROLLOUT_S),
            stop=stop,
            monitoring=Monitoring(on_update=on_update),
        )
