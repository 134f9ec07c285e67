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

from congrasp.actors.harvest import references_file
from congrasp.actors.physics import prepare_physics
from congrasp.actors.process import run_actor
from congrasp.common.config import MetricWriter, RunConfig
from congrasp.common.hands import get_hand
from congrasp.common.policy.bundle import policy_spec
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.parallel import cores, prepare_workers
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.memory import PairTransport
from congrasp.learner.algorithms import make_algorithm
from congrasp.learner.algorithms.protocol import rollout_form
from congrasp.learner.distributed.ranks import ROUND_SECONDS, Ranks
from congrasp.learner.process import run_learner
from congrasp.learner.run_directory import LOGS, create_run, has_checkpoints
from congrasp.services.ops.lifetime import GRACE
from congrasp.services.ops.logs import Watch
from congrasp.services.ops.metrics import LearnerMetrics
from congrasp.services.ops.status import ask
from congrasp.services.record.recorder import recorded
from congrasp.services.train.accelerators import engine_of

_START_SECONDS = 0.5
"""Head start of the learner, which must listen first, over the actor, s."""


def learn(  # noqa: PLR0913
    run_dir: pathlib.Path,
    config: RunConfig,
    *,
    wire: Transport | None,
    inside: PhysicsName | None,
    stop: threading.Event,
    ranks: Ranks | None = None,
    on_update: Callable[[dict[str, float]], None] = lambda values: None,
    on_event: Callable[[str, str], None] = lambda level, text: None,
    writers: Sequence[MetricWriter] = (),
    watch: Watch = Watch(),  # noqa: B008
    audit: bool = True,
    grace: float = GRACE,
) -> None:
    """Runs a learner from the newest checkpoint, if there is one, until it is finished or stopped.

    An actor in the same process shares the processors: acting with old weights during an update
    would gain nothing. Updates are then on-policy, regardless of `max_staleness`.

    Args:
      run_dir: see `run_learner`, also for `config`, `ranks`, `on_update` and `on_event`.
      wire: a listening transport for rollouts and status queries of others; None only with an actor
        inside.
      inside: engine of an actor in this process, over the in-memory transport; None for no actor.
      stop: ends training.
      writers: metric writers of rank 0.
      watch: endpoint of the metrics.
      audit: writes the journal, unless an actor inside keeps its rollouts on the device.
      grace: deadline for the end of the actor inside, s.
    """
    rank, transport = 0 if ranks is None else ranks.rank, wire
    with contextlib.ExitStack() as stack:
        if inside is not None:
            prepare_workers(config.objects.count)
            prepare_physics(inside, get_hand(config.task.hand), config.task)
            config = dataclasses.replace(config, max_staleness=0)
            memory = stack.enter_context(urls.listen(url := f"memory/{run_dir}", "learner"))
            transport = memory if wire is None else PairTransport(memory, wire)
        assert transport is not None, "the learner must be reachable"
        metrics = LearnerMetrics(functools.partial(ask, transport, config.name))

        def updated(values: dict[str, float]) -> None:
            metrics.update(values)
            on_update(values)

        stack.enter_context(watch.exposed(metrics))
        if inside is not None:
            stack.enter_context(
                _actor_thread(url, config, run_dir, f"actor-{rank}", inside, stop, grace)
            )
        run_learner(
            run_dir,
            config,
            transport,
            stop_event=stop,
            resume=rank == 0 and has_checkpoints(run_dir),
            ranks=ranks,
            audit=audit,
            on_host=inside is None,
            recorder=recorded(transport, config, run_dir, run_dir / LOGS, writers)
            if rank == 0
            else None,
            on_update=updated,
            on_event=on_event,
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
    physics: PhysicsName,
    stop: threading.Event,
    grace: float,
) -> Iterator[None]:
    """Context with an actor in a separate thread; a failure sets `stop`, and its error is
    raised.
    """
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
                    threads=cores(),
                    patience=ROUND_SECONDS,
                    references=references_file(run_dir, name),
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
            thread.join(grace)
    if failures:
        raise failures[0]


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
            on_update=updated,
            grace=_GRACE,
        )
