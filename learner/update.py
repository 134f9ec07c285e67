"""One update of policy, critic and normalisers from a batch of rollouts.

The batch keeps its world axis: arrays are (T, N, ...) with the worlds of all rollouts side by side, on whatever device
they were made. Everything between the batch and the new weights is one compiled program; hyperparameters are traced, so
that other settings need no other compilation. The optimiser's moments are donated to it, the weights are not: the
bundle that was published with them may still be in use in this process. The host keeps the running statistics
(`common.policy.normalizer`) and the counters, and sees scalars alone.

Several processes, each with a batch of its own, make one update together over a mesh of their devices: gradients,
advantages' statistics and metrics are averaged inside the program, once in each minibatch, and moments are gathered in
rank order, so that all of them come to the same weights and statistics, bit for bit.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, PartitionSpec

from common.config import NetworkConfig, PPOConfig
from common.errors import CongraspError, PhysicsError
from common.policy import network, normalizer
from common.policy.network import Layout, Params
from common.policy.normalizer import Affine, Statistics
from common.task.types import Array
from learner import gae, losses
from learner.across import AXIS, REPLICATED, Across, local, over, spread

FIELDS = ("observation", "last_observation", "action", "log_probability", "reward", "terminal")
"""Arrays of a batch: (T, N, D), (N, D), (T, N, A), (T, N), (T, N) and (T, N)."""
_WORLDS = {name: PartitionSpec(AXIS) if name == "last_observation" else PartitionSpec(None, AXIS) for name in FIELDS}
_CHECKED_INPUTS = FIELDS[:-1]
_CHECKED = (
    *_CHECKED_INPUTS,
    "value",
    "policy loss",
    "value loss",
    "KL divergence",
    "actor gradient",
    "critic gradient",
)
_FINE = -1  # no term was non-finite; otherwise an index into _CHECKED
_RATE_FACTOR = 1.5
_ADAM = optax.scale_by_adam(eps=1e-5)


class TrainState(NamedTuple):
    """Everything that training needs to go on; a pytree whose first four entries live on the device."""

    params: Params
    optimizer: optax.OptState
    learning_rate: Array
    key: Array
    """(2,) uint32 random key."""
    observation: Statistics
    """Of observations (D,), on the host."""
    value: Statistics
    """Of lambda-returns (), on the host."""
    version: int
    """Updates so far."""
    transitions: int
    """Environment steps consumed so far."""


_ON_DEVICE = 4  # entries of a TrainState


class NonFiniteUpdate(PhysicsError):
    """A term of the update was not finite.

    Attributes:
      state: the training state before the first minibatch that failed.
    """

    def __init__(self, term: str, state: TrainState):
        source = "in the rollouts" if term in _CHECKED_INPUTS else "in the optimisation"
        super().__init__(f"Not finite {source} of update {state.version + 1}: {term}.")
        self.state = state


def init_state(seed: int, layout: Layout, action_size: int, sizes: NetworkConfig, ppo: PPOConfig) -> TrainState:
    """The state before the first update."""
    params = network.init(seed, layout, action_size, sizes)
    size = sum(width for _, width in layout)
    return TrainState(
        params,
        _ADAM.init(params),
        jnp.float32(ppo.learning_rate),
        jax.random.PRNGKey(seed),
        normalizer.empty((size,)),
        normalizer.empty(),
        version=0,
        transitions=0,
    )


def collate(rollouts: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """The worlds of several rollouts of equal length side by side, where the rollouts are: host or device."""
    if len(rollouts) == 1:
        return {name: rollouts[0][name] for name in FIELDS}
    joined = {}
    for name in FIELDS:
        parts = [rollout[name] for rollout in rollouts]
        concatenate = jnp.concatenate if isinstance(parts[0], jax.Array) else np.concatenate
        joined[name] = concatenate(parts, axis=0 if name == "last_observation" else 1)
    return joined


def update(
    state: TrainState, batch: Mapping[str, Array], layout: Layout, ppo: PPOConfig, mesh: Mesh | None = None
) -> tuple[TrainState, dict[str, float]]:
    """Runs PPO on a batch and returns the next state with the update's metrics.

    The given state must not be used again: its optimiser's arrays are consumed.
    The normalisers are frozen during the update and take the batch in afterwards; only the first batch is also what the
    first update normalises by. The critic's output layer is adapted to the moved value statistics so that its
    estimates do not change with them (van Hasselt et al. 2016, arXiv 1602.07714).

    Args:
      state: the training state.
      batch: arrays `FIELDS`; others are ignored. Rewards are not scaled yet.
      layout: of the observation.
      ppo: hyperparameters.
      mesh: of the ranks' devices along `AXIS`, each of which calls this with the same state and a batch of the same
        shape; None if this process is alone.

    Raises:
      NonFiniteUpdate: naming the first term that was not finite.
      CongraspError: if there are more minibatches than transitions.
    """
    arrays = {name: batch[name] for name in FIELDS}
    if arrays["reward"].size < ppo.minibatches:
        raise CongraspError(
            f"A batch of {arrays['reward'].size} transitions does not make {ppo.minibatches} minibatches.",
            "Use fewer minibatches, more environments or longer rollouts.",
        )
    first = state[:_ON_DEVICE]
    if mesh is not None:
        arrays, first = spread(arrays, mesh, _WORLDS), spread(first, mesh)
    seen = _observed(arrays["observation"], mesh=mesh)
    frozen = state.observation if state.observation.count else normalizer.merge(*_ranks(local(seen, mesh)))
    learnt, returns, failure, scalars = _optimise(
        *first,
        arrays,
        normalizer.observation_affine(frozen, layout),
        normalizer.value_affine(state.value),
        {name: value for name, value in dataclasses.asdict(ppo).items() if isinstance(value, float | tuple | bool)},
        layout=layout,
        epochs=ppo.epochs,
        minibatches=ppo.minibatches,
        mesh=mesh,
    )
    learnt, seen, returns, failure, scalars = local((learnt, seen, returns, failure, scalars), mesh)
    seen, returns, failure, scalars = jax.device_get((seen, returns, failure, scalars))
    state = TrainState(*learnt, *state[_ON_DEVICE:])
    if failure != _FINE:
        raise NonFiniteUpdate(_CHECKED[failure], state)
    value = normalizer.merge(state.value, *_ranks(returns))
    state = state._replace(
        params=_preserve_values(state.params, normalizer.value_affine(state.value), normalizer.value_affine(value)),
        observation=normalizer.merge(state.observation, *_ranks(seen)),
        value=value,
        version=state.version + 1,
        transitions=state.transitions + arrays["reward"].size,
    )
    return state, {name: float(scalar) for name, scalar in scalars.items()}


def _ranks(gathered: Statistics) -> list[Statistics]:
    """The statistics of each rank from those that `Across.gather` stacked."""
    return [Statistics(*(entry[i] for entry in gathered)) for i in range(len(gathered.count))]


@functools.partial(jax.jit, static_argnames="mesh")
def _observed(observation: Array, *, mesh: Mesh | None) -> Statistics:
    """Moments of each rank's observations, stacked."""

    def program(observation: Array) -> Statistics:
        return Across(mesh).gather(normalizer.moments(observation, event_axes=1))

    return over(mesh, program, _WORLDS["observation"])(observation)


@functools.partial(jax.jit, static_argnames=("layout", "epochs", "minibatches", "mesh"), donate_argnames="optimizer")
def _optimise(
    params: Params,
    optimizer: optax.OptState,
    learning_rate: Array,
    key: Array,
    batch: dict[str, Array],
    normalization: Affine,
    returns_normalization: Affine,
    hyper: dict[str, Array],
    *,
    layout: Layout,
    epochs: int,
    minibatches: int,
    mesh: Mesh | None,
) -> tuple[tuple[Params, optax.OptState, Array, Array], Statistics, Array, dict[str, Array]]:
    """Epochs over the batch; returns the state's first entries, moments of the returns, the failed term and metrics."""
    program = functools.partial(_program, across=Across(mesh), layout=layout, epochs=epochs, minibatches=minibatches)
    specs = (*[REPLICATED] * _ON_DEVICE, _WORLDS, *[REPLICATED] * 3)
    given = params, optimizer, learning_rate, key, batch, normalization, returns_normalization, hyper
    return over(mesh, program, specs)(*given)


def _program(
    params: Params,
    optimizer: optax.OptState,
    learning_rate: Array,
    key: Array,
    batch: dict[str, Array],
    normalization: Affine,
    returns_normalization: Affine,
    hyper: dict[str, Array],
    *,
    across: Across,
    layout: Layout,
    epochs: int,
    minibatches: int,
) -> tuple[tuple[Params, optax.OptState, Array, Array], Statistics, Array, dict[str, Array]]:
    """What `_optimise` compiles, for one rank."""
    log_std = params["actor"]["log_std"]
    observation = normalizer.apply(normalization, batch["observation"])
    exact, _ = network.policy(params, layout, observation)
    log_exact = network.log_probability(exact, log_std, batch["action"])
    weight = losses.importance_weight(log_exact, batch["log_probability"], hyper["importance_max"])
    mean, _ = network.policy(params, layout, observation, exact=False)

    def values(normalised: Array) -> Array:
        return network.value(params, layout, normalised) / returns_normalization.scale + returns_normalization.shift

    value = values(observation)
    last_value = values(normalizer.apply(normalization, batch["last_observation"]))
    reward = batch["reward"] * hyper["reward_scale"]
    advantage, returns = gae.advantages(
        reward, value, last_value, batch["terminal"], hyper["gamma"], hyper["gae_lambda"]
    )
    advantage_std = jnp.sqrt(across.variance(advantage))
    samples = losses.Sample(
        # Normalised in each minibatch: gathering its rows in half precision is cheaper.
        batch["observation"],
        batch["action"],
        jnp.where(
            hyper["decoupled"], network.log_probability(mean, log_std, batch["action"]), batch["log_probability"]
        ),
        mean,
        jnp.where(hyper["decoupled"], weight, 1.0),
        (advantage - across.mean(jnp.mean(advantage))) / (advantage_std + 1e-8),
        (returns - returns_normalization.shift) * returns_normalization.scale,
    )
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)
    inputs = [batch[name] for name in _CHECKED_INPUTS]
    failure = across.max(_first_failure(jnp.int32(_FINE), 0, *inputs, value))
    key, epochs_key = jax.random.split(key)
    params, optimizer, failure, (terms, norms) = _epochs(
        params,
        optimizer,
        learning_rate,
        jax.random.split(across.own_key(epochs_key), epochs),
        failure,
        flat,
        normalization,
        log_std,
        hyper,
        across,
        layout,
        minibatches,
    )

    kl = jnp.mean(terms.kl[-1])
    metrics = {name: jnp.mean(term) for name, term in terms._asdict().items()}
    metrics |= {f"{name}_grad_norm": jnp.mean(norm) for name, norm in norms.items()}
    log_weight = log_exact - batch["log_probability"]
    metrics |= {
        "kl": kl,
        "learning_rate": learning_rate,
        "action_std": jnp.mean(jnp.exp(params["actor"]["log_std"])),
        "importance_max": across.max(jnp.max(weight)),
        "explained_variance": 1.0 - across.variance(returns - value) / (across.variance(returns) + 1e-8),
        "advantage_std": advantage_std,
    }
    metrics |= across.mean(
        {
            "importance_mean": jnp.mean(weight),
            "importance_truncated": jnp.mean((log_weight > jnp.log(hyper["importance_max"])).astype(jnp.float32)),
            "behaviour_kl": -jnp.mean(log_weight),
            "reward_mean": jnp.mean(batch["reward"]),
            "return_mean": jnp.mean(returns),
            "value_mean": jnp.mean(value),
        }
    )
    learnt = params, optimizer, _adapt_rate(learning_rate, kl, hyper), key
    return learnt, across.gather(normalizer.moments(returns)), failure, metrics


def _epochs(
    params: Params,
    optimizer: optax.OptState,
    learning_rate: Array,
    keys: Array,
    failure: Array,
    samples: losses.Sample,
    normalization: Affine,
    log_std_proximal: Array,
    hyper: dict[str, Array],
    across: Across,
    layout: Layout,
    minibatches: int,
) -> tuple[Params, optax.OptState, Array, tuple[losses.Terms, dict[str, Array]]]:
    """Shuffled minibatches, each sample at most once an epoch; the remainder of the division sits an epoch out.

    The observations of `samples` are not normalised yet.
    """
    count = samples.advantage.shape[0]
    size = count // minibatches
    coefficients = losses.Coefficients(hyper["clip"], hyper["entropy"], hyper["value_coefficient"])
    gradient = jax.value_and_grad(losses.objective, has_aux=True)

    def step(carry: tuple[Params, optax.OptState, Array], rows: Array):
        params, optimizer, failure = carry
        minibatch = jax.tree.map(lambda x: x[rows], samples)
        minibatch = minibatch._replace(observation=normalizer.apply(normalization, minibatch.observation))
        (_, terms), gradients = gradient(params, layout, log_std_proximal, minibatch, coefficients)
        terms, gradients = across.mean((terms, gradients))
        # The networks share no weight, so one's large gradient must not shrink the other's.
        norms = {name: optax.tree.norm(tree) for name, tree in gradients.items()}
        shrink = {
            name: hyper["max_grad_norm"] / jnp.maximum(norm, hyper["max_grad_norm"]) for name, norm in norms.items()
        }
        gradients = {name: jax.tree.map(lambda g, s=shrink[name]: g * s, tree) for name, tree in gradients.items()}
        failure = _first_failure(
            failure,
            len(_CHECKED_INPUTS) + 1,
            terms.policy_loss,
            terms.value_loss,
            terms.kl,
            norms["actor"],
            norms["critic"],
        )
        direction, moved_optimizer = _ADAM.update(gradients, optimizer)
        moved = jax.tree.map(lambda p, d: p - learning_rate * d, params, direction)
        params, optimizer = jax.tree.map(
            lambda new, old: jnp.where(failure == _FINE, new, old), (moved, moved_optimizer), (params, optimizer)
        )
        return (params, optimizer, failure), (terms, norms)

    def epoch(carry: tuple[Params, optax.OptState, Array], key: Array):
        order = jax.random.permutation(key, count)[: size * minibatches]
        return jax.lax.scan(step, carry, order.reshape(minibatches, size))

    (params, optimizer, failure), metrics = jax.lax.scan(epoch, (params, optimizer, failure), keys)
    return params, optimizer, failure, metrics


def _first_failure(failure: Array, offset: int, *terms: Array) -> Array:
    """`failure` if it names a term already, else `offset` plus the index of the first term that is not finite."""
    bad = jnp.stack([~jnp.all(jnp.isfinite(term)) for term in terms])
    found = jnp.where(jnp.any(bad), offset + jnp.argmax(bad).astype(jnp.int32), _FINE)
    return jnp.where(failure == _FINE, found, failure)


def _adapt_rate(rate: Array, kl: Array, hyper: dict[str, Array]) -> Array:
    """The next update's learning rate from the mean KL to the proximal policy over the last epoch."""
    target = hyper["kl_target"]
    factor = jnp.where(kl > 2.0 * target, 1.0 / _RATE_FACTOR, jnp.where(kl < target / 2.0, _RATE_FACTOR, 1.0))
    return jnp.clip(rate * factor, *hyper["learning_rate_range"])


@jax.jit
def _preserve_values(params: Params, before: Affine, after: Affine) -> Params:
    """The critic with its output layer changed such that its estimates stay the same under another normalisation."""
    output = params["critic"]["output"]
    ratio = after.scale / before.scale
    moved = {
        "kernel": output["kernel"] * ratio,
        "bias": output["bias"] * ratio + (before.shift - after.shift) * after.scale,
    }
    return {**params, "critic": {**params["critic"], "output": moved}}
