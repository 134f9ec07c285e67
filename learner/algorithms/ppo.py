"""Decoupled PPO (`learner.algorithms.losses`) with generalised advantages and a KL-adaptive
learning rate.

The batch keeps its axis of worlds: arrays are (T, B, ...) with the worlds of all rollouts
concatenated, on the device where they were created. Everything between the batch and the new
weights is one compiled program; hyperparameters are traced, so that changing them needs no
recompilation. The optimiser's moments are donated to it. The weights are not, since the bundle
published with them may still be in use in this process. The host keeps the running statistics
(`common.policy.normalizer`) and the counters, and receives only scalars.

Several processes, each with its batch, compute one update over a mesh of their devices. Gradients,
statistics of advantages and metrics are averaged inside the program, once in each minibatch, and
moments are gathered in rank order, so that weights and statistics are bitwise identical on all
ranks.
"""

import functools
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, PartitionSpec

from congrasp.common.config import PPOConfig
from congrasp.common.errors import CongraspError
from congrasp.common.policy import normalizer
from congrasp.common.policy.bundle import PolicySpec
from congrasp.common.policy.network import Layout, Params
from congrasp.common.policy.normalizer import Affine, Statistics
from congrasp.common.task.types import Array
from congrasp.common.wire.messages import PRIVILEGED, RECORDABLE, RECORDED, Schema
from congrasp.learner.algorithms import losses
from congrasp.learner.algorithms.protocol import (
    LearnedPolicy,
    NonFiniteUpdate,
    TrainState,
    gathered_moments,
    of_ranks,
    partition_specs,
    random_policy,
)
from congrasp.learner.distributed.collectives import (
    AXIS,
    REPLICATED,
    Collectives,
    shard,
    shard_map,
    unreplicate,
)

_SPECS = {**partition_specs(RECORDABLE), "lag": PartitionSpec(AXIS)}
_CHECKED_INPUTS = tuple(
    name for name, spec in {**RECORDED, **PRIVILEGED}.items() if spec.dtypes != ("bool",)
)
_CHECKED = (
    *_CHECKED_INPUTS,
    "value",
    "policy loss",
    "value loss",
    "KL divergence",
    "actor gradient",
    "critic gradient",
    "policy (the KL divergence is too large)",
)
_NORMALISED = ("observation", "privileged")
"""Arrays of a batch with running statistics, which have the same names in a `TrainState`."""
_FINE = -1
"""Value of a failure if every term was finite; otherwise it is an index into _CHECKED."""
_MAX_KL = 10.0
"""Largest divergence of the policies before and after an update, nats; the target is about a
hundredth of one.
"""
_RATE_FACTOR = 1.5
_TRAINED_RATE = 0.1
"""Share of the learning rate with which an initial policy begins: at the whole rate, a trained
policy moved by 120 KL targets in its first update.
"""
_TRUSTED_KL = 4.0
"""KL targets; a minibatch with a larger divergence does not update the policy."""

Learnt = tuple[Params, Any, Array]
"""Parameters, the optimiser's state and the random key: the device entries of a `TrainState`."""
_ON_DEVICE = 3
"""Number of the entries of a `TrainState` on the device, which are its first ones."""


class Passes(NamedTuple):
    """Sizes and networks of an update, which are static in its compiled program."""

    layout: Layout
    epochs: int
    minibatches: int


class Proximal(NamedTuple):
    """Parameters, samples and generators with which the epochs of an update begin."""

    params: Params
    optimizer: Any
    failure: Array
    keys: Array
    """Generator of each epoch."""
    samples: losses.Sample
    """Samples (T, ...), whose observations are not normalised yet."""


class PPO:
    """Decoupled PPO, an `Algorithm`."""

    def __init__(self, spec: PolicySpec, config: PPOConfig, updates: int = 0):
        """Creates the algorithm for a policy's networks, in a run of `updates` updates
        (`PPOConfig.settling`).
        """
        self._spec = spec
        self._config = config
        self._updates = updates
        self.batch_schema: Schema = RECORDED
        if spec.privileged:
            self.batch_schema = {**RECORDED, **PRIVILEGED}

    def init(self, seed: int, initial: LearnedPolicy | None = None) -> TrainState:
        """Returns the state before the first update.

        With an `initial` policy, the learning rate begins at `_TRAINED_RATE` of the configured one.
        """
        rate = self._config.learning_rate
        if initial is None:
            initial = random_policy(seed, self._spec)
        else:
            rate *= _TRAINED_RATE
        params = jax.tree.map(jnp.asarray, initial.params)
        if initial.privileged is None and self._spec.privileged:
            initial = initial._replace(privileged=normalizer.empty((self._spec.privileged_size,)))
        optimizer = jax.jit(_optimizer(rate, self._config.max_grad_norm).init)(params)
        return TrainState.begin(seed, optimizer, initial._replace(params=params))

    def policy(self, state: TrainState) -> LearnedPolicy:
        """Returns parameters and normalisers."""
        return LearnedPolicy(state.params, state.observation, state.value, state.privileged)

    def update(
        self, state: TrainState, batch: Mapping[str, Array], mesh: Mesh | None = None
    ) -> tuple[TrainState, dict[str, float]]:
        """Runs epochs of minibatches over a batch; see `Algorithm.update`.

        If the policy is already several KL targets from the proximal one, only the critic learns: a
        policy with small standard deviations, such as an initial policy, thus survives a learning
        rate that is too large for it.

        The normalisers are frozen during the update and include the batch afterwards; the first
        update already normalises by its batch. The critic's output layer is adapted to the new
        value statistics so that its estimates do not change (van Hasselt et al. 2016, arXiv
        1602.07714). Rewards are passed unscaled.

        Raises:
          NonFiniteUpdate: a term is not finite, or the policy left its trust region by far; the
            error names the first term and holds the state before the update.
          CongraspError: there are more minibatches than transitions.
        """
        config = self._config
        if batch["reward"].size < config.minibatches:
            raise CongraspError(
                f"A batch of {batch['reward'].size} transitions cannot be split into "
                f"{config.minibatches} minibatches.",
                "Use fewer minibatches, more environments or longer rollouts.",
            )
        lag = batch.get("lag", np.zeros(batch["reward"].shape[1], np.int32))
        recorded = {name: batch[name] for name in self.batch_schema}
        arrays = {**recorded, "lag": lag}
        arrays = shard(arrays, mesh, _specs(arrays))
        moments = {}
        frozen = {}
        for name in _NORMALISED:
            if name in arrays:
                moments[name] = gathered_moments(arrays[name], mesh=mesh)
                frozen[name] = _first(getattr(state, name), moments[name], mesh)
        privileged = None
        if "privileged" in frozen:
            privileged = normalizer.privileged_affine(frozen["privileged"])
        inputs = losses.Inputs(
            batch=arrays,
            observations=normalizer.observation_affine(frozen["observation"], self._spec.layout),
            privileged=privileged,
            returns=normalizer.value_affine(state.value),
            hyper=self._hyperparameters(state.version),
        )
        params, optimizer, key = shard(state[:_ON_DEVICE], mesh)
        passes = Passes(self._spec.layout, config.epochs, config.minibatches)
        learnt, returns, failure, scalars = optimise(
            params, optimizer, key, inputs, passes=passes, mesh=mesh
        )
        learnt, moments, returns, failure, scalars = unreplicate(
            (learnt, moments, returns, failure, scalars), mesh
        )
        moments, returns, failure, scalars = jax.device_get((moments, returns, failure, scalars))
        state = TrainState(*learnt, *state[_ON_DEVICE:])
        if failure != _FINE:
            source = "rollouts" if _CHECKED[failure] in _CHECKED_INPUTS else "optimisation"
            raise NonFiniteUpdate(_CHECKED[failure], source, state)
        value = normalizer.merge(state.value, *of_ranks(returns))
        before = normalizer.value_affine(state.value)
        after = normalizer.value_affine(value)
        statistics = {
            name: normalizer.merge(getattr(state, name), *of_ranks(of_batch))
            for name, of_batch in moments.items()
        }
        state = state._replace(
            params=_preserve_values(state.params, before, after),
            value=value,
            version=state.version + 1,
            transitions=state.transitions + arrays["reward"].size,
            **statistics,
        )
        return state, {name: float(scalar) for name, scalar in scalars.items()}

    def _hyperparameters(self, version: int) -> dict[str, Any]:
        """Hyperparameters of the update of a version that are arguments of the compiled program."""
        config = self._config
        fixed = {
            name: value
            for name, value in vars(config).items()
            if isinstance(value, float | tuple | bool)
        }
        return fixed | {
            "kl_target": config.kl_target_at(version, self._updates),
            "noise_kept": config.noise_kept_at(version, self._updates),
            "least_std": config.least_std_at(version, self._updates),
        }


@optax.inject_hyperparams
def _optimizer(
    learning_rate: Array | float, max_grad_norm: Array | float
) -> optax.GradientTransformation:
    """Adam on clipped gradients; each network separately, so that a large gradient does not shrink
    the other's.
    """
    clip = optax.clip_by_global_norm(max_grad_norm)
    clips = optax.partition({"actor": clip, "critic": clip}, {"actor": "actor", "critic": "critic"})
    return optax.chain(clips, optax.adam(learning_rate, eps=1e-5))


def _with(optimizer: Any, **hyperparams: Array) -> Any:
    """Returns the optimiser's state with other hyperparameters."""
    return optimizer._replace(hyperparams={**optimizer.hyperparams, **hyperparams})


def _specs(names: Iterable[str]) -> dict[str, PartitionSpec]:
    """Partition specs of the arrays of a batch."""
    return {name: _SPECS[name] for name in names}


def _first(statistics: Statistics, moments: Statistics, mesh: Mesh | None) -> Statistics:
    """Returns the statistics, or those of the batch while there are no samples yet."""
    if statistics.count:
        return statistics
    return normalizer.merge(*of_ranks(unreplicate(moments, mesh)))


@functools.partial(
    jax.jit,
    static_argnames=("passes", "mesh"),
    donate_argnames="optimizer",
)
def optimise(
    params: Params,
    optimizer: Any,
    key: Array,
    inputs: losses.Inputs,
    *,
    passes: Passes,
    mesh: Mesh | None,
) -> tuple[Learnt, Statistics, Array, dict[str, Array]]:
    """Runs the epochs of an update over a batch, as one program of all ranks.

    Args:
      params: parameters of actor and critic; those of the proximal policy.
      optimizer: state of the optimiser, whose memory is reused.
      key: random key.
      inputs: batch, normalisation and hyperparameters; other values of these compile nothing.
      passes: layout of the observation, and numbers of epochs and minibatches.
      mesh: devices of the ranks, if there are several.

    Returns:
      The learnt state (unchanged after a failure), moments of the returns, index of the failed
      term, and metrics.
    """
    program = functools.partial(_program, collectives=Collectives(mesh), passes=passes)
    specs = REPLICATED, losses.Inputs._make([_specs(inputs.batch), *[REPLICATED] * 4])
    return shard_map(mesh, program, specs)((params, optimizer, key), inputs)


def _program(
    learnt: Learnt,
    inputs: losses.Inputs,
    *,
    collectives: Collectives,
    passes: Passes,
) -> tuple[Learnt, Statistics, Array, dict[str, Array]]:
    """Body of `optimise` for one rank."""
    params, optimizer, key = learnt
    hyper = inputs.hyper
    evaluation = losses.evaluate(params, inputs, collectives, passes.layout)
    checked = [inputs.batch.get(name, jnp.zeros(())) for name in _CHECKED_INPUTS]
    failure = collectives.max(_first_failure(jnp.int32(_FINE), 0, *checked, evaluation.value))
    key, epochs_key = jax.random.split(key)
    learning_rate = optimizer.hyperparams["learning_rate"]
    proximal = Proximal(
        params=params,
        optimizer=_with(optimizer, max_grad_norm=jnp.float32(hyper["max_grad_norm"])),
        failure=failure,
        keys=jax.random.split(collectives.own_key(epochs_key), passes.epochs),
        samples=jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), evaluation.samples),
    )
    moved, moved_optimizer, failure, (terms, norms) = _epochs(proximal, inputs, collectives, passes)
    moved = _settle(moved, params["actor"]["log_std"], hyper)
    kl = jnp.mean(terms.kl[-1])
    failure = jnp.where((failure == _FINE) & (kl > _MAX_KL), len(_CHECKED) - 1, failure)
    metrics = {name: jnp.mean(term) for name, term in terms._asdict().items()}
    metrics |= {f"{name}_grad_norm": jnp.mean(norm) for name, norm in norms.items()}
    metrics |= {
        "kl": kl,
        "learning_rate": learning_rate,
        "action_std": jnp.mean(jnp.exp(moved["actor"]["log_std"])),
    }
    metrics |= losses.batch_metrics(inputs, evaluation, collectives)
    moved_optimizer = _with(moved_optimizer, learning_rate=adapted_rate(learning_rate, kl, hyper))
    params, optimizer = jax.tree.map(
        lambda new, old: jnp.where(failure == _FINE, new, old),
        (moved, moved_optimizer),
        (params, optimizer),
    )
    return (
        (params, optimizer, key),
        collectives.gather(normalizer.moments(evaluation.returns)),
        failure,
        metrics,
    )


def _epochs(
    proximal: Proximal, inputs: losses.Inputs, collectives: Collectives, passes: Passes
) -> tuple[Params, Any, Array, tuple[losses.Terms, dict[str, Array]]]:
    """Runs shuffled minibatches, each sample at most once an epoch; the remainder of the division
    is skipped.
    """
    samples = proximal.samples
    log_std_proximal = proximal.params["actor"]["log_std"]
    minibatches = passes.minibatches
    count = samples.advantage.shape[0]
    size = count // minibatches
    hyper = inputs.hyper
    coefficients = losses.Coefficients(hyper["clip"], hyper["entropy"], hyper["value_coefficient"])
    gradient = jax.value_and_grad(losses.objective, has_aux=True)
    transform = _optimizer(0.0, 0.0)  # hyperparameters are in its state

    def step(carry: tuple[Params, Any, Array], rows: Array):
        params, optimizer, failure = carry
        minibatch = jax.tree.map(lambda x: x[rows], samples)
        minibatch = minibatch._replace(
            observation=normalizer.apply(inputs.observations, minibatch.observation),
            privileged=losses.normalised_inputs(inputs.privileged, minibatch.privileged),
        )
        (_, terms), gradients = gradient(
            params, passes.layout, log_std_proximal, minibatch, coefficients
        )
        terms, gradients = collectives.mean((terms, gradients))
        norms = {name: optax.tree.norm(tree) for name, tree in gradients.items()}
        failure = _first_failure(
            failure,
            len(_CHECKED_INPUTS) + 1,
            terms.policy_loss,
            terms.value_loss,
            terms.kl,
            norms["actor"],
            norms["critic"],
        )
        steps, optimizer = transform.update(gradients, optimizer, params)
        trusted = terms.kl <= _TRUSTED_KL * hyper["kl_target"]
        actor_steps = jax.tree.map(lambda leaf: jnp.where(trusted, leaf, 0.0), steps["actor"])
        steps = {**steps, "actor": actor_steps}
        return (optax.apply_updates(params, steps), optimizer, failure), (terms, norms)

    def epoch(carry: tuple[Params, Any, Array], key: Array):
        order = jax.random.permutation(key, count)[: size * minibatches]
        return jax.lax.scan(step, carry, order.reshape(minibatches, size))

    start = (proximal.params, proximal.optimizer, proximal.failure)
    (params, optimizer, failure), metrics = jax.lax.scan(epoch, start, proximal.keys)
    return params, optimizer, failure, metrics


def _first_failure(failure: Array, offset: int, *terms: Array) -> Array:
    """Returns `failure` if it names a term, else `offset` plus the index of the first term that is
    not finite.
    """
    failed = jnp.stack([~jnp.all(jnp.isfinite(term)) for term in terms])
    first = jnp.where(jnp.any(failed), offset + jnp.argmax(failed).astype(jnp.int32), _FINE)
    return jnp.where(failure == _FINE, first, failure)


def _settle(params: Params, log_std_before: Array, hyper: dict[str, Any]) -> Params:
    """Bounds log std of the parameters: at least log l, at most log f + k max(log std_0 - log f,
    0).

    l is `PPOConfig.least_std_at`, f `PPOConfig.final_std`, k `PPOConfig.noise_kept_at` and std_0
    the deviation before the update. Only one of the two bounds is set at a time.
    """
    final = jnp.log(hyper["final_std"])
    share = hyper["noise_kept"]
    log_std = params["actor"]["log_std"]
    ceiling = final + share * jnp.maximum(log_std_before - final, 0.0)
    log_std = jnp.where(share <= 1.0, jnp.minimum(log_std, ceiling), log_std)
    log_std = jnp.maximum(log_std, jnp.log(hyper["least_std"]))  # log 0 is no floor
    return {**params, "actor": {**params["actor"], "log_std": log_std}}


def adapted_rate(rate: Array, kl: Array, hyper: dict[str, Array]) -> Array:
    """Returns the next learning rate: 1.5 times smaller if the KL is above twice the target, as
    much larger if it is below half the target, and clipped.

    Args:
      rate: learning rate of the update.
      kl: mean KL to the proximal policy over the last epoch.
      hyper: `kl_target` and `learning_rate_range`.
    """
    target = hyper["kl_target"]
    factor_upward = jnp.where(kl < target / 2.0, _RATE_FACTOR, 1.0)
    factor = jnp.where(kl > 2.0 * target, 1.0 / _RATE_FACTOR, factor_upward)
    least, most = hyper["learning_rate_range"]
    return jnp.clip(rate * factor, least, most)


@jax.jit
def _preserve_values(params: Params, before: Affine, after: Affine) -> Params:
    """Adapts the critic's output layer so that its estimates stay the same under another
    normalisation.
    """
    output = params["critic"]["output"]
    ratio = after.scale / before.scale
    moved = {
        "kernel": output["kernel"] * ratio,
        "bias": output["bias"] * ratio + (before.shift - after.shift) * after.scale,
    }
    return {**params, "critic": {**params["critic"], "output": moved}}
