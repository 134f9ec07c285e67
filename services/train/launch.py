"""The processes of a run on this machine: how many, on which engine, and who may connect to them."""

import dataclasses
import os
import pathlib
import subprocess
import sys
from typing import NamedTuple

import jax

from congrasp.actors.physics import resolve_physics
from congrasp.common.config import MetricWriter, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.runtime.parallel import cores
from congrasp.common.transport import urls
from congrasp.common.transport.ports import LEARNER_URL
from congrasp.common.transport.security import CERTIFICATE_FILE, check_exposure


@dataclasses.dataclass(frozen=True)
class Launch:
    """Options of a run's processes."""

    actors: int | None = None
    """Actor processes. By default two, or one on fewer than four cores; on a GPU none: a single actor then runs in the
    learner's process, and rollouts never leave the device."""
    ranks: int = 1
    """Learners that train together, data parallel; each has --actors actors, and a separate GPU if there are GPUs. The
    batch grows with them."""
    listen: str | None = None
    """Endpoint for actors of other machines, such as tls/0.0.0.0:7447; by default only this machine can join."""
    certs: pathlib.Path | None = None
    """The authority's folder (congrasp certs), for mutual TLS."""
    insecure: bool = False
    """Listen beyond loopback without certificates."""
    metric_writers: tuple[MetricWriter, ...] = ("tensorboard",)
    """Additional metric writers: tensorboard (files in the run's folder), wandb-offline (files there, for `wandb
    sync`), wandb (needs an account); without a name, none."""
    metrics_port: int = 0
    """Port of the learner's Prometheus endpoint, http://127.0.0.1:PORT/metrics; 0 for none."""

    def planned(self, config: RunConfig) -> "Plan":
        """Chooses engine and number of actors; on a GPU one process does everything unless others may connect.

        Raises:
          CongraspError: the options contradict each other or this machine, or the learner may not listen as requested.
        """
        if self.actors is not None and self.actors < 0:
            raise CongraspError(
                f"--actors is {self.actors}.",
                "Pass a number of actor processes, or 0 to run the actor in the learner's process.",
            )
        if self.ranks < 1:
            raise CongraspError(f"--ranks is {self.ranks}.", "Pass a number of learners from 1 on.")
        joined = self.listen is not None or self.certs is not None
        if joined:
            self._check_connections(config.name)
        gpus = self.ranks > 1 and leave_gpus_to(self.ranks)
        physics = engine_of(config.physics, gpus)
        # Two actors on two cores would compile the same programs at the same time.
        default = 0 if ENGINES[physics].on_device and not joined else min(2, max(1, cores() // 2))
        return Plan(self, default if self.actors is None else self.actors, physics, gpus)

    def _check_connections(self, run: str) -> None:
        """Raises a `CongraspError` if the learner may not listen as requested, or only some roles have certificates."""
        if self.certs is not None and (self.certs / CERTIFICATE_FILE).exists():
            raise CongraspError(
                f"{self.certs} belongs to one role.", "Pass the authority's folder, which holds those of all roles."
            )
        credentials = urls.find_credentials(self.certs, "learner", run)
        check_exposure(self.listen or LEARNER_URL, credentials, insecure=self.insecure)
        for role in ("actor", "observer"):
            urls.find_credentials(self.certs, role, run)
        if self.actors == 0:
            raise CongraspError("With --actors 0 nothing listens.", "Remove --listen and --certs, or --actors.")


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


def leave_gpus_to(ranks: int) -> bool:
    """Returns True if each rank has a GPU; this process then uses none, so that the ranks have all memory.

    Raises:
      CongraspError: there are fewer GPUs than ranks, but not none.
    """
    backend, count = accelerators()
    if backend == "cpu":
        return False
    if count < ranks:
        raise CongraspError(f"{ranks} ranks need {ranks} GPUs, but JAX finds {count}.", "Pass a smaller --ranks.")
    jax.config.update("jax_platforms", "cpu")
    return True


def accelerators() -> tuple[str, int]:
    """Returns JAX's name of this machine's hardware, and its number of devices.

    A separate process checks this, since a process that initialises a GPU holds memory of it.

    Raises:
      CongraspError: JAX does not start.
    """
    code = "import jax; print(jax.default_backend(), jax.local_device_count())"
    environment = {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    try:
        seen = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120.0
        )
        backend, count = seen.stdout.split()
    except (subprocess.TimeoutExpired, ValueError):
        raise CongraspError("JAX does not start here.", "Check 'congrasp doctor'.") from None
    return backend, int(count)


def engine_of(name: PhysicsName, gpus: bool) -> PhysicsName:
    """Resolves `auto` for the ranks, even if this process sees no GPU but they do."""
    return resolve_physics(name, "cuda" if gpus else "")
