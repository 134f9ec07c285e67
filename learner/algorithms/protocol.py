"""Interface of an algorithm to the learner: four members on which everything else depends, and its
batches.

The learner's process, its hub, checkpoints and ranks use algorithms only through `Algorithm`, and
find them by name (`learner.algorithms.ALGORITHMS`). A batch consists of rollouts concatenated along
their axis of worlds, along which ranks shard it.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from congrasp.common.config import RunConfig
from congrasp.common.errors import PhysicsError
from congrasp.common.hands import get_hand
from congrasp.common.policy import network, normalizer
from congrasp.common.policy.bundle import PolicySpec, full_layout
from congrasp.common.policy.network import Params
from congrasp.common.policy.normalizer import Statistics
from congrasp.common.task.privileged import extra
from congrasp.common.task.types import Array
from congrasp.common.wire.messages import RECORDED, TAUGHT, WORLDS, RolloutForm, Schema
from congrasp.learner.distributed.collectives import AXIS, Collectives, shard_map


class LearnedPolicy(NamedTuple):
    """Published part of a policy: the entries of a `PolicyBundle` that learning changes."""

    params: Params
    """Actor and critic (`common.policy.network`)."""
    observation: Statistics
    """Statistics of observations (D,), on the host, used for normalisation in inference."""
    value: Statistics
    """Statistics of returns (), on the host."""
    privileged: Statistics | None = None
    """Statistics of the critic's privileged inputs (P,), on the host; None without inputs or
    samples.
    """


def random_policy(seed: int, spec: PolicySpec) -> LearnedPolicy:
    """Returns networks with random weights, and empty normalisers."""
    params = network.init(seed, spec.layout, spec.action_size, spec.network, spec.privileged_size)
    return LearnedPolicy(
        params, normalizer.empty((sum(size for _, size in spec.layout),)), normalizer.empty()
    )


class TrainState(NamedTuple):
    """Complete state of training; a pytree whose first three entries are on the device."""

    params: Params
    optimizer: Any
    """Pytree of the algorithm's further state; an update may donate its arrays."""
    key: Array
    """(2,) uint32 random key."""
    observation: Statistics
    """Statistics of observations (D,), on the host."""
    value: Statistics
    """Statistics of returns (), on the host."""
    version: int
    """Number of updates so far."""
    transitions: int
    """Number of environment steps consumed so far, by all ranks."""
    privileged: Statistics | None = None
    """Statistics of the critic's privileged inputs (P,), on the host; None without inputs."""

    @classmethod
    def begin(cls, seed: int, optimizer: Any, policy: LearnedPolicy) -> "TrainState":
        """Returns the state before the first update of a policy."""
        key = jax.random.PRNGKey(seed)
        return cls(optimizer=optimizer, key=key, version=0, transitions=0, **policy._asdict())


class Algorithm(Protocol):
    """Algorithm that learns a policy from rollouts. All ranks of a run call the same methods in the
    same order.
    """

    @property
    def batch_schema(self) -> Schema:
        """Arrays of a rollout used for learning, a subset of `common.wire.messages.RECORDABLE`.

        They determine what actors send, what the hub admits, warm-up batches, and how a batch is
        sharded over ranks.
        """

    def init(self, seed: int, initial: LearnedPolicy | None = None) -> TrainState:
        """Returns the state before the first update, with the `initial` policy or random
        weights.
        """

    def update(
        self, state: TrainState, batch: Mapping[str, Array], mesh: Mesh | None = None
    ) -> tuple[TrainState, dict[str, float]]:
        """Learns from a batch; returns the next state, one version later, and the update's metrics.

        Args:
          state: the training state; the arrays of its `optimizer` must not be used again.
          batch: the arrays of `batch_schema`, with the rollouts of this process along the axis B;
            possibly `lag` (B,) int32, versions between the policy that acted and the current one, 0
            by default.
          mesh: mesh of the ranks' devices along `collectives.AXIS`. Each rank calls this with the
            same state and a batch of the same shape, and gets the same result. None for a single
            process.

        Raises:
          NonFiniteUpdate: a term is not finite; the error names the first one, and the batch is
            dropped.
        """

    def policy(self, state: TrainState) -> LearnedPolicy:
        """Returns the policy to publish; its arrays remain valid after further updates."""


class NonFiniteUpdate(PhysicsError):
    """A term of an update was not finite.

    Attributes:
      state: the training state before the update.
    """

    def __init__(self, term: str, source: str, state: TrainState):
        super().__init__(f"Diverged in the {source} of update {state.version + 1}: {term}.")
        self.state = state


def rollout_form(config: RunConfig, spec: PolicySpec, schema: Schema) -> RolloutForm:
    """Returns the form of a run's rollouts, with the arrays of `schema` for its algorithm."""
    task = config.task
    return RolloutForm(
        steps=config.rollout_steps,
        worlds=config.environments,
        observation=sum(size for _, size in spec.layout),
        action=spec.action_size,
        half=config.half_observations,
        teacher=0
        if TAUGHT.keys().isdisjoint(schema)
        else sum(size for _, size in full_layout(task)) + extra(get_hand(task.hand)),
        privileged=spec.privileged_size,
        arrays=schema,
    )


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
    specs: dict[str, PartitionSpec] = {}
    for name, spec in schema.items():
        axes = [AXIS if size == WORLDS else None for size in spec.shape or ()]
        specs[name] = PartitionSpec(*axes)
    return specs


@functools.partial(jax.jit, static_argnames="mesh")
def gathered_moments(observation: Array, *, mesh: Mesh | None) -> Statistics:
    """Moments of each rank's observations (T, B, D), stacked; `of_ranks` splits them."""

    def program(observation: Array) -> Statistics:
        return Collectives(mesh).gather(normalizer.moments(observation, event_axes=1))

    return shard_map(mesh, program, partition_specs(RECORDED)["observation"])(observation)


def of_ranks(gathered: Statistics) -> list[Statistics]:
    """Splits statistics stacked by `Collectives.gather` into those of each rank."""
    ranks: list[Statistics] = []
    for rank in range(len(gathered.count)):
        entries = [stacked[rank] for stacked in gathered]
        ranks.append(Statistics(*entries))
    return ranks
