"""Initial conditions, given or drawn from a constraint bank (paper, sections Training Setup, Hand
Initialization).
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors.physics.engine import ResetState
from congrasp.common import chance, rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.closure import MARGIN, preshape
from congrasp.common.hands.spec import Hand
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.constraints import known, optional
from congrasp.common.task.constraints.priority import Resolution, active_blocks, resolve
from congrasp.common.task.sampling.bank import ConstraintBank, Draw, surface_of
from congrasp.common.task.sampling.headings import Headings, local_width
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.sensors.parameters import SensorParameters
from congrasp.common.task.types import Array, Goal, Surface

_CLEARANCE = 0.005
"""Least initial height of the hand over the table, m."""
_TRAINING = "training"
"""Name of the random numbers of `_TrainingNumbers`."""
_EPISODE = "episode"
"""Name of the random numbers of `_EpisodeNumbers`; those of constraints have their names."""


class InitialConditions(NamedTuple):
    """Initial conditions of B episodes."""

    reset_state: ResetState
    """Initial state of object and hand, and masses."""
    goal: Goal
    """Active constraints, after the priority rules."""
    surface: Surface
    """Labelled surface points of the objects."""
    region: Array
    """(B,) int: region of the constraint bank from which they were drawn."""
    hold: Array
    """(B,) int: control steps without the table before the end of the episode."""
    sensors: SensorParameters
    """Parameters of the sensors, for policies that do not observe the true state."""


class Approach(NamedTuple):
    """Start of B approaches, apart from their constraints."""

    back_off: Array
    """(B,) distance back from the aligned wrist where the heading guides it, m."""
    margin: Array
    """(B,) distance by which the fingers are opened wider than the object, m."""
    speed: Array
    """(B,) speed of the wrist along the heading, m/s."""


class PlacedHand(NamedTuple):
    """Initial hands of B episodes."""

    q: Array
    """(B, F) finger angles."""
    position: Array
    """(B, 3) wrist, world frame."""
    quaternion: Array
    """(B, 4)."""


class Dynamics(NamedTuple):
    """Objects and dynamics of B episodes; fields as in `ResetState`."""

    object_index: Array
    mass_scale: Array
    friction: Array
    gain_scale: Array
    stationary: Array


class RequestedEpisodes(NamedTuple):
    """A batch of requested episodes, before the priority rules; object frame."""

    goal: Goal
    """Goal arrays; those of absent constraints may hold any finite values, and the active flags are
    ignored.
    """
    asked: dict[str, Array]
    """(B,) bool for each optional constraint by name: True if requested."""
    surface: Surface
    rest: Array
    """(B, 7) pose of the object on the table."""


class _TrainingNumbers(NamedTuple):
    """Random numbers (B,) in [0, 1) of episodes in training only."""

    object: Array
    rest: Array
    joined: Array
    is_disturbed: Array
    disturbance: Array
    distance: Array
    margin: Array
    speed: Array


class _EpisodeNumbers(NamedTuple):
    """Random numbers (B,) in [0, 1) of all drawn episodes."""

    mass: Array
    friction: Array
    hold: Array
    gain: Array
    reference: Array


class _Plan(NamedTuple):
    """Properties of B episodes before their constraints are sampled, apart from those of `Draw`."""

    uniform: Mapping[str, Array]
    """Random numbers of `_uniforms`."""
    sensors: SensorParameters
    requested: Mapping[str, Array]
    """(B,) bool for each optional constraint by name: True if requested."""
    stationary: Array | bool
    approach: Approach


def sample(
    hand: Hand,
    task: TaskConfig,
    bank: ConstraintBank,
    key: Array,
    batch: int,
    stationary: Array | bool = False,
    rows: Array | None = None,
) -> InitialConditions:
    """Draws objects, resting poses, constraints and initial hands at random.

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
    uniform = _uniforms(hand, task, key, batch)
    sensors = get_sensor(task).draw(task.sensing, task.control_dt, key, batch)
    if rows is not None:
        uniform, sensors = jax.tree.map(lambda numbers: numbers[rows], (uniform, sensors))
    episode = _TrainingNumbers(*uniform[_TRAINING].T)
    disturbance = None
    if task.disturbed_references:
        is_disturbed = episode.is_disturbed < task.disturbed_references
        disturbance = jnp.where(is_disturbed, episode.disturbance, 0.0)
    draw = Draw(
        bank,
        objects=chance.weighted(episode.object, bank.weight),
        rests=chance.index(episode.rest, bank.rest.shape[1]),
        disturbance=disturbance,
    )
    plan = _Plan(
        uniform=uniform,
        sensors=sensors,
        requested=_requested(task, uniform, episode.joined),
        stationary=stationary,
        approach=_varied(task, episode.distance, episode.margin, episode.speed),
    )
    return _drawn(hand, task, draw, plan)


def _requested(
    task: TaskConfig, uniform: Mapping[str, Array], joined_number: Array
) -> dict[str, Array]:
    """Draws the requested constraints (B,) of episodes in training, by name.

    A constraint that is never requested is a constant, so that its share of the program is not even
    compiled.
    """
    requested = {}
    for constraint in optional(task):
        share = getattr(task, f"p_{constraint.name}")
        if share:
            requested[constraint.name] = uniform[constraint.name][:, 0] < share
        else:
            requested[constraint.name] = jnp.zeros(len(joined_number), bool)
    active = active_blocks(requested)
    for constraint in optional(task):
        joined = constraint.joined(task, active, joined_number)
        if joined is not None:
            requested[constraint.name] |= joined
    return requested


def _uniforms(hand: Hand, task: TaskConfig, key: Array, batch: int) -> dict[str, Array]:
    """Random numbers (B, U) in [0, 1) of B episodes by name.

    A constraint has two before those of `Constraint.sample`: whether it is requested, and its
    reference.
    """
    counts = {
        _TRAINING: len(_TrainingNumbers._fields),
        _EPISODE: len(_EpisodeNumbers._fields),
    }
    for constraint in known(task):
        counts[constraint.name] = 2 + constraint.numbers(hand, task)
    return chance.uniforms(key, counts, batch)


def _varied(task: TaskConfig, distance: Array, margin: Array, speed: Array) -> Approach:
    """Approaches for training from random numbers (B,) in [0, 1): from near and far, at rest or in
    motion, with different openings.
    """
    near, far = task.back_off_range
    narrow, wide = task.preshape_margin
    back_off = near + (far - near) * distance
    return Approach(
        back_off=back_off,
        margin=narrow + (wide - narrow) * margin,
        speed=speed * task.initial_speed * back_off / far,
    )


def _nominal(task: TaskConfig, batch: int) -> Approach:
    """Returns the nominal approaches of evaluation and requests."""
    return Approach(jnp.full(batch, task.back_off), jnp.full(batch, MARGIN), jnp.zeros(batch))


class PlannedEpisodes(NamedTuple):
    """B episodes with given objects and constraints, and the inputs of their draws."""

    objects: np.ndarray
    """(B,) int."""
    rests: np.ndarray
    """(B,) int, indices of the resting poses."""
    names: np.ndarray
    """(B,) uint32, seeds of the objects, independent of their position in the bank."""
    numbers: np.ndarray
    """(B,) int, index of the episode among those of its object."""


def planned(
    hand: Hand,
    task: TaskConfig,
    bank: ConstraintBank,
    key: Array,
    plan: PlannedEpisodes,
    asked: Mapping[str, Array],
) -> InitialConditions:
    """Draws planned episodes under the requested constraints, each from a separate key.

    An episode therefore does not depend on the others.

    Args:
      hand: the hand.
      task: ranges.
      bank: the constraint bank; it must allow the constraints (`allowing`).
      key: random key of all episodes under these constraints.
      plan: the episodes.
      asked: () bool for each optional constraint by name: True if every episode requests it.
    """

    def one(episode: PlannedEpisodes) -> InitialConditions:
        episode_key = jax.random.fold_in(jax.random.fold_in(key, episode.names), episode.numbers)
        draw = Draw(bank, episode.objects[None], episode.rests[None])
        sensors = get_sensor(task).draw(task.sensing, task.control_dt, episode_key, 1)
        plan = _Plan(
            uniform=_uniforms(hand, task, episode_key, 1),
            sensors=sensors,
            requested={name: jnp.reshape(flag, 1) for name, flag in asked.items()},
            stationary=False,
            approach=_nominal(task, 1),
        )
        return _drawn(hand, task, draw, plan)

    return jax.tree.map(lambda leaf: leaf[:, 0], jax.vmap(one)(plan))


def allowing(task: TaskConfig, bank: ConstraintBank, asked: Collection[str]) -> np.ndarray:
    """(N, R) bool: objects and resting poses for which the constraints of these names can be drawn
    together.
    """
    objects, rests = (jnp.asarray(axis.ravel()) for axis in np.indices(bank.has_affordance.shape))
    requested = {c.name: jnp.full(objects.shape, c.name in asked) for c in optional(task)}
    draw, available = _available(task, Draw(bank, objects, rests), requested)
    is_possible = jnp.ones(objects.shape, bool)
    for name, is_requested in requested.items():
        is_possible &= available[name] == is_requested
    if task.aligned_references:
        is_possible &= jnp.any(_allowed_together(task, draw, requested), -1)
    return np.asarray(is_possible).reshape(bank.has_affordance.shape)


def _available(
    task: TaskConfig, draw: Draw, requested: Mapping[str, Array]
) -> tuple[Draw, dict[str, Array]]:
    """Returns the draw with its region, and the available ones of the requested constraints (B,),
    in order.
    """
    available = {}
    draw = draw._replace(region=jnp.zeros_like(draw.objects))
    for constraint in optional(task):
        flags = requested[constraint.name] & constraint.available(draw)
        available[constraint.name] = flags
        draw = draw._replace(region=jnp.maximum(draw.region, constraint.region * flags))
    return draw, available


def _drawn(hand: Hand, task: TaskConfig, draw: Draw, plan: _Plan) -> InitialConditions:
    """Draws the rest of B episodes with the objects and resting poses of a draw, and the available
    ones of the requested constraints.
    """
    bank = draw.bank
    uniform = plan.uniform
    numbers = _EpisodeNumbers(*uniform[_EPISODE].T)
    dynamics = Dynamics(
        object_index=draw.objects,
        mass_scale=_within(task.mass_range, numbers.mass),
        friction=_within(task.friction_range, numbers.friction),
        gain_scale=_within(task.gain_range, numbers.gain),
        stationary=jnp.broadcast_to(plan.stationary, draw.objects.shape),
    )
    draw, available = _available(task, draw, plan.requested)
    mass = bank.mass[draw.objects] * dynamics.mass_scale
    draw = draw._replace(mass=mass, friction=dynamics.friction)
    references = _references(task, draw, available, uniform, numbers.reference)
    draw = draw._replace(reference=references)
    values = {}
    for constraint in known(task):
        own_numbers = uniform[constraint.name][:, 2:]
        values[constraint.name] = constraint.sample(hand, draw, own_numbers)
    surface = surface_of(task, bank, draw.objects)
    goal = resolve(hand, surface, Goal(values, {}), available).goal
    rest = bank.rest[draw.objects, draw.rests]
    placed = initial_hand(hand, task, goal, surface, rest, plan.approach)
    return InitialConditions(
        reset_state=_reset_state(goal, rest, placed, plan.approach, dynamics),
        goal=goal,
        surface=surface,
        region=draw.region,
        hold=_hold(task, numbers.hold),
        sensors=plan.sensors,
    )


def _within(limits: tuple[float, float], number: Array) -> Array:
    """Numbers (B,) in [0, 1) scaled to a range."""
    low, high = limits
    return low + (high - low) * number


def _hold(task: TaskConfig, number: Array) -> Array:
    """Control steps (B,) without the table, by random numbers (B,) in [0, 1)."""
    choices = task.hold_steps_max - task.hold_steps + 1
    # Squared, so that short holds, whose beginning every episode shares, remain the most common.
    longer = jnp.floor(number**2 * choices).astype(jnp.int32)
    return jnp.minimum(task.hold_steps + longer, task.hold_steps_max)


def _references(
    task: TaskConfig,
    draw: Draw,
    available: Mapping[str, Array],
    uniform: Mapping[str, Array],
    common: Array,
) -> dict[str, Array]:
    """Index (B,) of the reference of each constraint that is drawn from references.

    Each constraint draws independently (the paper's potentially misaligned pairs). With
    `aligned_references`, all use one that every requested constraint allows, by the random numbers
    `common` (B,); where there is none, each draws independently.
    """
    together = _allowed_together(task, draw, available)
    is_any_together = jnp.any(together, -1, keepdims=True)
    references = {}
    for name, allowed in _allowed(task, draw).items():
        if task.aligned_references:
            allowed = jnp.where(is_any_together, together, allowed)
            references[name] = chance.among(common, allowed)
        else:
            references[name] = chance.among(uniform[name][:, 1], allowed)
    return references


def _allowed(task: TaskConfig, draw: Draw) -> dict[str, Array]:
    """References (B, M) bool allowed by each constraint that is drawn from references."""
    return {c.name: c.allowed(draw) for c in optional(task) if c.from_reference}


def _allowed_together(task: TaskConfig, draw: Draw, requested: Mapping[str, Array]) -> Array:
    """(B, M) bool: references allowed by every requested constraint."""
    together = jnp.ones_like(draw.allowed)
    for name, allowed in _allowed(task, draw).items():
        together &= allowed | ~requested[name][:, None]
    return together


def handover_speed(hand: Hand, task: TaskConfig) -> float:
    """Wrist speed (m/s) at the end of a planned reach: nine tenths of that at which the guidance
    moves it on.

    A target that leads by d moves the wrist at d stiffness / damping. A slower reach has a second
    peak after it.
    """
    stiffness, damping = hand.wrist_servos[:, 0]
    return float(0.9 * task.control.approach_position_limit * stiffness / damping)


def requested_conditions(
    hand: Hand,
    task: TaskConfig,
    request: RequestedEpisodes,
    hold: Array | int,
    speed: Array | float,
) -> tuple[InitialConditions, Resolution]:
    """Returns requested episodes of one object of nominal mass and friction, and the effects of the
    priority rules.

    The policy observes the true pose of the object, whatever tracker it was trained with.

    Args:
      hand: the hand.
      task: geometry of the approach.
      request: the episodes.
      hold: control steps without the table.
      speed: initial speed of the wrist along the heading, m/s.
    """
    resolution = resolve(hand, request.surface, request.goal, request.asked)
    goal = resolution.goal
    batch = request.rest.shape[0]
    nominal = jnp.ones(batch)
    index = jnp.zeros(batch, jnp.int32)
    dynamics = Dynamics(
        object_index=index,
        mass_scale=nominal,
        friction=nominal,
        gain_scale=nominal,
        stationary=jnp.zeros(batch, bool),
    )
    approach = _nominal(task, batch)._replace(speed=jnp.full(batch, speed))
    placed = initial_hand(hand, task, goal, request.surface, request.rest, approach)
    sensors = get_sensor(task).draw(SensingConfig(), task.control_dt, jax.random.key(0), batch)
    conditions = InitialConditions(
        reset_state=_reset_state(goal, request.rest, placed, approach, dynamics),
        goal=goal,
        surface=request.surface,
        region=index,
        hold=jnp.full(batch, hold, jnp.int32),
        sensors=sensors,
    )
    return conditions, resolution


def _reset_state(
    goal: Goal, rest: Array, placed: PlacedHand, approach: Approach, dynamics: Dynamics
) -> ResetState:
    """Returns the initial states of placed hands that approach along the heading, for objects in
    resting poses (B, 7).
    """
    along = rotations.rotate(rest[:, 3:], goal["heading"].direction)
    velocity = rotations.rotate(
        rotations.conjugate(placed.quaternion), approach.speed[:, None] * along
    )
    return ResetState(
        object_index=dynamics.object_index,
        mass_scale=dynamics.mass_scale,
        friction=dynamics.friction,
        gain_scale=dynamics.gain_scale,
        base_position=placed.position,
        base_quaternion=placed.quaternion,
        u_velocity=jnp.pad(velocity, ((0, 0), (0, 3))),
        q=placed.q,
        object_position=rest[:, :3],
        object_quaternion=rest[:, 3:],
        stationary=dynamics.stationary,
    )


def initial_hand(
    hand: Hand,
    task: TaskConfig,
    goal: Goal,
    surface: Surface,
    rest: Array,
    approach: Approach | None = None,
) -> PlacedHand:
    """Initial hands, determined by the constraints.

    With `TaskConfig.preshape` the fingers are opened to the object's width at the heading, unless a
    constraint sets them. A hand that would be in the table is raised.

    Args:
      hand: the hand.
      task: geometry of the approach.
      goal: goal after the priority rules.
      surface: surface of the objects.
      rest: (B, 7) resting poses of the objects.
      approach: start of the approach; nominal by default.
    """
    approach = approach or _nominal(task, len(rest))
    q = jnp.broadcast_to(jnp.array(hand.q_open), (rest.shape[0], len(hand.joints)))
    if task.preshape:
        heading = Headings(*(axis[:, None] for axis in goal["heading"]))
        width = local_width(heading, surface.points)[:, 0]
        q = preshape(hand, width, approach.margin)
    for constraint in known(task):
        fingers = constraint.initial_fingers(goal)
        if fingers is not None:
            is_set, angles = fingers
            q = jnp.where(is_set[:, None], angles, q)
    position = jnp.zeros_like(rest[:, :3])
    quaternion = jnp.zeros_like(rest[:, 3:])
    for constraint in known(task):
        wrist = constraint.initial_wrist(hand, approach.back_off, goal, q)
        if wrist is not None:
            is_set, wrist_position, wrist_quaternion = wrist
            position = jnp.where(is_set[:, None], wrist_position, position)
            quaternion = jnp.where(is_set[:, None], wrist_quaternion, quaternion)
    position, quaternion = rotations.compose_pose(rest[:, :3], rest[:, 3:], position, quaternion)
    missing = _CLEARANCE - _lowest(hand, q, position, quaternion)
    position = position.at[:, 2].add(jnp.maximum(missing, 0.0))
    return PlacedHand(q, position, quaternion)


def _lowest(hand: Hand, q: Array, position: Array, quaternion: Array) -> Array:
    """Height (B,) in m over the table of the lowest point of hands at wrist poses (B, 3), (B, 4),
    world frame.
    """
    ends = kinematics.capsules(hand, kinematics.link_transforms(hand, q)).reshape(len(q), -1, 3)
    height = jnp.sum(rotations.to_matrix(quaternion)[:, None, 2] * ends, -1) + position[:, 2:]
    return jnp.min(height - np.repeat(hand.capsule_radii, 2), -1)
