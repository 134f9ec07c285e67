"""`congrasp actor`: one actor."""

import pathlib
from typing import Annotated

import tyro

from congrasp.actors.physics import PhysicsName
from congrasp.common.transport.ports import LEARNER_URL
from congrasp.services.ops.logs import Watch, announced, log


def actor(
    connect: str = LEARNER_URL,
    run: str = "quickstart",
    id: Annotated[str, tyro.conf.arg(name="id")] = "",
    physics: PhysicsName = "auto",
    threads: int = 0,
    patience: float = 60.0,
    audit: pathlib.Path | None = None,
    references: pathlib.Path | None = None,
    watch: Watch = Watch(),  # noqa: B008
    certs: pathlib.Path | None = None,
) -> int:
    """Run one actor for a learner on this or another machine; actors may join and leave during training.

    Args:
      connect: The learner's endpoint, such as tcp/10.0.0.5:7447.
      run: Name of the run.
      id: Name of this actor, unique in the run; host name and process number by default.
      physics: Engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      threads: Threads of the native engine; 0 uses all cores.
      patience: Seconds without a learner after which the actor gives up.
      audit: Journal of every rollout and the learner's reply, for 'congrasp audit'; none by default.
      references: File that preserves the reference poses from the policy's grasps for the next start.
      watch: Monitoring.
      certs: Folder of an actor's certificate (congrasp certs), whose number is the prefix of its name on the wire.

    Examples:
      congrasp actor --connect tcp/127.0.0.1:7447 --run human
      congrasp actor --connect tls/10.0.0.5:7447 --run human --certs actor.1
    """
    from congrasp.actors.process.actor import run_actor
    from congrasp.common.io.journal import Journal
    from congrasp.common.runtime.parallel import cores
    from congrasp.common.transport import urls
    from congrasp.common.transport.keys import process_name
    from congrasp.services.ops.metrics import ActorMetrics
    from congrasp.services.ops.shutdown import on_signal

    name = urls.name_on_wire(id or process_name("actor"), certs)
    metrics = ActorMetrics()

    def report(values: dict[str, float]) -> None:
        metrics.rollout(values)
        log("info", f"Rollout {values['rollouts']:.0f}: {values['steps_per_second']:.0f} steps/s.", values)

    with watch.watched("actor", name, run, metrics), on_signal() as stop:
        with announced(f"Waiting up to {patience:g} s for the learner at {connect}"):
            transport = urls.connect(connect, "actor", certs=certs, wait=patience, run=run)
        with transport:
            log("info", f"Connected to the learner at {connect}.")
            run_actor(
                transport,
                run=run,
                actor=name,
                stop=stop,
                physics=physics,
                threads=threads or cores(),
                patience=patience,
                on_rollout=report,
                journal=Journal(audit, lambda text: log("error", text)) if audit else None,
                references=references,
            )
        return stop.exit_code


COMMAND = actor
