"""Physics engines behind one interface: registers those of the project; `make_physics` builds one
by name.
"""

import concurrent.futures
import functools
import importlib.util
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from congrasp.common.errors import CongraspError, MissingPackageError
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.engines import ENGINES, Engine, PhysicsName
from congrasp.common.runtime.lazy_jax import jax
from congrasp.common.runtime.stages import stage
from congrasp.common.task.config import TaskConfig

if TYPE_CHECKING:
    from congrasp.actors.physics.engine import Physics

_NVIDIA = ("gpu", "cuda")


def _make_warp(
    hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], threads: int
) -> "Physics":
    """Builds MuJoCo Warp, which ignores `threads`."""
    from congrasp.actors.physics.warp import WarpPhysics

    return WarpPhysics(hand, task, objects)


def _prepare_warp(hand: Hand, task: TaskConfig) -> None:
    """Begins to build Warp's kernels."""
    with stage("import of Warp"):
        from congrasp.actors.physics.warp import begin_kernels

    begin_kernels(hand, task)


def _make_jax(
    hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], threads: int
) -> "Physics":
    """Builds MJX-JAX, which ignores `threads`."""
    from congrasp.actors.physics.mjx import MjxPhysics

    return MjxPhysics(hand, task, objects)


def _make_native(*arguments: Any) -> "Physics":
    """Builds MuJoCo C on threads."""
    from congrasp.actors.physics.native import NativePhysics

    return NativePhysics(*arguments)


def _make_physx(
    hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], threads: int
) -> "Physics":
    """Builds PhysX in as many processes as there may be threads."""
    from congrasp.actors.physics.physx.batch import PhysxPhysics
    from congrasp.actors.physics.physx.processes import PhysxProcesses

    if threads <= 1:
        return PhysxPhysics(hand, task, objects)
    return PhysxProcesses(hand, task, objects, threads)


def _missing_physx(backend: str) -> CongraspError | None:
    """Error if the package is missing."""
    if importlib.util.find_spec("sapien") is None:
        return MissingPackageError("The 'physx' engine", "sapien")
    return None


def _missing_warp(backend: str) -> CongraspError | None:
    """Error if the NVIDIA GPU or the package is missing."""
    if backend not in _NVIDIA:
        return CongraspError(
            "The 'warp' engine needs an NVIDIA GPU, but JAX finds none.",
            "Install the 'cuda' extra and check 'congrasp doctor', or pass --physics native.",
        )
    if importlib.util.find_spec("warp") is None:
        return CongraspError(
            "The 'warp' engine is not installed.", "Run: pip install 'congrasp[cuda]'."
        )
    return None


ENGINES["warp"] = Engine(
    _make_warp,
    4096,
    lambda backend: backend in _NVIDIA,
    _missing_warp,
    _prepare_warp,
    on_device=True,
    title="MJX-Warp",
)
ENGINES["jax"] = Engine(
    _make_jax, 256, lambda backend: backend not in ("cpu", *_NVIDIA), title="MJX-JAX"
)
ENGINES["native"] = Engine(
    _make_native, 64, lambda backend: backend == "cpu", title="MuJoCo C (CPU)"
)
ENGINES["physx"] = Engine(_make_physx, 64, missing=_missing_physx, title="PhysX 5 (CPU)")


def resolve_physics(name: PhysicsName, backend: str = "") -> PhysicsName:
    """Returns the engine of a name; `auto` is `warp` on an NVIDIA GPU, `native` on a CPU and `jax`
    elsewhere.

    Args:
      name: `auto` or a key of `ENGINES`.
      backend: JAX's name of the hardware; that of this process by default.

    Raises:
      CongraspError: there is no such engine, or this machine does not meet its requirements.
    """
    backend = backend or jax.default_backend()
    if name == "auto":
        name = next(key for key, engine in ENGINES.items() if engine.automatic(backend))
    if name not in ENGINES:
        raise CongraspError(
            f"There is no physics engine '{name}'.",
            f"Choose from: {', '.join(('auto', *ENGINES))}.",
        )
    if missing := ENGINES[name].missing(backend):
        raise missing
    return name


@functools.cache
def prepare_physics(name: PhysicsName, hand: Hand, task: TaskConfig) -> None:
    """Begins, once in a process, what an engine can build in the background before it has objects.

    `make_physics` then raises the errors of this.

    Raises:
      CongraspError: see `resolve_physics`.
    """
    if prepare := ENGINES[resolve_physics(name)].prepare:
        concurrent.futures.ThreadPoolExecutor(1, "prepare").submit(prepare, hand, task)


def make_physics(
    name: PhysicsName, hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], *, threads: int
) -> "Physics":
    """Builds an engine with a pool of objects; `threads` applies to those that step on the CPU.

    Raises:
      CongraspError: see `resolve_physics`.
    """
    physics: Physics = ENGINES[resolve_physics(name)].make(hand, task, objects, threads)
    return physics
