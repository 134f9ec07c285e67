"""`congrasp actor`: one actor."""

import dataclasses
import pathlib
from typing import Annotated

import tyro

from congrasp.actors.physics import PhysicsName
from congrasp.common.io.journal import Journal
from congrasp.common.runtime.parallel import cores
from congrasp.common.transport import urls
from congrasp.common.transport.keys import process_name
from congrasp.common.transport.ports import LEARNER_URL
from congrasp.services.ops.lifetime import on_signal
from congrasp.services.ops.logs import Watch, announced, log
from congrasp.services.ops.metrics import ActorMetrics


@dataclasses.dataclass(frozen=True)
class Actor:
    """Run one actor for a learner on this or another machine; actors may join and leave during
    training.

    Examples:
      congrasp actor --connect tcp/127.0.0.1:7447 --run human
      congrasp actor --connect tls/10.0.0.5:7447 --run human --certs actor.1
    """

    connect: str = LEARNER_URL
    """The learner's endpoint, such as tcp/10.0.0.5:7447."""
    run: str = "quickstart"
    """Name of the run."""
    id: Annotated[str, tyro.conf.arg(name="id")] = ""
    """Name of this actor, unique in the run; host name and process number by default."""
    physics: PhysicsName = "auto"
    """Engine; auto takes warp on an NVIDIA GPU and native on a CPU."""
    threads: int = 0
    """Threads of the native engine; 0 uses all cores."""
    patience: float = 60.0
    """Seconds without a learner after which the actor gives up."""
    audit: pathlib.Path | None = None
    """Journal of every rollout and the learner's reply, for 'congrasp audit'; none by default."""
    references: pathlib.Path | None = None
    """File that preserves the reference poses from the policy's grasps for the next start."""
    watch: Watch = Watch()  # noqa: RUF009
    """Monitoring."""
    certs: pathlib.Path | None = None
    """Folder of an actor's certificate (congrasp certs), whose number is the prefix of its name on
    the wire.
    """

    def __call__(self) -> int:
        """Acts until the run ends or a signal comes."""
        from congrasp.actors.process import run_actor
        from congrasp.common.runtime.stages import imported, since_start

        name, metrics = (
            urls.name_on_wire(self.id or process_name("actor"), self.certs),
            ActorMetrics(),
        )

        def report(values: dict[str, float]) -> None:
            metrics.rollout(values)
            log(
                "info",
                f"Rollout {values['rollouts']:.0f}: {values['steps_per_second']:.0f} steps/s.",
                values,
            )

        with self.watch.watched("actor", name, self.run, metrics), on_signal() as stop:
            ready = since_start()
            with announced(f"Waiting up to {self.patience:g} s for the learner at {self.connect}"):
                transport = urls.connect(
                    self.connect, "actor", certs=self.certs, wait=self.patience, run=self.run
                )
            with transport:
                log("info", f"Connected to the learner at {self.connect}.")
                imported(ready)
                journal = (
                    Journal(self.audit, lambda text: log("error", text)) if self.audit else None
                )
                run_actor(
                    transport,
                    run=self.run,
                    actor=name,
                    stop=stop,
                    physics=self.physics,
                    threads=self.threads or cores(),
                    patience=self.patience,
                    on_rollout=report,
                    journal=journal,
                    references=self.references,
                )
            return stop.exit_code


COMMAND = Actor
