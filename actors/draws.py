"""Random draws of episodes' initial conditions from a constraint bank (paper, section Training
Setup): of training, and of planned episodes with given objects and constraints.

An episode's draws follow in this order, since each depends on the earlier ones: object and resting
pose, requested constraints, the available ones of them and their region of the bank, references,
goal arrays, initial hand.
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors.initial import Dynamics, InitialConditions, reset_state
from congrasp.actors.initial_hand import Approach, initial_hand, nominal_approach
from congrasp.common import chance
from congrasp.common.hands.spec import Hand
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import known, optional
from congrasp.common.task.constraints.priority import active_blocks, resolve
from congrasp.common.task.sampling.bank import ConstraintBank, Draw, surface_of
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.sensors.parameters import SensorParameters
from congrasp.common.task.types import Array, Goal

_TRAINING = "training"
"""Name of the random numbers of `_TrainingNumbers`."""
_EPISODE = "episode"
"""Name of the random numbers of `_EpisodeNumbers`; those of a constraint have its name."""


class _TrainingNumbers(NamedTuple):
    """Random numbers (B,) in [0, 1) of episodes in training only, by what they determine."""

    object: Array
    rest: Array
    joined: Array
    """Joining of a constraint with the requested ones (`Constraint.joined`)."""
    is_disturbed: Array
    """Presence of a disturbance of the references."""
    disturbance: Array
    """Scale of the disturbance."""
    back_off: Array
    margin: Array
    speed: Array


class _EpisodeNumbers(NamedTuple):
    """Random numbers (B,) in [0, 1) of all drawn episodes, by what they determine."""

    mass: Array
    friction: Array
    hold: Array
    gain: Array
    reference: Array
    """Common reference of all constraints, with `aligned_references`."""


class _ConstraintNumbers(NamedTuple):
    """Random numbers in [0, 1) of a constraint, by what they determine."""

    requested: Array
    """(B,) presence of the constraint."""
    reference: Array
    """(B,) reference of the constraint."""
    goal: Array
    """(B, U) goal arrays of the constraint (`Constraint.sample`)."""


class _RandomNumbers(NamedTuple):
    """All random numbers of B episodes."""

    training: _TrainingNumbers
    episode: _EpisodeNumbers
    constraints: dict[str, _ConstraintNumbers]
    """By the constraint's name."""


class _DrawInputs(NamedTuple):
    """Properties of B episodes before their constraints are drawn, apart from those of `Draw`."""

    numbers: _RandomNumbers
    sensors: SensorParameters
    requested: Mapping[str, Array]
    """(B,) bool for each optional constraint by name: True if requested."""
    stationary: Array | bool
    """() or (B,) bool: the object is fixed."""
    approach: Approach


class PlannedEpisodes(NamedTuple):
    """B episodes with given objects, and the inputs of their draws."""

    objects: np.ndarray
    """(B,) int."""
    rests: np.ndarray
    """(B,) int, indices of the resting poses."""
    object_seeds: np.ndarray
    """(B,) uint32, seeds of the objects, independent of their position in the bank."""
    episode_numbers: np.ndarray
    """(B,) int, index of the episode among those of its object."""


def sample(
    hand: Hand,
    task: TaskConfig,
    bank: ConstraintBank,
    key: Array,
    batch: int,
    stationary: Array | bool = False,
    rows: Array | None = None,
) -> InitialConditions:
    """Draws episodes of training: objects, resting poses, constraints and initial hands.

    Each constraint has random numbers of its own, so that adding one does not change the draws of
    the others.

    Args:
      hand: the hand.
      task: probabilities of the constraints, and ranges.
      bank: the constraint bank.
      key: random key.
      batch: number B of episodes.
      stationary: () bool, fixes the objects (the paper's first phase).
      rows: (K,) int, draws only these of the B episodes; all by default.
    """
    columns = _uniform_columns(hand, task, key, batch)
    sensors = get_sensor(task).draw(task.sensing, task.control_dt, key, batch)
    if rows is not None:
        columns, sensors = jax.tree.map(lambda array: array[rows], (columns, sensors))
    numbers = _named_numbers(task, columns)
    training = numbers.training
    disturbance = None
    if task.disturbed_references:
        is_disturbed = training.is_disturbed < task.disturbed_references
        disturbance = jnp.where(is_disturbed, training.disturbance, 0.0)
    draw = Draw(
        bank,
        objects=chance.weighted(training.object, bank.weight),
        rests=chance.index(training.rest, bank.rest.shape[1]),
        disturbance=disturbance,
    )
    inputs = _DrawInputs(
        numbers=numbers,
        sensors=sensors,
        requested=_draw_requested(task, numbers),
        stationary=stationary,
        approach=_draw_approach(task, training),
    )
    return _draw_conditions(hand, task, draw, inputs)


def sample_planned(
    hand: Hand,
    task: TaskConfig,
    bank: ConstraintBank,
    key: Array,
    episodes: PlannedEpisodes,
    requested: Mapping[str, Array],
) -> InitialConditions:
    """Draws planned episodes under the requested constraints, each from a separate key.

    An episode therefore does not depend on the others.

    Args:
      hand: the hand.
      task: ranges.
      bank: the constraint bank; it must allow the constraints (`samplable`).
      key: random key of all episodes under these constraints.
      episodes: the episodes.
      requested: () bool for each optional constraint by name: True if every episode requests it.
    """

    def sample_one(episode: PlannedEpisodes) -> InitialConditions:
        """Initial conditions of a batch of one episode, given by scalars."""
        object_key = jax.random.fold_in(key, episode.object_seeds)
        episode_key = jax.random.fold_in(object_key, episode.episode_numbers)
        draw = Draw(bank, episode.objects[None], episode.rests[None])
        sensors = get_sensor(task).draw(task.sensing, task.control_dt, episode_key, 1)
        inputs = _DrawInputs(
            numbers=_named_numbers(task, _uniform_columns(hand, task, episode_key, 1)),
            sensors=sensors,
            requested={name: jnp.reshape(flag, 1) for name, flag in requested.items()},
            stationary=False,
            approach=nominal_approach(task, 1),
        )
        return _draw_conditions(hand, task, draw, inputs)

    conditions = jax.vmap(sample_one)(episodes)
    return jax.tree.map(lambda array: array[:, 0], conditions)


def samplable(task: TaskConfig, bank: ConstraintBank, names: Collection[str]) -> np.ndarray:
    """(N, R) bool: objects and resting poses for which the constraints of these names can be drawn
    together.
    """
    object_indices, rest_indices = np.indices(bank.has_affordance.shape)
    draw = Draw(bank, jnp.asarray(object_indices.ravel()), jnp.asarray(rest_indices.ravel()))
    requested = {}
    for constraint in optional(task):
        requested[constraint.name] = jnp.full(draw.objects.shape, constraint.name in names)
    draw, available = _available(task, draw, requested)
    is_samplable = jnp.ones(draw.objects.shape, bool)
    for name, is_requested in requested.items():
        is_samplable &= available[name] == is_requested
    if task.aligned_references:
        is_samplable &= jnp.any(_allowed_by_all(task, draw, requested), -1)
    return np.asarray(is_samplable).reshape(bank.has_affordance.shape)


def _uniform_columns(hand: Hand, task: TaskConfig, key: Array, batch: int) -> dict[str, Array]:
    """Random numbers (B, U) in [0, 1) of B episodes, by `_TRAINING`, `_EPISODE` and the names of
    the constraints.
    """
    counts = {
        _TRAINING: len(_TrainingNumbers._fields),
        _EPISODE: len(_EpisodeNumbers._fields),
    }
    for constraint in known(task):
        counts[constraint.name] = 2 + constraint.numbers(hand, task)  # see `_named_numbers`
    return chance.uniforms(key, counts, batch)


def _named_numbers(task: TaskConfig, columns: Mapping[str, Array]) -> _RandomNumbers:
    """Names the columns of `_uniform_columns`."""
    constraints = {}
    for constraint in known(task):
        of_constraint = columns[constraint.name]
        constraints[constraint.name] = _ConstraintNumbers(
            requested=of_constraint[:, 0], reference=of_constraint[:, 1], goal=of_constraint[:, 2:]
        )
    return _RandomNumbers(
        training=_TrainingNumbers(*columns[_TRAINING].T),
        episode=_EpisodeNumbers(*columns[_EPISODE].T),
        constraints=constraints,
    )


def _draw_requested(task: TaskConfig, numbers: _RandomNumbers) -> dict[str, Array]:
    """Draws the requested constraints (B,) of episodes in training, by name.

    A constraint that is never requested is a constant, so that its share of the program is not even
    compiled.
    """
    joined_number = numbers.training.joined
    requested = {}
    for constraint in optional(task):
        probability = getattr(task, f"p_{constraint.name}")
        if probability:
            number = numbers.constraints[constraint.name].requested
            requested[constraint.name] = number < probability
        else:
            requested[constraint.name] = jnp.zeros(len(joined_number), bool)
    active = active_blocks(requested)
    for constraint in optional(task):
        joined = constraint.joined(task, active, joined_number)
        if joined is not None:
            requested[constraint.name] |= joined
    return requested


def _draw_approach(task: TaskConfig, numbers: _TrainingNumbers) -> Approach:
    """Draws approaches (B,) of training: from near and far, at rest or in motion, with different
    openings.
    """
    _, farthest = task.back_off_range
    back_off = _within(task.back_off_range, numbers.back_off)
    return Approach(
        back_off=back_off,
        margin=_within(task.preshape_margin, numbers.margin),
        speed=numbers.speed * task.initial_speed * back_off / farthest,
    )


def _draw_conditions(
    hand: Hand, task: TaskConfig, draw: Draw, inputs: _DrawInputs
) -> InitialConditions:
    """Draws the rest of B episodes whose objects, resting poses and requested constraints are
    known.

    A requested constraint that is not available for the object and resting pose is left out.
    """
    bank = draw.bank
    numbers = inputs.numbers
    episode = numbers.episode
    dynamics = Dynamics(
        object_index=draw.objects,
        mass_scale=_within(task.mass_range, episode.mass),
        friction=_within(task.friction_range, episode.friction),
        gain_scale=_within(task.gain_range, episode.gain),
        stationary=jnp.broadcast_to(inputs.stationary, draw.objects.shape),
    )
    draw, available = _available(task, draw, inputs.requested)
    mass = bank.mass[draw.objects] * dynamics.mass_scale
    draw = draw._replace(mass=mass, friction=dynamics.friction)
    draw = draw._replace(reference=_draw_references(task, draw, available, numbers))
    goal_arrays = {}
    for constraint in known(task):
        goal_numbers = numbers.constraints[constraint.name].goal
        goal_arrays[constraint.name] = constraint.sample(hand, draw, goal_numbers)
    surface = surface_of(task, bank, draw.objects)
    goal = resolve(hand, surface, Goal(goal_arrays, {}), available).goal
    rest = bank.rest[draw.objects, draw.rests]
    placed = initial_hand(hand, task, goal, surface, rest, inputs.approach)
    return InitialConditions(
        reset_state=reset_state(goal, rest, placed, inputs.approach, dynamics),
        goal=goal,
        surface=surface,
        region=draw.region,
        hold=_draw_hold(task, episode.hold),
        sensors=inputs.sensors,
    )


def _available(
    task: TaskConfig, draw: Draw, requested: Mapping[str, Array]
) -> tuple[Draw, dict[str, Array]]:
    """Returns the draw with its region, and the available ones of the requested constraints (B,).

    The region is that of the available constraints; whether a constraint is available may depend on
    the region of earlier ones.
    """
    available = {}
    draw = draw._replace(region=jnp.zeros_like(draw.objects))
    for constraint in optional(task):
        flags = requested[constraint.name] & constraint.available(draw)
        available[constraint.name] = flags
        draw = draw._replace(region=jnp.maximum(draw.region, constraint.region * flags))
    return draw, available


def _within(limits: tuple[float, float], number: Array) -> Array:
    """Numbers (B,) in [0, 1) scaled to a range."""
    low, high = limits
    return low + (high - low) * number


def _draw_hold(task: TaskConfig, number: Array) -> Array:
    """Control steps (B,) without the table, by random numbers (B,) in [0, 1)."""
    choices = task.hold_steps_max - task.hold_steps + 1
    # Squared, so that short holds, whose beginning every episode shares, remain the most common.
    additional = jnp.floor(number**2 * choices).astype(jnp.int32)
    return jnp.minimum(task.hold_steps + additional, task.hold_steps_max)


def _draw_references(
    task: TaskConfig,
    draw: Draw,
    available: Mapping[str, Array],
    numbers: _RandomNumbers,
) -> dict[str, Array]:
    """Draws the index (B,) of the reference of each constraint that is drawn from references.

    Each constraint draws independently (the paper's potentially misaligned pairs). With
    `aligned_references`, all use one that every available constraint allows; where there is none,
    each uses one that it allows.
    """
    allowed_by_all = _allowed_by_all(task, draw, available)
    is_any_allowed_by_all = jnp.any(allowed_by_all, -1, keepdims=True)
    references = {}
    for name, allowed in _allowed(task, draw).items():
        if task.aligned_references:
            allowed = jnp.where(is_any_allowed_by_all, allowed_by_all, allowed)
            references[name] = chance.among(numbers.episode.reference, allowed)
        else:
            references[name] = chance.among(numbers.constraints[name].reference, allowed)
    return references


def _allowed(task: TaskConfig, draw: Draw) -> dict[str, Array]:
    """References (B, M) bool allowed by each constraint that is drawn from references."""
    return {c.name: c.allowed(draw) for c in optional(task) if c.from_reference}


def _allowed_by_all(task: TaskConfig, draw: Draw, requested: Mapping[str, Array]) -> Array:
    """(B, M) bool: references allowed by every requested constraint."""
    allowed_by_all = jnp.ones_like(draw.allowed)
    for name, allowed in _allowed(task, draw).items():
        allowed_by_all &= allowed | ~requested[name][:, None]
    return allowed_by_all
