"""A grasp without a policy: the wrist follows its guidance, and the fingers close once the hand is in its place."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.rollout import Rollout, finished_episodes
from congrasp.actors.worker import RolloutWorker
from congrasp.common.hands.motors import motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.observation import layout
from congrasp.common.task.sampling.build import build_bank

NEAR = 0.03
"""Distance (m) of the hand centre from its heading position at which the fingers begin to close."""
STEP = 0.6
"""Largest finger action."""


def close(hand: Hand, task: TaskConfig, firmness: float = 1.0):
    """A policy for `RolloutWorker`: no residual of the wrist, fingers towards the closed pose."""
    sizes = dict(layout(hand, task))
    fingers = len(hand.joints)
    goal = jnp.clip(
        jnp.array(hand.q_open + firmness * (hand.q_closed - hand.q_open)), jnp.array(hand.lower), jnp.array(hand.upper)
    )

    def act(parameters, observation, key):
        q, ahead = observation[:, :fingers], observation[:, fingers + 6 : 2 * fingers + 6]
        time = observation[:, sizes["state"] - 2]
        off = jnp.linalg.norm(observation[:, sizes["state"] + 6 : sizes["state"] + 9], axis=-1)
        closing = (off < NEAR) | (time > 0.35) | (jnp.max(jnp.abs(q - jnp.array(hand.q_open)), -1) > 0.3)
        wanted = jnp.clip(motor_positions(hand, goal - (q + ahead)) / task.control.finger_scale, -STEP, STEP)
        action = jnp.concatenate([jnp.where(closing[:, None], wanted, 0.0), jnp.zeros((len(q), 6))], -1)
        return action, jnp.zeros(len(q))

    return act


def grasps(
    hand: Hand, task: TaskConfig, objects: Sequence[GraspObject], *, batch: int, seed: int = 0, firmness: float = 1.0
) -> tuple[dict[str, np.ndarray], Rollout]:
    """Metrics (E,) of one scripted episode in each of `batch` worlds, and their rollout."""
    physics = NativePhysics(hand, task, objects, 2)
    worker = RolloutWorker(
        hand,
        task,
        physics,
        build_bank(hand, task, objects, seed),
        close(hand, task, firmness),
        batch=batch,
        seed=seed,
        half_precision=False,
    )
    rollout = worker.collect(None, task.approach_steps + task.hold_steps_max)
    physics.close()
    return finished_episodes(rollout, task), rollout
