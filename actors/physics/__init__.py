"""Physics engines behind one interface; `make_physics` chooses."""

import importlib.util
from collections.abc import Sequence

import jax

from actors.physics.engine import Physics
from common.config import PhysicsName, TaskConfig
from common.errors import CongraspError
from common.hands.spec import Hand
from common.objects.spec import GraspObject


def resolve_physics(name: PhysicsName) -> PhysicsName:
    """`auto` becomes `warp` on an NVIDIA GPU, `native` on a CPU and `jax` elsewhere.

    Raises:
      CongraspError: `warp` is demanded where there is no NVIDIA GPU, or is not installed.
    """
    backend = jax.default_backend()
    if name == "auto":
        if backend == "cpu":
            return "native"
        return "warp" if backend in ("gpu", "cuda") else "jax"
    if name == "warp" and backend not in ("gpu", "cuda"):
        raise CongraspError(
            "The 'warp' engine needs an NVIDIA GPU, and JAX sees none.",
            "Install the 'cuda' extra and look at 'congrasp doctor', or choose --physics native.",
        )
    if name == "warp" and importlib.util.find_spec("warp") is None:
        raise CongraspError("The 'warp' engine is not installed.", "Run: pip install 'congrasp[cuda]'.")
    return name


def make_physics(
    name: PhysicsName, hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], *, threads: int
) -> Physics:
    """An engine with a pool of objects; `threads` counts for `native` only."""
    chosen = resolve_physics(name)
    if chosen == "native":
        from actors.physics.native import NativePhysics

        return NativePhysics(hand, task, objects, threads)
    if chosen == "warp":
        from actors.physics.warp import WarpPhysics

        return WarpPhysics(hand, task, objects)
    from actors.physics.mjx import MjxPhysics

    return MjxPhysics(hand, task, objects)
