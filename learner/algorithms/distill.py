"""Distillation of a policy into one with other observations, on the states that the student visits.

The student acts, and the teacher, which observes the full state, labels each state with its action
(DAgger: Ross et al. 2011, arXiv 1011.0686, without its mixture of the two and without keeping old
states). The student's mean is regressed on the action that gives the teacher's targets
(`common.task.privileged`), in units of the teacher's standard deviation: up to a constant the KL
divergence from the student to the teacher, whose standard deviation the student keeps. The critic
learns nothing.
"""

import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh

from congrasp.common.config import DistillConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy import network, normalizer
from congrasp.common.policy.bundle import InferenceParameters, PolicyBundle, PolicySpec, full_layout
from congrasp.common.policy.network import Layout, Params
from congrasp.common.policy.normalizer import Affine
from congrasp.common.policy.pretrained import named_policy
from congrasp.common.task.config import ControlConfig, TaskConfig
from congrasp.common.task.privileged import extra, student_action
from congrasp.common.task.types import Array
from congrasp.common.wire.messages import RECORDABLE, Schema
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
    REPLICATED,
    Collectives,
    shard,
    shard_map,
    unreplicate,
)

_SCHEMA = {name: RECORDABLE[name] for name in ("observation", "teacher_observation")}
_SPECS = partition_specs(_SCHEMA)
_LAST_RATE = 0.02
"""Share of the initial learning rate that remains at the end of the run."""
_CHECKED = {"imitation_kl": "rollouts", "actor_grad_norm": "optimisation"}
"""Metrics that must be finite, and the stage to which an error attributes each."""

Body = tuple[Hand, ControlConfig]
"""The hand, and the mapping from its actions to joint targets."""
Learnt = tuple[Params, Any, Array]
"""The actor's parameters, the optimiser's state and the random key."""


class _Inputs(NamedTuple):
    """Inputs of an update in addition to state and batch."""

    observations: Affine
    """Normalisation of the student's observations, frozen."""
    teacher: InferenceParameters
    rate: Array
    """Learning rate."""


class Distillation:
    """Distillation, an `Algorithm`."""

    batch_schema: Schema = _SCHEMA

    def __init__(self, spec: PolicySpec, config: RunConfig):
        """Creates the algorithm for a student's networks.

        Args:
          spec: spec of the student.
          config: the run; its `distill` names the teacher.

        Raises:
          CongraspError: no teacher is named, its file cannot be read, or its observations or
            actions differ from this task's.
        """
        teacher = read_teacher(config.distill.teacher)
        _check(teacher, spec, config.task)
        self._spec = spec
        self._config = config.distill
        self._updates = config.updates
        self._layouts = (spec.layout, teacher.spec.layout)
        self._body = get_hand(config.task.hand), config.task.control
        self._teacher = teacher.inference_parameters

    def init(self, seed: int, initial: LearnedPolicy | None = None) -> TrainState:
        """Returns the state before the first update, with the teacher's action noise."""
        initial = initial or random_policy(seed, self._spec)
        params = jax.tree.map(jnp.asarray, initial.params)
        params["actor"] = {**params["actor"], "log_std": self._teacher.params["actor"]["log_std"]}
        optimizer = _transform(self._config.max_grad_norm).init(params["actor"])
        return TrainState.begin(seed, optimizer, initial._replace(params=params))

    def policy(self, state: TrainState) -> LearnedPolicy:
        """Returns parameters and normalisers."""
        return LearnedPolicy(state.params, state.observation, state.value, state.privileged)

    def update(
        self, state: TrainState, batch: Mapping[str, Array], mesh: Mesh | None = None
    ) -> tuple[TrainState, dict[str, float]]:
        """Runs epochs of minibatches over a batch; see `Algorithm.update`.

        The normaliser is frozen during the update and includes the batch afterwards; the first
        update already normalises by its batch.

        Raises:
          NonFiniteUpdate: a term is not finite; the error names the first one and holds the state
            before the update.
          CongraspError: there are more minibatches than transitions.
        """
        config = self._config
        transitions = batch["observation"].shape[0] * batch["observation"].shape[1]
        if transitions < config.minibatches:
            raise CongraspError(
                f"A batch of {transitions} transitions cannot be split into {config.minibatches} "
                f"minibatches.",
                "Use fewer --distill.minibatches, more environments or longer rollouts.",
            )
        arrays = shard({name: batch[name] for name in _SCHEMA}, mesh, _SPECS)
        gathered = unreplicate(gathered_moments(arrays["observation"], mesh=mesh), mesh)
        moments = of_ranks(jax.device_get(gathered))
        frozen = state.observation
        if not frozen.count:
            frozen = normalizer.merge(*moments)
        share = max(1.0 - state.version / max(self._updates, 1), _LAST_RATE)
        rate = config.learning_rate * share
        inputs = _Inputs(
            observations=normalizer.observation_affine(frozen, self._spec.layout),
            teacher=self._teacher,
            rate=jnp.float32(rate),
        )
        learnt = (state.params["actor"], state.optimizer, state.key)
        learnt, inputs = shard((learnt, inputs), mesh)
        optimised = _optimise(
            learnt,
            arrays,
            inputs,
            layouts=self._layouts,
            body=self._body,
            config=config,
            mesh=mesh,
        )
        learnt, metrics = unreplicate(optimised, mesh)
        metrics = {name: float(value) for name, value in jax.device_get(metrics).items()}
        for name, source in _CHECKED.items():
            if not math.isfinite(metrics[name]):
                raise NonFiniteUpdate(name, source, state)
        actor, optimizer, key = learnt
        state = state._replace(
            params={**state.params, "actor": actor},
            optimizer=optimizer,
            key=key,
            observation=normalizer.merge(state.observation, *moments),
            version=state.version + 1,
            transitions=state.transitions + int(sum(part.count for part in moments)),
        )
        return state, {**metrics, "learning_rate": rate}


def read_teacher(named: str) -> PolicyBundle:
    """Returns the policy that a run names as its teacher.

    Raises:
      CongraspError: no teacher is named, or there is no such policy.
    """
    if not named:
        raise CongraspError(
            "Distillation needs a teacher.", "Pass a hand or a policy file with --teacher."
        )
    return bundles.load(named_policy(named))


def _check(teacher: PolicyBundle, spec: PolicySpec, task: TaskConfig) -> None:
    """Raises `CongraspError` unless the teacher's observations and actions are those of this
    task.
    """
    what = f"The teacher, a policy for the hand '{teacher.spec.hand_name}',"
    if teacher.spec.hand != spec.hand:
        raise CongraspError(
            f"{what} cannot teach the hand '{spec.hand_name}'.",
            "Pass a teacher of the same hand with --teacher.",
        )
    if teacher.task.observation != "full" or teacher.spec.layout != full_layout(task):
        raise CongraspError(
            f"{what} has other observations than those of this task.",
            "Use the teacher's task: run 'congrasp train --teacher' without --task.… options.",
        )
    # The time is observed as a share of the episode
    for name in ("control", "control_dt", "dynamic_center"):
        if getattr(teacher.task, name) != getattr(task, name):
            raise CongraspError(
                f"{what} was trained with another '{name}' than that of this task.",
                f"Leave out --task.{name.replace('_', '-')}.",
            )


def _transform(max_grad_norm: float) -> optax.GradientTransformation:
    """Adam's steps on clipped gradients, before the learning rate."""
    return optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.scale_by_adam())


@functools.partial(jax.jit, static_argnames=("layouts", "body", "config", "mesh"))
def _optimise(
    learnt: Learnt,
    batch: dict[str, Array],
    inputs: _Inputs,
    *,
    layouts: tuple[Layout, Layout],
    body: Body,
    config: DistillConfig,
    mesh: Mesh | None,
) -> tuple[Learnt, dict[str, Array]]:
    """Runs epochs over the batch for a student and a teacher of these layouts; returns the learnt
    state and metrics.
    """
    program = functools.partial(
        _program, collectives=Collectives(mesh), layouts=layouts, body=body, config=config
    )
    return shard_map(mesh, program, (REPLICATED, _SPECS, REPLICATED))(learnt, batch, inputs)


def _program(
    learnt: Learnt,
    batch: dict[str, Array],
    inputs: _Inputs,
    *,
    collectives: Collectives,
    layouts: tuple[Layout, Layout],
    body: Body,
    config: DistillConfig,
) -> tuple[Learnt, dict[str, Array]]:
    """Body of `_optimise` for one rank: shuffled minibatches, each sample at most once an epoch."""
    actor, optimizer, key = learnt
    transform = _transform(config.max_grad_norm)
    rows = batch["teacher_observation"]
    labels = bundles.mean_action(layouts[1], inputs.teacher, rows[..., : -extra(body[0])])
    labels = student_action(*body, rows, labels)
    labels = labels.reshape(-1, labels.shape[-1])
    observation = batch["observation"].reshape(len(labels), -1)
    size = len(labels) // config.minibatches

    def loss(actor: Params, rows: Array) -> Array:
        normalised = normalizer.apply(inputs.observations, observation[rows])
        mean, log_std = network.policy({"actor": actor}, layouts[0], normalised, exact=False)
        return jnp.mean(network.kl_divergence(mean, log_std, labels[rows], log_std))

    def step(
        carry: tuple[Params, Any], rows: Array
    ) -> tuple[tuple[Params, Any], tuple[Array, Array]]:
        actor, optimizer = carry
        divergence, gradient = collectives.mean(jax.value_and_grad(loss)(actor, rows))
        gradient = {**gradient, "log_std": jnp.zeros_like(actor["log_std"])}
        steps, optimizer = transform.update(gradient, optimizer)
        actor = optax.apply_updates(actor, jax.tree.map(lambda x: -inputs.rate * x, steps))
        return (actor, optimizer), (divergence, optax.tree.norm(gradient))

    def epoch(
        carry: tuple[Params, Any], key: Array
    ) -> tuple[tuple[Params, Any], tuple[Array, Array]]:
        order = jax.random.permutation(key, len(labels))[: size * config.minibatches]
        return jax.lax.scan(step, carry, order.reshape(config.minibatches, size))

    key, epochs_key = jax.random.split(key)
    keys = jax.random.split(collectives.own_key(epochs_key), config.epochs)
    (actor, optimizer), (divergences, norms) = jax.lax.scan(epoch, (actor, optimizer), keys)
    metrics = {
        # Of the first pass: later ones have trained on these states
        "imitation_kl": jnp.mean(divergences[0]),
        "actor_grad_norm": jnp.mean(norms),
        "action_std": jnp.mean(jnp.exp(actor["log_std"])),
    }
    return (actor, optimizer, key), metrics
