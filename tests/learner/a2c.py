"""Advantage actor-critic (Mnih et al. 2016, arXiv 1602.01783): one step on a whole batch, no
epochs, no clipping.

It shares nothing with PPO but the networks and the advantages, and learns from less: it needs no
log probabilities.
"""

import functools

import jax
import jax.numpy as jnp
import optax

from congrasp.common.policy import network, normalizer
from congrasp.common.policy.normalizer import Statistics
from congrasp.common.wire.messages import RECORDED
from congrasp.learner.algorithms import gae
from congrasp.learner.algorithms.protocol import (
    LearnedPolicy,
    NonFiniteUpdate,
    TrainState,
    partition_specs,
    random_policy,
)
from congrasp.learner.distributed.collectives import (
    REPLICATED,
    Collectives,
    shard,
    shard_map,
    unreplicate,
)

SCHEMA = {name: spec for name, spec in RECORDED.items() if name != "log_probability"}
OPTIMIZER = optax.adam(0.01)


class A2C:
    batch_schema = SCHEMA

    def __init__(self, spec, config):
        self._spec = spec
        self._gamma = config.ppo.gamma

    def init(self, seed, initial=None):
        initial = initial or random_policy(seed, self._spec)
        optimizer = OPTIMIZER.init(initial.params)
        return TrainState.begin(seed, optimizer, initial)

    def policy(self, state):
        return LearnedPolicy(state.params, state.observation, state.value)

    def update(self, state, batch, mesh=None):
        arrays = shard({name: batch[name] for name in SCHEMA}, mesh, partition_specs(SCHEMA))
        affine = normalizer.observation_affine(state.observation, self._spec.layout)
        learnt = shard((state.params, state.optimizer), mesh)
        result = _step(learnt, arrays, affine, self._gamma, layout=self._spec.layout, mesh=mesh)
        (params, optimizer), moments, metrics = unreplicate(result, mesh)
        if not jnp.isfinite(metrics["loss"]):
            raise NonFiniteUpdate("loss", "optimisation", state)
        ranks = [Statistics(*parts) for parts in zip(*jax.device_get(moments), strict=True)]
        state = state._replace(
            params=params,
            optimizer=optimizer,
            observation=normalizer.merge(state.observation, *ranks),
            version=state.version + 1,
            transitions=state.transitions + arrays["reward"].size,
        )
        return state, {name: float(value) for name, value in metrics.items()}


@functools.partial(jax.jit, static_argnames=("layout", "mesh"))
def _step(learnt, batch, affine, gamma, *, layout, mesh):
    def program(learnt, batch, affine, gamma):
        collectives = Collectives(mesh)
        params, optimizer = learnt
        (_, metrics), gradients = jax.value_and_grad(_loss, has_aux=True)(
            params, batch, affine, gamma, layout, collectives
        )
        metrics, gradients = collectives.mean((metrics, gradients))
        steps, optimizer = OPTIMIZER.update(gradients, optimizer)
        moments = normalizer.moments(batch["observation"], event_axes=1)
        return (optax.apply_updates(params, steps), optimizer), collectives.gather(moments), metrics

    specs = REPLICATED, partition_specs(SCHEMA), REPLICATED, REPLICATED
    return shard_map(mesh, program, specs)(learnt, batch, affine, gamma)


def _loss(params, batch, affine, gamma, layout, collectives):
    observation = normalizer.apply(affine, batch["observation"])
    mean, log_std = network.policy(params, layout, observation)
    value = network.value(params, layout, observation)
    last = network.value(params, layout, normalizer.apply(affine, batch["last_observation"]))
    advantage, returns = jax.lax.stop_gradient(
        gae.advantages(batch["reward"], value, last, batch["terminal"], gamma, 1.0)
    )
    advantage /= jnp.sqrt(collectives.variance(advantage)) + 1e-6
    policy_loss = -jnp.mean(network.log_probability(mean, log_std, batch["action"]) * advantage)
    value_loss = jnp.mean((value - returns) ** 2)
    loss = policy_loss + 0.5 * value_loss
    return loss, {"loss": loss, "policy_loss": policy_loss, "value_loss": value_loss}
