"""The environment as pure functions over a batch of worlds: episodes, observations, rewards, success.

Physics stands between `targets` and `score`; who steps it is `actors.rollout`'s business.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from actors.physics.engine import Readout, World, where_worlds
from actors.references import MAX_HEADING_M, MAX_HEADING_RAD, Grasps
from actors.taskset import TaskSet
from common import rotations
from common.config import RewardWeights, TaskConfig
from common.constraints.priority import Request, resolve
from common.hands import kinematics
from common.hands.spec import Hand
from common.task.control import heading_wrist_pose
from common.task.features import Features, features
from common.task.metrics import Errors, errors
from common.task.reward import TERMS, fallen, reward_terms
from common.task.types import MASKS, Action, Array, Goal, SceneState, Surface

_WINDOWED = ("heading_rad", "heading_m", "pose_rad", "pose_m", "trajectory_rad", "trajectory_m")
_COUNTED = ("minus_links", "any_links", "force_sum", "force_link_max")
_SUMS = ("return", *_WINDOWED, *_COUNTED)
METRICS = (
    "success",
    "held",
    "return",
    "length",
    "links_at_removal",
    "moved_at_removal",
    *_WINDOWED,
    "affordance_ratio",
    "force_sum",
    "force_link_max",
    "bad",
    *(f"mask_{name}" for name in MASKS),
    "object_index",
)
"""Metrics of a finished episode, in the order of `EnvironmentState.finished`; then come the sums of the terms."""
EPISODE_FIELDS = (*(f"episode/{name}" for name in METRICS), *(f"term/{name}" for name in TERMS))


class EnvironmentState(NamedTuple):
    """A batch of worlds between two control steps."""

    key: Array
    """() random key of the next resets."""
    world: World
    """What the present episodes started from."""
    goal: Goal
    """Active constraints."""
    surface: Surface
    """Surface points of the worlds' objects."""
    variant: Array
    """(B,) int: the variant of the task set that the episodes were drawn from."""
    time: Array
    """(B,) control steps since the episode began."""
    hold: Array
    """(B,) control steps without the table before the episode ends."""
    q_target: Array
    """(B, F) targets of the previous step."""
    u_target: Array
    """(B, 6)."""
    removal_height: Array
    """(B,) object's height when the table was removed."""
    links_at_removal: Array
    """(B,) links touching then."""
    moved_at_removal: Array
    """(B,) metres the object had moved by then."""
    kept: Array
    """(B,) bool: the object had not fallen `hold_steps` after the removal (the paper's success)."""
    bad: Array
    """(B,) bool: the physics diverged in this episode."""
    sums: dict[str, Array]
    """Sums (B,) over the episode."""
    terms: Array
    """(B, terms) sums of the reward's terms over the episode."""
    grasps: Grasps
    """Grasps of successful episodes under a heading alone."""
    finished: Array
    """(B, fields) metrics of the episode that ended last, in the order of `EPISODE_FIELDS`."""
    has_finished: Array
    """(B,) bool: an episode ended since the flag was cleared."""


class Score(NamedTuple):
    """Result of one control step."""

    reward: Array
    """(B,)."""
    terminal: Array
    """(B,) bool: the episode ended with this step."""
    terms: Array
    """(B, terms) weighted reward terms."""


def scene_state(env: EnvironmentState, readout: Readout, task: TaskConfig) -> SceneState:
    """The moment as the task's formulas see it."""
    return SceneState(
        q=readout.q,
        u=readout.u,
        q_velocity=readout.q_velocity,
        u_velocity=readout.u_velocity,
        q_target=env.q_target,
        u_target=env.u_target,
        object_position=readout.object_position,
        object_quaternion=readout.object_quaternion,
        object_velocity=readout.object_velocity,
        object_angular_velocity=readout.object_angular_velocity,
        contact_force=readout.contact_force,
        contact_position=readout.contact_position,
        contact_found=readout.contact_found,
        base_position=env.world.base_position,
        base_quaternion=env.world.base_quaternion,
        q_initial=env.world.q,
        object_position_initial=env.world.object_position,
        object_quaternion_initial=env.world.object_quaternion,
        time=env.time.astype(jnp.float32),
        table=table_present(env, task),
    )


def table_present(env: EnvironmentState, task: TaskConfig) -> Array:
    """(B,) bool: whether the table stands in the coming control step."""
    return (env.time < task.approach_steps) | env.world.stationary


def start(
    hand: Hand, task: TaskConfig, taskset: TaskSet, key: Array, batch: int, stationary: Array | bool = False
) -> EnvironmentState:
    """Fresh episodes in every world; `stationary` () bool holds the objects in place (the paper's first phase)."""
    key, episode_key = jax.random.split(key)
    return begin(*sample_episodes(hand, task, taskset, episode_key, batch, stationary), key)


def begin(world: World, goal: Goal, surface: Surface, variant: Array, hold: Array, key: Array) -> EnvironmentState:
    """Episodes that begin as they are told; see `EnvironmentState` for the arguments."""
    batch = world.q.shape[0]
    zero, no, index = jnp.zeros(batch), jnp.zeros(batch, bool), jnp.zeros(batch, jnp.int32)
    return EnvironmentState(
        key=key,
        world=world,
        goal=goal,
        surface=surface,
        variant=variant,
        time=index,
        hold=hold,
        q_target=world.q,
        u_target=jnp.zeros((batch, 6)),
        removal_height=world.object_position[:, 2],
        links_at_removal=zero,
        moved_at_removal=zero,
        kept=no,
        bad=no,
        sums=dict.fromkeys(_SUMS, zero),
        terms=jnp.zeros((batch, len(TERMS))),
        grasps=Grasps(no, index, index, world.q, world.base_position, world.base_quaternion),
        finished=jnp.zeros((batch, len(EPISODE_FIELDS))),
        has_finished=no,
    )


def restart(
    hand: Hand, task: TaskConfig, taskset: TaskSet, env: EnvironmentState, mask: Array, stationary: Array | bool = False
) -> EnvironmentState:
    """New episodes in the masked worlds (B,); the others are untouched."""
    fresh = start(hand, task, taskset, env.key, mask.shape[0], stationary)
    # What is not of the episode stays.
    kept = {name: getattr(env, name) for name in ("grasps", "finished", "has_finished")}
    merged = where_worlds(mask, fresh._replace(key=mask, **kept), env._replace(key=mask))
    return merged._replace(key=fresh.key)


def sample_episodes(
    hand: Hand, task: TaskConfig, taskset: TaskSet, key: Array, batch: int, stationary: Array | bool = False
) -> tuple[World, Goal, Surface, Array, Array]:
    """Objects, resting poses, constraints and initial hands (paper, sections Training Setup and Hand Initialization).

    Returns:
      World, goal (after the priority rules), surface, variant of the task set (B,) and hold length (B,) int.
    """
    keys = iter(jax.random.split(key, 10))
    uniform = lambda: jax.random.uniform(next(keys), (batch,))  # noqa: E731
    objects = jax.random.randint(next(keys), (batch,), 0, taskset.points.shape[0])
    rests = jax.random.randint(next(keys), (batch,), 0, taskset.rest.shape[1])
    affordance = (uniform() < task.p_affordance) & taskset.has_affordance[objects, rests]
    variant = affordance.astype(jnp.int32)
    valid = taskset.pose_valid[objects, variant, rests]
    pose = (uniform() < task.p_pose) & jnp.any(valid, -1)
    trajectory = (uniform() < task.p_trajectory) & jnp.any(valid, -1)
    reference = jnp.argmax(jnp.where(valid, jax.random.uniform(next(keys), valid.shape), -1.0), -1)
    slot = jax.random.randint(next(keys), (batch,), 0, taskset.heading_index.shape[-1])
    heading = taskset.heading_index[objects, variant, rests, slot]
    back = taskset.heading_back[objects, variant, rests, slot][:, None]
    direction = taskset.heading_direction[objects, variant, heading]

    surface = Surface(taskset.points[objects], taskset.minus[objects])
    asked = Goal(
        heading_position=taskset.heading_position[objects, variant, heading] - back * direction,
        heading_direction=direction,
        heading_cross=taskset.heading_cross[objects, variant, heading],
        pose_q=taskset.pose_q[objects, variant, reference],
        pose_position=taskset.pose_position[objects, variant, reference],
        pose_quaternion=taskset.pose_quaternion[objects, variant, reference],
        trajectory_position=taskset.trajectory_position[objects, variant, reference],
        trajectory_quaternion=taskset.trajectory_quaternion[objects, variant, reference],
        mask=jnp.zeros((batch, len(MASKS))),
    )
    goal = resolve(hand, surface, Request(asked, affordance, pose, trajectory)).goal

    rest = taskset.rest[objects, rests]
    q = jnp.where(pose[:, None], goal.pose_q, jnp.array(hand.q_open))
    base_position, base_quaternion = initial_wrist(hand, task, goal, q, trajectory, rest[:, :3], rest[:, 3:])
    low, high = task.mass_range
    friction_low, friction_high = task.friction_range
    world = World(
        object_index=objects,
        mass_scale=low + (high - low) * uniform(),
        friction=friction_low + (friction_high - friction_low) * uniform(),
        base_position=base_position,
        base_quaternion=base_quaternion,
        q=q,
        object_position=rest[:, :3],
        object_quaternion=rest[:, 3:],
        stationary=jnp.broadcast_to(stationary, (batch,)),
    )
    # Squared, so that short holds, whose beginning every episode shares, stay the rule.
    longer = jnp.floor(uniform() ** 2 * (task.hold_steps_max - task.hold_steps + 1)).astype(jnp.int32)
    hold = jnp.minimum(task.hold_steps + longer, task.hold_steps_max)
    return world, goal, surface, variant, hold


def initial_wrist(
    hand: Hand,
    task: TaskConfig,
    goal: Goal,
    q: Array,
    trajectory: Array,
    object_position: Array,
    object_quaternion: Array,
) -> tuple[Array, Array]:
    """World wrist poses (B, 3), (B, 4) at the start: the first waypoint, or aligned with the heading and backed off."""
    center = kinematics.hand_center(hand, kinematics.keypoints(hand, kinematics.link_transforms(hand, q)))
    position, quaternion = heading_wrist_pose(hand, goal, center)
    position = position - task.back_off * goal.heading_direction
    position = jnp.where(trajectory[:, None], goal.trajectory_position[:, 0], position)
    quaternion = jnp.where(trajectory[:, None], goal.trajectory_quaternion[:, 0], quaternion)
    return rotations.compose_pose(object_position, object_quaternion, position, quaternion)


def moment(hand: Hand, task: TaskConfig, env: EnvironmentState, readout: Readout) -> tuple[SceneState, Features]:
    """Scene state and features of the present moment."""
    scene = scene_state(env, readout, task)
    return scene, features(hand, task, scene, env.surface, env.goal)


def score(
    hand: Hand, task: TaskConfig, weights: RewardWeights, env: EnvironmentState, readout: Readout, action: Action
) -> tuple[EnvironmentState, Score, SceneState, Features]:
    """Reward and bookkeeping of a control step that physics has just made.

    Args:
      hand: the hand.
      task: timing.
      weights: reward weights, may be traced.
      env: the worlds before the step.
      readout: the worlds after it.
      action: the joint targets of the step.

    Returns:
      The worlds after the step (episodes that ended are still in place), its score, and the moment after it.
    """
    had_table = table_present(env, task)
    env = env._replace(
        time=env.time + 1,
        q_target=jnp.where(readout.bad[:, None], env.world.q, action.q_target),
        u_target=jnp.where(readout.bad[:, None], 0.0, action.u_target),
        bad=env.bad | readout.bad,
    )
    scene, seen = moment(hand, task, env, readout)
    terms = reward_terms(hand, task, weights, scene, seen, env.goal)
    terms["drop"] = jnp.where(env.bad, -weights.drop, terms["drop"])
    stacked = jnp.stack([terms[name] for name in TERMS], -1)
    reward = jnp.sum(stacked, -1)

    removed_now = env.time == task.approach_steps
    height = scene.object_position[:, 2]
    links = jnp.sum(seen.touching, -1).astype(jnp.float32)
    moved = jnp.linalg.norm(scene.object_position - scene.object_position_initial, axis=-1)
    env = env._replace(
        removal_height=jnp.where(removed_now, height, env.removal_height),
        links_at_removal=jnp.where(removed_now, links, env.links_at_removal),
        moved_at_removal=jnp.where(removed_now, moved, env.moved_at_removal),
    )
    up = (height > env.removal_height - task.drop_height) & ~fallen(task, scene) & ~env.bad & (env.links_at_removal > 0)
    env = env._replace(kept=jnp.where(env.time == task.approach_steps + task.hold_steps, up, env.kept))

    error = errors(hand, task, scene, seen, env.goal)
    env = env._replace(grasps=_grasps(task, env, scene, seen, error, up))
    force = jnp.linalg.norm(seen.force, axis=-1)
    # The paper's window ends `hold_steps` after the removal, however much longer the episode holds.
    window = ~had_table & (env.time <= task.approach_steps + task.hold_steps)
    before, after = had_table.astype(jnp.float32), window.astype(jnp.float32)
    step = {name: getattr(error, name) * (before if name.startswith("trajectory") else after) for name in _WINDOWED}
    step |= {
        "return": reward,
        "minus_links": error.minus_links * after,
        "any_links": error.any_links * after,
        "force_sum": jnp.sum(force, -1) * after,
        "force_link_max": jnp.max(force, -1) * after,
    }
    env = env._replace(
        sums={name: env.sums[name] + step[name] for name in _SUMS},
        terms=env.terms + stacked,
    )
    terminal = env.time >= task.approach_steps + env.hold
    if task.end_when_fallen:
        terminal |= (env.time >= task.approach_steps + task.hold_steps) & ~up
    finished = jnp.where(terminal[:, None], _episode(task, env, up), env.finished)
    env = env._replace(finished=finished, has_finished=env.has_finished | terminal)
    return env, Score(reward, terminal, stacked), scene, seen


def _grasps(
    task: TaskConfig, env: EnvironmentState, scene: SceneState, seen: Features, error: Errors, up: Array
) -> Grasps:
    """The grasps, with those that succeeded just now under a heading alone and near to it."""
    _, finger, _, trajectory = (env.goal.mask[:, i] > 0 for i in range(len(MASKS)))
    near = (error.heading_rad < MAX_HEADING_RAD) & (error.heading_m < MAX_HEADING_M)
    now = (env.time == task.approach_steps + task.hold_steps) & up & near & ~finger & ~trajectory
    position, quaternion = rotations.relative_pose(
        scene.object_position, scene.object_quaternion, seen.wrist_position, seen.wrist_quaternion
    )
    fresh = Grasps(now, env.world.object_index, env.variant, scene.q, position, quaternion)
    taken = where_worlds(now, fresh[1:], env.grasps[1:])
    return Grasps(env.grasps.found | now, *taken)


def _episode(task: TaskConfig, env: EnvironmentState, up: Array) -> Array:
    """(B, fields) metrics of the present episodes, as if they ended now."""
    length = env.time.astype(jnp.float32)
    before, after = task.approach_steps, max(task.hold_steps, 1)
    metrics = {
        "success": env.kept,
        "held": env.kept & up,
        "return": env.sums["return"],
        "length": length,
        "links_at_removal": env.links_at_removal,
        "moved_at_removal": env.moved_at_removal,
        **{name: env.sums[name] / (before if name.startswith("trajectory") else after) for name in _WINDOWED},
        "affordance_ratio": env.sums["minus_links"] / jnp.maximum(env.sums["any_links"], 1.0),
        "force_sum": env.sums["force_sum"] / after,
        "force_link_max": env.sums["force_link_max"] / after,
        "bad": env.bad,
        **{f"mask_{name}": env.goal.mask[:, i] for i, name in enumerate(MASKS)},
        "object_index": env.world.object_index,
    }
    values = jnp.stack([jnp.asarray(metrics[name], jnp.float32) for name in METRICS], -1)
    return jnp.concatenate([values, env.terms], -1)
