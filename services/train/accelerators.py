"""Accelerators of this machine, found without holding their memory in this process."""

import os
import pathlib
import subprocess
import sys
from typing import NamedTuple

from congrasp.actors.physics import resolve_physics
from congrasp.common.errors import CongraspError
from congrasp.common.runtime.engines import ENGINES, PhysicsName
from congrasp.common.runtime.lazy_jax import jax
from congrasp.common.runtime.process_variables import child_environment
from congrasp.common.runtime.stages import stage

_START_TIMEOUT_S = 120.0
DEVICES = pathlib.Path("/dev")
"""Folder of Linux with a file for each GPU, `nvidia0` and so on."""
_GPUS = ("gpu", "cuda")
"""JAX's names of NVIDIA GPUs."""


class Hardware(NamedTuple):
    """JAX's hardware on this machine."""

    backend: str
    """JAX's name, such as `cpu` or `gpu`."""
    devices: int
    """Number of devices."""
    kind: str
    """Name of a device, such as `NVIDIA H200`."""


class Gpus(NamedTuple):
    """Several GPUs of this machine."""

    names: tuple[str, ...]
    """Their identifiers for CUDA."""
    kind: str
    """Name of one, such as `NVIDIA H200`."""


def leave_gpus_to(ranks: int) -> bool:
    """Returns True if each rank has a GPU; this process then uses none, so that the ranks have all
    memory.

    Raises:
      CongraspError: there are fewer GPUs than ranks, but not none.
    """
    with stage("search for accelerators"):
        hardware = detect()
    if hardware.backend == "cpu":
        return False
    if hardware.devices < ranks:
        raise CongraspError(
            f"{ranks} ranks need {ranks} GPUs, but JAX finds {hardware.devices}.",
            "Pass a smaller --ranks.",
        )
    jax.config.update("jax_platforms", "cpu")
    return True


def several_gpus(physics: PhysicsName) -> Gpus | None:
    """Returns the GPUs of this machine if there are several and the engine steps on one; this
    process then uses none, so that others have all memory. Takes no time without GPUs.

    Raises:
      CongraspError: JAX does not start.
    """
    engines_on_gpus = [name for name, engine in ENGINES.items() if engine.on_device]
    if physics not in ("auto", *engines_on_gpus):
        return None
    if len(list(DEVICES.glob("nvidia[0-9]*"))) < 2:
        return None
    hardware = detect()
    if hardware.backend not in _GPUS or hardware.devices < 2:
        return None
    jax.config.update("jax_platforms", "cpu")
    names = [gpu_of_rank(rank) for rank in range(hardware.devices)]
    return Gpus(tuple(names), hardware.kind)


def gpu_of_rank(rank: int) -> str:
    """Returns the identifier of a rank's GPU for CUDA, among those available to this process."""
    names = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
    visible = [name for name in names if name]
    if not visible:
        return str(rank)
    return visible[rank]


def detect() -> Hardware:
    """Returns the hardware that JAX finds on this machine.

    A separate process checks this, since a process that initialises a GPU holds memory of it.

    Raises:
      CongraspError: JAX does not start.
    """
    code = (
        "import jax; devices = jax.local_devices(); "
        "print(jax.default_backend(), len(devices), devices[0].device_kind)"
    )
    environment = child_environment(XLA_PYTHON_CLIENT_PREALLOCATE="false")
    try:
        result = subprocess.run(
            [sys.executable, "-P", "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            timeout=_START_TIMEOUT_S,
        )
        backend, count, kind = result.stdout.strip().split(maxsplit=2)
    except (subprocess.TimeoutExpired, ValueError):
        raise CongraspError(
            "JAX does not start on this machine.", "Run 'congrasp doctor' for the cause."
        ) from None
    return Hardware(backend, int(count), kind)


def engine_of(name: PhysicsName, gpus: bool) -> PhysicsName:
    """Resolves `auto` for the ranks, which may see GPUs even if this process does not."""
    return resolve_physics(name, "cuda" if gpus else "")
