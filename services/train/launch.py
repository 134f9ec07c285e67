"""Options of a run's processes, and `launch.json` in the run directory, from which the processes
that `congrasp train` starts take theirs.

`congrasp learner --launch FILE` and `congrasp actor --launch FILE --id NAME` use the file's values
as defaults of their options. An option of `congrasp train` is therefore declared here once.
"""

import dataclasses
import json
import pathlib
from typing import Annotated, NamedTuple, Self

import tyro

from congrasp.common.config import MetricWriter, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_json
from congrasp.common.io.records import record_of
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.runtime.resources import cores
from congrasp.common.transport import urls
from congrasp.common.transport.keys import FLOWS
from congrasp.common.transport.ports import (
    LAST_PORT,
    LEARNER_URL,
    check_loopback,
    check_ports,
    local_url,
    rank_url,
    reachable_url,
)
from congrasp.common.transport.security import CERTIFICATE_FILE, check_exposure
from congrasp.services.train.accelerators import engine_of, leave_gpus_to

LAUNCH_FILE = "launch.json"
_FORMAT = 1
"""Version of the file's format."""
_MAX_BYTES = 1 << 16
_REMEDY = "Start the processes again with 'congrasp train --resume'."


@dataclasses.dataclass(frozen=True)
class LearnerOptions:
    """Options that `congrasp train` and `congrasp learner` share."""

    insecure: bool = False
    """Accept connections from other machines without certificates."""
    metric_writers: tuple[MetricWriter, ...] = ("tensorboard",)
    """Additional metric writers: tensorboard (files in the run's folder), wandb-offline (files in
    the run's folder, for `wandb sync`) or wandb (needs an account). The option without a value
    switches all of them off."""
    audit: bool = True
    """Write journals of all rollouts to the run's folder, for 'congrasp audit'."""


@dataclasses.dataclass(frozen=True)
class Launch:
    """Options of a run's processes."""

    actors: int | None = None
    """Number of actor processes. By default two, or one on fewer than four cores. On a GPU the
    default is 0: a single actor runs in the learner's process, and rollouts stay on the device."""
    ranks: int = 1
    """Number of learners for data-parallel training. Each learner has --actors actors, and its own
    GPU if there are GPUs. The batch size is proportional to the number of learners."""
    listen: str | None = None
    """Endpoint for actors on other machines, such as tls/0.0.0.0:7447; by default only actors on
    this machine can join.
    """
    certs: pathlib.Path | None = None
    """Folder of the certificate authority (congrasp certs), for mutual TLS."""
    metrics_port: int = 0
    """Port of the learner's Prometheus endpoint, http://127.0.0.1:PORT/metrics; 0 switches it
    off."""
    learner: Annotated[LearnerOptions, tyro.conf.arg(name="")] = LearnerOptions()
    """Options of the learners."""

    def planned(self, config: RunConfig) -> "Plan":
        """Chooses the engine and the number of actors; on a GPU learner and actor share a process
        unless actors of other machines may connect.

        Raises:
          CongraspError: the options contradict each other or this machine, or the learner may not
            listen as requested.
        """
        if self.actors is not None and self.actors < 0:
            raise CongraspError(
                f"--actors is {self.actors}.",
                "Pass a number of actor processes, or 0 to run the actor in the learner's process.",
            )
        if self.ranks < 1:
            raise CongraspError(f"--ranks is {self.ranks}.", "It must be at least 1.")
        if not 0 <= self.metrics_port <= LAST_PORT:
            raise CongraspError(
                f"--metrics-port is {self.metrics_port}.",
                f"It must be between 0 and {LAST_PORT}.",
            )
        others_may_join = self.listen is not None or self.certs is not None
        if others_may_join:
            self._check_connections(config.name)
        gpus = self.ranks > 1 and leave_gpus_to(self.ranks)
        physics = engine_of(config.physics, gpus)
        actors = self.actors
        if actors is None and ENGINES[physics].on_device and not others_may_join:
            actors = 0
        elif actors is None:
            # Two actors on two cores would compile the same programs at the same time.
            actors = min(2, max(1, cores() // 2))
        if actors:
            check_loopback()
        return Plan(self, actors, physics, gpus)

    def _check_connections(self, run: str) -> None:
        """Raises a `CongraspError` if the learner may not listen as requested, or only some roles
        have certificates.
        """
        if self.certs is not None and (self.certs / CERTIFICATE_FILE).exists():
            raise CongraspError(
                f"{self.certs} is the certificate of a single role.",
                "Pass the folder of the certificate authority, which has those of all roles.",
            )
        credentials = urls.find_credentials(self.certs, "learner", run)
        check_exposure(self.listen or LEARNER_URL, credentials, insecure=self.learner.insecure)
        if self.listen:
            check_ports(self.listen, self.ranks * len(FLOWS))
        for role in ("actor", "observer"):
            urls.find_credentials(self.certs, role, run)
        if self.actors == 0:
            raise CongraspError(
                "With --actors 0 the learner opens no endpoint, but --listen and --certs need one.",
                "Remove --listen and --certs, or --actors.",
            )


class Plan(NamedTuple):
    """A launch on this machine."""

    launch: Launch
    actors: int
    """Actor processes of each rank; 0 runs an actor in each learner's process."""
    physics: PhysicsName
    """Engine of the actors, except `auto`."""
    gpus: bool
    """True if each of several ranks has a separate GPU, the others hidden from it."""

    @property
    def in_process(self) -> bool:
        """True if learner and actor run in this process."""
        return self.actors == 0 and self.launch.ranks == 1


@dataclasses.dataclass(frozen=True)
class LaunchRecord:
    """Content of `launch.json`: the processes of a run on this machine."""

    run: str
    """Name of the run."""
    endpoint: str
    """Endpoint at which rank 0 listens; those of the other ranks follow it."""
    actors: int
    """Actor processes of each rank; 0 runs an actor in each learner's process."""
    physics: PhysicsName
    """Engine of the actors."""
    launch: Launch
    """The options of `congrasp train`."""
    format: int = _FORMAT

    @classmethod
    def of_plan(cls, plan: Plan, run: str) -> Self:
        """Returns the record of a plan; without --listen the endpoint has free ports of the
        loopback interface.
        """
        # One more for the ports through which the ranks join
        endpoint = plan.launch.listen or local_url(plan.launch.ranks + 1)
        return cls(
            run=run,
            endpoint=endpoint,
            actors=plan.actors,
            physics=plan.physics,
            launch=plan.launch,
        )

    @property
    def coordinator(self) -> str:
        """Host and port through which the ranks join."""
        url = rank_url(reachable_url(self.endpoint), self.launch.ranks)
        return url.partition("/")[2]

    @property
    def learner_names(self) -> list[str]:
        """Names of the learner processes, by rank."""
        if self.launch.ranks == 1:
            return ["learner"]
        return [f"rank-{rank}" for rank in range(self.launch.ranks)]

    @property
    def actor_names(self) -> list[str]:
        """Names of the actor processes of all ranks, those of rank 0 first."""
        return [f"actor-{number}" for number in range(self.launch.ranks * self.actors)]

    @property
    def actor_threads(self) -> int:
        """Threads of each actor's engine."""
        return max(1, cores() // max(1, len(self.actor_names)))

    def learner_of_actor(self, name: str) -> str:
        """Returns the endpoint to which an actor connects.

        Raises:
          CongraspError: the run has no such actor.
        """
        if name not in self.actor_names:
            raise CongraspError(
                f"{LAUNCH_FILE} has no actor '{name}'.",
                f"Pass one of its names as --id: {', '.join(self.actor_names) or 'it has none'}.",
            )
        rank = self.actor_names.index(name) // self.actors
        return rank_url(reachable_url(self.endpoint), rank)


def write_launch(run_dir: pathlib.Path, record: LaunchRecord) -> pathlib.Path:
    """Writes `launch.json` into a run directory; returns its path."""
    path = run_dir / LAUNCH_FILE
    text = json.dumps(dataclasses.asdict(record), indent=2, sort_keys=True, default=str)
    write_atomically(path, text.encode())
    return path


def read_launch(path: pathlib.Path) -> LaunchRecord:
    """Reads a file of `write_launch`.

    Raises:
      CongraspError: it cannot be read, is damaged, or is of another version of congrasp.
    """
    content = read_json(path, _MAX_BYTES, _REMEDY)
    file_format = content.get("format") if isinstance(content, dict) else None
    if file_format != _FORMAT:
        raise CongraspError(
            f"{path} has format {file_format}; this version of congrasp reads {_FORMAT}.", _REMEDY
        )
    try:
        return record_of(LaunchRecord, content)
    except ValueError as error:
        raise CongraspError(f"{path} is damaged: {error}.", _REMEDY) from None
