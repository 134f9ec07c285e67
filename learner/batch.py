"""Batches: rollouts concatenated along their axis of worlds, along which ranks shard them."""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from congrasp.common.config import RunConfig
from congrasp.common.hands import get_hand
from congrasp.common.policy.bundle import PolicySpec, full_layout
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.teaching import extra
from congrasp.common.task.types import Array
from congrasp.common.wire.schema import TAUGHT, WORLDS, RolloutForm, Schema
from congrasp.learner.distributed.collectives import AXIS


def rollout_form(config: RunConfig, spec: PolicySpec, schema: Schema) -> RolloutForm:
    """Returns the form of a run's rollouts, with the arrays of `schema` for its algorithm."""
    return RolloutForm(
        steps=config.rollout_steps,
        worlds=config.environments,
        observation=sum(size for _, size in spec.layout),
        action=spec.action_size,
        half=config.half_observations,
        teacher=0 if TAUGHT.keys().isdisjoint(schema) else _teacher_inputs(config.task),
        privileged=spec.privileged_size,
        arrays=schema,
    )


def _teacher_inputs(task: TaskConfig) -> int:
    """Size of `common.task.teaching.observe_for_teacher`'s rows."""
    return sum(size for _, size in full_layout(task)) + extra(get_hand(task.hand))


def collate(rollouts: Sequence[Mapping[str, Array]], schema: Schema) -> dict[str, Array]:
    """Concatenates the schema's arrays of several rollouts of equal length, on host or device."""
    if len(rollouts) == 1:
        return {name: rollouts[0][name] for name in schema}
    joined = {}
    for name, spec in schema.items():
        parts = [rollout[name] for rollout in rollouts]
        concatenate = jnp.concatenate if isinstance(parts[0], jax.Array) else np.concatenate
        joined[name] = concatenate(parts, axis=spec.worlds_axis)
    return joined


def partition_specs(schema: Schema) -> dict[str, PartitionSpec]:
    """Partition specs of a batch on a mesh of ranks: every rank has different worlds."""
    return {
        name: PartitionSpec(*(AXIS if size == WORLDS else None for size in spec.shape or ()))
        for name, spec in schema.items()
    }
