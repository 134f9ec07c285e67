"""What an algorithm is to the learner: four members, from which everything around it follows.

The learner's process, its hub, checkpoints and ranks know algorithms by `Algorithm` alone, and find them by name
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


class Policy(NamedTuple):
    """What is published: the entries of a `PolicyBundle` that learning changes."""

    params: Params
    """Actor and critic (`common.policy.network`)."""
    observation: Statistics
    """Of observations (D,), on the host; inference normalises by them."""
    value: Statistics
    """Of returns (), on the host."""
    privileged: Statistics | None = None
    """Of the critic's privileged inputs (P,), on the host; None: it has none, or there are no samples."""


def random_policy(seed: int, spec: PolicySpec) -> Policy:
    """Networks with random weights, and normalisers that have seen nothing."""
    params = network.init(seed, spec.layout, spec.action_size, spec.network, spec.privileged_size)
    return Policy(params, normalizer.empty((sum(size for _, size in spec.layout),)), normalizer.empty())


class TrainState(NamedTuple):
    """Everything that training needs to go on; a pytree whose first three entries live on the device."""

    params: Params
    optimizer: Any
    """Pytree of what the algorithm keeps beside the parameters; an update may consume its arrays."""
    key: Array
    """(2,) uint32 random key."""
    observation: Statistics
    """Of observations (D,), on the host."""
    value: Statistics
    """Of returns (), on the host."""
    version: int
    """Updates so far."""
    transitions: int
    """Environment steps consumed so far, by all ranks."""
    privileged: Statistics | None = None
    """Of the critic's privileged inputs (P,), on the host; None if it has none."""


class Algorithm(Protocol):
    """How a policy is learnt from rollouts. All ranks of a run call the same methods in the same order."""

    @property
    def batch_schema(self) -> Schema:
        """The arrays of a rollout that it learns from, some of `common.wire.schema.RECORDABLE`.

        From them follow what actors send, what the hub admits, warm-up batches, and how a batch is divided among ranks.
        """

    def init(self, seed: int, initial: Policy | None = None) -> TrainState:
        """The state before the first update, which begins with the `initial` policy or with random weights."""

    def update(
        self, state: TrainState, batch: Mapping[str, Array], mesh: Mesh | None = None
    ) -> tuple[TrainState, dict[str, float]]:
        """Learns from a batch; returns the next state, one version on, and the update's metrics.

        Args:
          state: the training state; the arrays of its `optimizer` must not be used again.
          batch: the arrays of `batch_schema`, with all the rollouts of this process along the axis B.
          mesh: of the ranks' devices along `collectives.AXIS`, each of which calls this with the same state and a batch
            of the same shape, and comes to the same state; None if this process is alone.

        Raises:
          NonFiniteUpdate: naming the first term that was not finite; the batch is dropped.
        """

    def policy(self, state: TrainState) -> Policy:
        """What to publish; its arrays outlive further updates."""


class NonFiniteUpdate(PhysicsError):
    """A term of an update was not finite.

    Attributes:
      state: the training state before the update.
    """

    def __init__(self, term: str, source: str, state: TrainState):
        super().__init__(f"Not finite in the {source} of update {state.version + 1}: {term}.")
        self.state = state
