"""Data parallelism: arrays over a mesh of the learner processes' devices, and reductions over them
inside a program.

Each process holds different worlds and a replica of everything else. A single process has no mesh
(None), and the same code then has no overhead.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from congrasp.common.task.types import Array

AXIS = "rank"
"""Axis of a mesh with one device of each learner process."""
REPLICATED = PartitionSpec()


def shard(tree: Any, mesh: Mesh | None, specs: Any = REPLICATED) -> Any:
    """Returns arrays over the whole mesh.

    Without a mesh the arrays are committed to this process's device, since uncommitted arrays would
    cause recompilation.

    Args:
      tree: this process's part of the arrays.
      mesh: mesh of all processes.
      specs: partition specs, as in `jax.shard_map`.
    """
    if mesh is None:
        return jax.device_put(tree, jax.local_devices()[0])
    devices = [
        device for device in mesh.devices.flat if device.process_index == jax.process_index()
    ]

    def place(spec: PartitionSpec, array: Array) -> Array:
        axis = spec.index(AXIS) if AXIS in spec else None
        parts = (
            [array] * len(devices)
            if axis is None or len(devices) == 1
            else jnp.split(array, len(devices), axis)
        )
        shape = tuple(
            size * (mesh.size // len(devices) if i == axis else 1)
            for i, size in enumerate(np.shape(array))
        )
        placed = [jax.device_put(part, device) for part, device in zip(parts, devices, strict=True)]
        return jax.make_array_from_single_device_arrays(shape, NamedSharding(mesh, spec), placed)

    return jax.tree.map(
        lambda spec, part: jax.tree.map(lambda x: place(spec, x), part), specs, tree
    )


def shard_map(mesh: Mesh | None, program: Callable[..., Any], in_specs: Any) -> Callable[..., Any]:
    """Returns a program, for `jax.jit`, that every process runs on its part of the arguments.

    The results are equal in all processes.
    """
    if mesh is None:
        return program
    return jax.shard_map(
        program, mesh=mesh, in_specs=in_specs, out_specs=REPLICATED, check_vma=False
    )


def unreplicate(tree: Any, mesh: Mesh | None) -> Any:
    """Returns replicated arrays on this process's first device only."""
    return tree if mesh is None else jax.tree.map(lambda x: x.addressable_data(0), tree)


class Collectives:
    """Reductions over the mesh, for code inside `shard_map`; the identity without a mesh."""

    def __init__(self, mesh: Mesh | None):
        """Creates the reductions over a mesh."""
        self._alone = mesh is None

    def mean(self, tree: Any) -> Any:
        """Mean of every leaf over the processes.

        All leaves are sent in one message, since latency dominates its cost.
        """
        if self._alone:
            return tree
        flat, unravel = ravel_pytree(tree)
        return unravel(jax.lax.pmean(flat, AXIS))

    def max(self, x: Array) -> Array:
        """Maximum of every entry."""
        return x if self._alone else jax.lax.pmax(x, AXIS)

    def variance(self, x: Array) -> Array:
        """Variance of all entries of all ranks."""
        centred = x - self.mean(jnp.mean(x))
        return self.mean(jnp.mean(centred * centred))

    def gather(self, tree: Any) -> Any:
        """Gathers every leaf along a new leading axis over the processes."""
        return jax.tree.map(lambda x: x[None] if self._alone else jax.lax.all_gather(x, AXIS), tree)

    def own_key(self, key: Array) -> Array:
        """Returns a random key that differs between processes."""
        return key if self._alone else jax.random.fold_in(key, jax.lax.axis_index(AXIS))
