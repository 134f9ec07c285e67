"""`congrasp actor`: one actor. Heavy imports are inside functions, so that `--help` is quick."""

import dataclasses
import importlib
import math
import pathlib
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from congrasp.actors.physics import PhysicsName
from congrasp.common.errors import CongraspError
from congrasp.common.io.journal import AUDIT, Journal, user_journal
from congrasp.common.runtime.resources import cores
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import process_name
from congrasp.common.transport.ports import LEARNER_URL
from congrasp.services.cli.arguments import has_option, option_value
from congrasp.services.ops.lifetime import Stop, on_signal
from congrasp.services.ops.logs import MonitoringOptions, log
from congrasp.services.ops.metrics import ActorMetrics
from congrasp.services.ops.waiting import connect_when_up

if TYPE_CHECKING:
    from congrasp.actors.link import OpenJournal


@dataclasses.dataclass(frozen=True)
class Actor:
    """Run one actor for a learner on this or another machine. Actors may join and leave during the
    training.

    Examples:
      congrasp actor --connect tcp/127.0.0.1:7447 --run human
      congrasp actor --connect tls/10.0.0.5:7447 --run human --certs actor.1
    """

    launch: pathlib.Path | None = None
    """`launch.json` of a run that `congrasp train` started, whose values for the actor --id are the
    defaults of the other options. `congrasp train` passes it to its processes.
    """
    # `defaults` reads --launch before the command line is parsed
    connect: str = LEARNER_URL
    """Endpoint of the learner, such as tcp/10.0.0.5:7447."""
    run: str = "quickstart"
    """Name of the run."""
    id: Annotated[str, tyro.conf.arg(name="id")] = ""
    """Name of this actor, unique in the run; by default the host name and the process number."""
    physics: PhysicsName = "auto"
    """Physics engine; auto takes warp on an NVIDIA GPU and native on a CPU."""
    threads: int = 0
    """Number of threads of the native engine, and of processes of PhysX; 0 uses all cores."""
    patience: float | None = None
    """Seconds for which the actor waits for a disconnected learner; without limit by default."""
    audit: pathlib.Path | None = None
    """Journal of every rollout and the learner's reply, for 'congrasp audit'. By default it is in
    ~/.local/state/congrasp/audit, where 'congrasp audit' on this machine finds it."""
    no_audit: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write no journal."""
    references: pathlib.Path | None = None
    """File in which the actor stores the reference poses from the policy's grasps. At its next
    start it reads them from there."""
    monitoring: Annotated[MonitoringOptions, tyro.conf.arg(name="")] = MonitoringOptions()  # noqa: RUF009
    """Monitoring."""
    certs: pathlib.Path | None = None
    """Folder of an actor's certificate (congrasp certs). The number of the certificate is the
    prefix of the actor's name in messages.
    """

    def __call__(self) -> int:
        """Acts until the run ends, or until a signal."""
        if self.no_audit and self.audit is not None:
            raise CongraspError(
                f"--audit {self.audit} contradicts --no-audit.", "Leave out one of them."
            )
        importlib.import_module("congrasp.actors.process")  # takes seconds, so before it connects
        name = urls.name_on_wire(self.id or process_name("actor"), self.certs)
        metrics = ActorMetrics()
        monitor = self.monitoring.monitor("actor", name, self.run, metrics)
        with monitor, on_signal() as stop:
            reason = self._connect_and_act(name, metrics, stop)
            if stop.is_set():  # a signal explains the end better
                reason = stop.reason
            log("info", f"The actor ends: {reason}.")
            return stop.exit_code

    def _connect_and_act(self, name: str, metrics: ActorMetrics, stop: Stop) -> str:
        """Waits for the learner, then acts; returns the reason of the end."""
        from congrasp.common.runtime.stages import record_import_stage, since_start

        imports_ended_s = since_start()
        transport = connect_when_up(
            self.connect,
            "actor",
            certs=self.certs,
            run=self.run,
            patience=self.patience,
            stop=stop,
        )
        if transport is None:
            return "stopped"
        with transport:
            log("info", f"Connected to the learner at {self.connect}.")
            record_import_stage(imports_ended_s)
            return self._act(transport, name, metrics, stop)

    def _act(self, transport: Transport, name: str, metrics: ActorMetrics, stop: Stop) -> str:
        """Acts over a connected transport; returns the reason of the end."""
        from congrasp.actors.process import ActorOptions, run_actor

        def report(values: dict[str, float]) -> None:
            metrics.rollout(values)
            log(
                "info",
                f"Rollout {values['rollouts']:.0f}: {values['steps_per_second']:.0f} steps/s.",
                values,
            )

        options = ActorOptions(
            run=self.run,
            actor=name,
            physics=self.physics,
            threads=self.threads or cores(),
            patience=math.inf if self.patience is None else self.patience,
            on_rollout=report,
            journal=None if self.no_audit else self._journal_opener(name),
            references=self.references,
        )
        return run_actor(transport, options, stop)

    def _journal_opener(self, name: str) -> "OpenJournal":
        """Returns a function that opens the journal of a run id: the file named by --audit, or else
        a journal in the user's folder.
        """

        def report_failure(text: str) -> None:
            log("error", text)

        def open_journal(run_id: str) -> Journal | None:
            if self.audit is not None:
                return Journal(self.audit, report_failure)
            return user_journal(run_id, name, report_failure)

        return open_journal


def defaults(arguments: list[str]) -> dict[str, Any]:
    """Returns the values that replace the defaults of `Actor`'s fields if the command line has
    --launch: the options of the actor --id in that file.
    """
    launch_file = option_value("--launch", arguments)
    if not launch_file:
        return {}
    from congrasp.actors.references_file import references_file
    from congrasp.services.train.launch import read_launch

    path = pathlib.Path(launch_file)
    run_dir = path.parent
    record = read_launch(path)
    name = option_value("--id", arguments)
    values: dict[str, Any] = {
        "connect": record.learner_of_actor(name),
        "run": record.run,
        "physics": record.physics,
        "threads": record.actor_threads,
        "references": references_file(run_dir, name),
        "certs": record.launch.certs,
    }
    # A default must not contradict an option on the command line
    if has_option("--audit", arguments) or has_option("--no-audit", arguments):
        return values
    if record.launch.learner.audit:
        values["audit"] = run_dir / AUDIT / f"{name}.jsonl"
    else:
        values["no_audit"] = True
    return values


COMMAND = Actor
