"""Ranges of the numbers in a task's rollouts, computed by evaluating the task.

Engines end environments that exceed `MAX_SPEED` or `MAX_DISTANCE` (`common.ranges`). Observation
and reward terms are evaluated in random states up to these limits, where every clipped term reaches
its bound. The ranges of external constraints and terms therefore follow as well.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common.config import CurriculumConfig
from congrasp.common.hands import get_hand
from congrasp.common.hands.spec import Hand
from congrasp.common.ranges import MAX_DISTANCE, MAX_SPEED
from congrasp.common.task import privileged
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.constraints import known
from congrasp.common.task.constraints.base import symbol_sizes
from congrasp.common.task.features import scene_of
from congrasp.common.task.grip import ObjectLoad
from congrasp.common.task.metrics import DIVERGED, FORCES, episode_fields
from congrasp.common.task.observation import observe
from congrasp.common.task.privileged import Parameters, observe_for_teacher
from congrasp.common.task.readings import Readings
from congrasp.common.task.reward import reward_terms
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.types import CONTACTS_PER_LINK, Goal, SceneState, Surface

_STATES = 128
_SLACK = 2.0
_BEYOND = 1.0  # rad by which a finger joint is pressed beyond its limits
_MAX_TURN = 2 * np.pi  # rad of a wrist hinge
_CONTACT_SHARES = (0.0, 0.1, 0.5, 1.0)
"""Shares of a hand's contacts that are closed. Some terms need fingers that touch nothing, others
fingers that press."""
_ACTIVE_SHARE = 0.75
"""Share of states in which all constraints are active; in the others none is."""
_MAX_FORCE = 1e3  # N; terms and observations clip or squash forces far below this
_FLAGS = ("episode/success", "episode/held", f"episode/{DIVERGED}")
_MAX_METRIC = 1e6  # limit of an error or a force, in its unit
_MAX_ACTION = 1e3
_MAX_MASS = 1e3  # kg
_LEAST_WEIGHT = 1e-3  # N


class Ranges(NamedTuple):
    """Largest magnitudes that a task can produce (`task_ranges`)."""

    observation: np.ndarray
    """(D,)."""
    reward: float
    """Reward of a control step."""
    action: float
    """Action, in its units: targets are clipped far below."""
    episodes: dict[str, tuple[float, float]]
    """Least and largest value of each metric of an episode, by its name on the wire; other names
    are refused.
    """
    teacher_observation: np.ndarray = np.zeros(0)
    """(S,)."""
    privileged: np.ndarray = np.zeros(0)
    """(P,)."""


@functools.lru_cache(maxsize=8)
def task_ranges(task: TaskConfig, curriculum: CurriculumConfig) -> Ranges:
    """Returns the ranges of a task under all reward weights of its curriculum."""
    hand = get_hand(task.hand)
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        evaluate = jax.jit(functools.partial(_evaluate, hand, task))
        *observed, terms = jax.device_get(evaluate(_extremes(hand, task)))
    weights = [task.reward]
    if curriculum.ramp[1] > curriculum.ramp[0]:
        weights.append(curriculum.reward)
    most: dict[str, float] = {}
    for name, values in terms.items():
        largest_weight = max(abs(getattr(each, name)) for each in weights)
        most[name] = _SLACK * float(np.abs(values).max()) * largest_weight
    reward = sum(most.values())
    steps = task.approach_steps + max(task.hold_steps, task.hold_steps_max)
    episodes = dict.fromkeys(episode_fields(task), (-_MAX_METRIC, _MAX_METRIC))
    episodes |= {f"term/{name}": (-bound * steps, bound * steps) for name, bound in most.items()}
    episodes |= {f"episode/{name}": (0.0, _MAX_METRIC) for name in FORCES}
    episodes |= {
        "episode/return": (-reward * steps, reward * steps),
        "episode/length": (0.0, float(steps)),
    }
    for name in episodes:
        if name.startswith("episode/mask_") or name in _FLAGS:
            episodes[name] = (0.0, 1.0)
    # Some observations are zero in every state here, and rounding errors must not be refused.
    observation, of_teacher, privileged_inputs = (
        _SLACK * np.abs(values).max(0) + 1.0 for values in observed
    )
    return Ranges(
        observation=observation,
        reward=reward,
        action=_MAX_ACTION,
        episodes=episodes,
        teacher_observation=of_teacher,
        privileged=privileged_inputs,
    )


class _Extremes(NamedTuple):
    """Random control steps up to the engines' limits."""

    state: SceneState
    surface: Surface
    goal: Goal
    readings: Readings
    measured: dict[str, Any]
    """Further measurements of the sensor."""
    parameters: Parameters


def _evaluate(hand: Hand, task: TaskConfig, extremes: _Extremes) -> tuple[Any, Any, Any, Any]:
    """Evaluates observations (B, D), (B, S) of a teacher and (B, P) of the critic, and unweighted
    reward terms.
    """
    full = dataclasses.replace(task, observation="full")
    scene = scene_of(hand, full, extremes.state, extremes.surface, extremes.goal)
    parameters = extremes.parameters
    # An object that every contact carries, for the terms that depend on its weight.
    load = ObjectLoad(
        weight=jnp.full(scene.state.time.shape, _LEAST_WEIGHT), friction=parameters.friction
    )
    scene = scene._replace(load=load)
    ones = {field.name: 1.0 for field in dataclasses.fields(RewardWeights)}
    terms = reward_terms(scene, RewardWeights(**{**ones, "force_max": task.reward.force_max}))
    of_policy = scene._replace(task=task, readings=extremes.readings, measured=extremes.measured)
    return (
        observe(of_policy),
        observe_for_teacher(scene, of_policy, task.control),
        privileged.observe(of_policy, parameters),
        terms,
    )


def _extremes(hand: Hand, task: TaskConfig) -> _Extremes:
    """Random states up to the engines' limits, with random surfaces and goals.

    The readings before a state belong to other states.
    """
    rng = np.random.default_rng(0)
    fingers = len(hand.joints)
    contacts = (_STATES, len(hand.links), CONTACTS_PER_LINK)
    within = functools.partial(_inside, rng)
    unit = functools.partial(_unit, rng)
    contact_share = rng.choice(_CONTACT_SHARES, (_STATES, 1, 1))

    def joints() -> np.ndarray:
        lower = hand.lower - _BEYOND
        upper = hand.upper + _BEYOND
        return rng.uniform(lower, upper, (_STATES, fingers)).astype(np.float32)

    reach = rng.choice([0.1, MAX_DISTANCE], (_STATES, 1))  # hand and object touch, or are far apart
    start = within(3)
    u = within(6, most=np.concatenate([reach, reach, reach, np.full((_STATES, 3), _MAX_TURN)], 1))
    state = SceneState(
        q=joints(),
        u=u,
        q_velocity=within(fingers, most=MAX_SPEED),
        u_velocity=within(6, most=MAX_SPEED),
        q_target=joints(),
        u_target=u + within(6, most=MAX_DISTANCE),
        object_position=start + within(3, most=reach),
        object_quaternion=unit(4),
        object_velocity=within(3, most=MAX_SPEED),
        object_angular_velocity=within(3, most=MAX_SPEED),
        contact_force=within(*contacts[1:], 3, most=_MAX_FORCE),
        contact_position=start[:, None, None] + within(*contacts[1:], 3, most=0.2),
        contact_found=rng.random(contacts) < contact_share,
        base_position=start + within(3, most=0.1),
        base_quaternion=unit(4),
        q_initial=joints(),
        object_position_initial=start,
        object_quaternion_initial=unit(4),
        wrist_load=within(6, most=MAX_SPEED),
        time=rng.integers(0, task.approach_steps + task.hold_steps_max + 1, _STATES).astype(
            np.float32
        ),
        table=rng.random(_STATES) < 0.5,
    )
    count = task.surface_points
    surface = Surface(within(count, 3, most=0.1), rng.random((_STATES, count)) < 0.5)
    if task.surface_normals:
        surface = surface._replace(normals=unit(count, 3))
    goal = _goal(hand, task, rng)
    others = rng.integers(0, _STATES, (_STATES, task.history))
    others[:, 0] = np.arange(_STATES)
    readings = Readings(*(getattr(state, name)[others] for name in Readings._fields))
    sensors = None
    if task.sensed:
        sensors = get_sensor(task).draw(task.sensing, task.control_dt, jax.random.key(0), _STATES)
    parameters = Parameters(
        mass=rng.uniform(0.0, _MAX_MASS, _STATES),
        friction=rng.uniform(*task.friction_range, _STATES),
        gain_scale=rng.uniform(*task.gain_range, _STATES),
        stationary=rng.random(_STATES) < 0.5,
        hold=rng.integers(0, max(task.hold_steps, task.hold_steps_max) + 1, _STATES),
        sensors=sensors,
    )
    measured = {}
    for name, shape in get_sensor(task).query(hand, task).items():
        measured[name] = within(*shape, most=MAX_DISTANCE)
    extremes = _Extremes(state, surface, goal, readings, measured, parameters)
    return jax.tree.map(jnp.asarray, extremes)


def _goal(hand: Hand, task: TaskConfig, rng: np.random.Generator) -> Goal:
    """Random goals, in most of which every constraint is active."""
    symbols = symbol_sizes(hand, task)
    values = {}
    masks: dict[str, np.ndarray] = {}
    active = rng.random(_STATES) < _ACTIVE_SHARE
    for constraint in known(task):
        arrays = {}
        for name, array in constraint.arrays.items():
            shape = tuple(symbols[size] if isinstance(size, str) else size for size in array.shape)
            if array.kind == "flag":
                arrays[name] = rng.random((_STATES, *shape)) < 0.5
            elif array.kind in ("real", "position"):
                arrays[name] = _inside(rng, *shape, most=0.3)
            else:
                arrays[name] = _unit(rng, *shape)
        values[constraint.name] = constraint.goal(**arrays)
        for block in constraint.blocks:
            masks[block] = active
    return Goal(values, masks)


def _inside(rng: np.random.Generator, *shape: int, most: Any = 1.0) -> np.ndarray:
    """Numbers (B, *shape) up to a magnitude; some at the bounds and some in the middle, where terms
    differ.
    """
    drawn = rng.uniform(-1.0, 1.0, (_STATES, *shape))
    towards = rng.choice([0.1, 1.0, 8.0], (_STATES, *[1] * len(shape)))
    return np.asarray(most * np.sign(drawn) * np.abs(drawn) ** towards, np.float32)


def _unit(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Unit vectors (B, *shape)."""
    drawn = rng.normal(size=(_STATES, *shape))
    return (drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)).astype(np.float32)
