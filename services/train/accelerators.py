"""Accelerators of this machine, found without holding their memory in this process."""

import subprocess
import sys

from congrasp.actors.physics import resolve_physics
from congrasp.common.errors import CongraspError
from congrasp.common.runtime.engines import PhysicsName
from congrasp.common.runtime.environment import child_environment
from congrasp.common.runtime.lazy_jax import jax
from congrasp.common.runtime.stages import stage

_START_TIMEOUT_S = 120.0


def leave_gpus_to(ranks: int) -> bool:
    """Returns True if each rank has a GPU; this process then uses none, so that the ranks have all
    memory.

    Raises:
      CongraspError: there are fewer GPUs than ranks, but not none.
    """
    with stage("search for accelerators"):
        backend, count = detect()
    if backend == "cpu":
        return False
    if count < ranks:
        raise CongraspError(
            f"{ranks} ranks need {ranks} GPUs, but JAX finds {count}.", "Pass a smaller --ranks."
        )
    jax.config.update("jax_platforms", "cpu")
    return True


def detect() -> tuple[str, int]:
    """Returns JAX's name of this machine's hardware, and its number of devices.

    A separate process checks this, since a process that initialises a GPU holds memory of it.

    Raises:
      CongraspError: JAX does not start.
    """
    code = "import jax; print(jax.default_backend(), jax.local_device_count())"
    environment = child_environment(XLA_PYTHON_CLIENT_PREALLOCATE="false")
    try:
        result = subprocess.run(
            [sys.executable, "-P", "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            timeout=_START_TIMEOUT_S,
        )
        backend, count = result.stdout.split()
    except (subprocess.TimeoutExpired, ValueError):
        raise CongraspError(
            "JAX does not start on this machine.", "Run 'congrasp doctor' for the cause."
        ) from None
    return backend, int(count)


def engine_of(name: PhysicsName, gpus: bool) -> PhysicsName:
    """Resolves `auto` for the ranks, which may see GPUs even if this process does not."""
    return resolve_physics(name, "cuda" if gpus else "")
