"""Interface of an algorithm to the learner: four members on which everything else depends.

The learner's process, its hub, checkpoints and ranks use algorithms only through `Algorithm`, and find them by name
(`learner.algorithms.ALGORITHMS`).
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

from jax.sharding import Mesh

from congrasp.common.errors import PhysicsError
from congrasp.common.policy import network, normalizer
from congrasp.common.policy.bundle import PolicySpec
from congrasp.common.policy.network import Params
from congrasp.common.policy.normalizer import Statistics
from congrasp.common.task.types import Array
from congrasp.common.wire.schema import Schema


class LearnedPolicy(NamedTuple):
    """Published part of a policy: the entries of a `PolicyBundle` that learning changes."""

    params: Params
    """Actor and critic (`common.policy.network`)."""
    observation: Statistics
    """Statistics of observations (D,), on the host, used for normalisation in inference."""
    value: Statistics
    """Statistics of returns (), on the host."""
    privileged: Statistics | None = None
    """Statistics of the critic's privileged inputs (P,), on the host; None without inputs or samples."""


def random_policy(seed: int, spec: PolicySpec) -> LearnedPolicy:
    """Returns networks with random weights, and empty normalisers."""
    params = network.init(seed, spec.layout, spec.action_size, spec.network, spec.privileged_size)
    return LearnedPolicy(params, normalizer.empty((sum(size for _, size in spec.layout),)), normalizer.empty())


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


class Algorithm(Protocol):
    """Algorithm that learns a policy from rollouts. All ranks of a run call the same methods in the same order."""

    @property
    def batch_schema(self) -> Schema:
        """Arrays of a rollout used for learning, a subset of `common.wire.schema.RECORDABLE`.

        They determine what actors send, what the hub admits, warm-up batches, and how a batch is sharded over ranks.
        """

    def init(self, seed: int, initial: LearnedPolicy | None = None) -> TrainState:
        """Returns the state before the first update, with the `initial` policy or random weights."""

    def update(
        self, state: TrainState, batch: Mapping[str, Array], mesh: Mesh | None = None
    ) -> tuple[TrainState, dict[str, float]]:
        """Learns from a batch; returns the next state, one version later, and the update's metrics.

        Args:
          state: the training state; the arrays of its `optimizer` must not be used again.
          batch: the arrays of `batch_schema`, with the rollouts of this process along the axis B; possibly `lag` (B,)
            int32, versions between the policy that acted and the current one, 0 by default.
          mesh: mesh of the ranks' devices along `collectives.AXIS`. Each rank calls this with the same state and a
            batch of the same shape, and gets the same result. None for a single process.

        Raises:
          NonFiniteUpdate: a term is not finite; the error names the first one, and the batch is dropped.
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
