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
from congrasp.common.task.sensing import Sensors, draw_sensors
from congrasp.common.task.types import Array, Goal, Surface

_CLEARANCE = 0.005
"""Least initial height of the hand over the table, m."""


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
    sensors: Sensors
    """Trackers of the objects' poses, for policies that do not observe the true ones."""


class Approach(NamedTuple):
    """Start of B approaches, apart from their constraints."""

    back_off: Array
    """(B,) distance back from the aligned wrist where the heading guides it, m."""
    margin: Array
    """(B,) distance by which the fingers are opened wider than the object, m."""
    speed: Array
    """(B,) speed of the wrist along the heading, m/s."""


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
    uniform, sensors = (
        _uniforms(hand, task, key, batch),
        draw_sensors(task.sensing, task.control_dt, key, batch),
    )
    if rows is not None:
        uniform, sensors = jax.tree.map(lambda numbers: numbers[rows], (uniform, sensors))
    episode = uniform[_TRAINING].T
    count = len(episode[0])
    objects, rests = (
        chance.weighted(episode[0], bank.weight),
        chance.index(episode[1], bank.rest.shape[1]),
    )
    # A constraint that is never requested is a constant, so that its share of the program is not
    # even compiled.
    wanted = {
        c.name: uniform[c.name][:, 0] < share
        if (share := getattr(task, f"p_{c.name}"))
        else jnp.zeros(count, bool)
        for c in optional(task)
    }
    active = active_blocks(wanted)
    for constraint in optional(task):
        if (joined := constraint.joined(task, active, episode[2])) is not None:
            wanted[constraint.name] |= joined
    disturbance = None
    if task.disturbed_references:
        disturbance = jnp.where(episode[3] < task.disturbed_references, episode[4], 0.0)
    draw = Draw(bank, objects, rests, disturbance=disturbance)
    return _drawn(
        hand, task, draw, uniform, sensors, wanted, stationary, _varied(task, *episode[5:])
    )


_TRAINING, _EPISODE = "training", "episode"
"""Random numbers of an episode apart from those of its constraints, which have their names."""


def _uniforms(hand: Hand, task: TaskConfig, key: Array, batch: int) -> dict[str, Array]:
    """Random numbers (B, U) in [0, 1) of B episodes by name.

    A constraint has two before those of `Constraint.sample`: whether it is requested, and its
    reference.
    """
    numbers = {c.name: 2 + c.numbers(hand, task) for c in known(task)}
    return chance.uniforms(key, {_TRAINING: 8, _EPISODE: 5, **numbers}, batch)


def _varied(task: TaskConfig, distance: Array, margin: Array, speed: Array) -> Approach:
    """Approaches for training from random numbers (B,) in [0, 1): from near and far, at rest or in
    motion, with different openings.
    """
    near, far = task.back_off_range
    narrow, wide = task.preshape_margin
    back_off = near + (far - near) * distance
    return Approach(
        back_off, narrow + (wide - narrow) * margin, speed * task.initial_speed * back_off / far
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
        own = jax.random.fold_in(jax.random.fold_in(key, episode.names), episode.numbers)
        draw = Draw(bank, episode.objects[None], episode.rests[None])
        wanted = {name: jnp.reshape(flag, 1) for name, flag in asked.items()}
        sensors = draw_sensors(task.sensing, task.control_dt, own, 1)
        return _drawn(
            hand,
            task,
            draw,
            _uniforms(hand, task, own, 1),
            sensors,
            wanted,
            False,
            _nominal(task, 1),
        )

    return jax.tree.map(lambda leaf: leaf[:, 0], jax.vmap(one)(plan))


def allowing(task: TaskConfig, bank: ConstraintBank, asked: Collection[str]) -> np.ndarray:
    """(N, R) bool: objects and resting poses for which the constraints of these names can be drawn
    together.
    """
    objects, rests = (jnp.asarray(axis.ravel()) for axis in np.indices(bank.has_affordance.shape))
    wanted = {c.name: jnp.full(objects.shape, c.name in asked) for c in optional(task)}
    draw, found = _available(task, Draw(bank, objects, rests), wanted)
    fine = jnp.ones(objects.shape, bool)
    for name, wish in wanted.items():
        fine &= found[name] == wish
    if task.aligned_references:
        fine &= jnp.any(_allowed_together(task, draw, wanted), -1)
    return np.asarray(fine).reshape(bank.has_affordance.shape)


def _available(
    task: TaskConfig, draw: Draw, wanted: Mapping[str, Array]
) -> tuple[Draw, dict[str, Array]]:
    """Returns the draw with its region, and the available ones of the wanted constraints (B,), in
    order.
    """
    asked, draw = {}, draw._replace(region=jnp.zeros_like(draw.objects))
    for constraint in optional(task):
        asked[constraint.name] = wanted[constraint.name] & constraint.available(draw)
        draw = draw._replace(
            region=jnp.maximum(draw.region, constraint.region * asked[constraint.name])
        )
    return draw, asked


def _drawn(  # noqa: PLR0913
    hand: Hand,
    task: TaskConfig,
    draw: Draw,
    uniform: Mapping[str, Array],
    sensors: Sensors,
    wanted: Mapping[str, Array],
    stationary: Array | bool,
    approach: Approach,
) -> InitialConditions:
    """Draws the rest of B episodes with given objects, resting poses, sensors and (where available)
    constraints.

    `uniform` are numbers of `_uniforms`.
    """
    bank, batch = draw.bank, draw.objects.shape
    mass, friction, length, gain, common = uniform[_EPISODE].T
    low, high = task.mass_range
    friction_low, friction_high = task.friction_range
    mass = low + (high - low) * mass
    friction = friction_low + (friction_high - friction_low) * friction
    draw, asked = _available(task, draw, wanted)
    draw = draw._replace(mass=bank.mass[draw.objects] * mass, friction=friction)
    draw = draw._replace(reference=_references(task, draw, asked, uniform, common))
    values = {c.name: c.sample(hand, draw, uniform[c.name][:, 2:]) for c in known(task)}
    surface = surface_of(task, bank, draw.objects)
    goal = resolve(hand, surface, Goal(values, {}), asked).goal
    gain_low, gain_high = task.gain_range
    reset_state = start(
        hand,
        task,
        goal,
        surface,
        bank.rest[draw.objects, draw.rests],
        approach,
        objects=draw.objects,
        mass_scale=mass,
        friction=friction,
        gain_scale=gain_low + (gain_high - gain_low) * gain,
        stationary=jnp.broadcast_to(stationary, batch),
    )
    # Squared, so that short holds, whose beginning every episode shares, remain the most common.
    longer = jnp.floor(length**2 * (task.hold_steps_max - task.hold_steps + 1)).astype(jnp.int32)
    hold = jnp.minimum(task.hold_steps + longer, task.hold_steps_max)
    return InitialConditions(reset_state, goal, surface, draw.region, hold, sensors)


def _references(
    task: TaskConfig,
    draw: Draw,
    asked: Mapping[str, Array],
    uniform: Mapping[str, Array],
    common: Array,
) -> dict[str, Array]:
    """Index (B,) of the reference of each constraint that is drawn from references.

    Each constraint draws independently (the paper's potentially misaligned pairs). With
    `aligned_references`, all use one that every requested constraint allows, by the random numbers
    `common` (B,); where there is none, each draws independently.
    """
    together = _allowed_together(task, draw, asked)
    found = {}
    for name, own in _allowed(task, draw).items():
        if task.aligned_references:
            own = jnp.where(jnp.any(together, -1, keepdims=True), together, own)
        found[name] = chance.among(common if task.aligned_references else uniform[name][:, 1], own)
    return found


def _allowed(task: TaskConfig, draw: Draw) -> dict[str, Array]:
    """References (B, M) bool allowed by each constraint that is drawn from references."""
    return {c.name: c.allowed(draw) for c in optional(task) if c.from_reference}


def _allowed_together(task: TaskConfig, draw: Draw, asked: Mapping[str, Array]) -> Array:
    """(B, M) bool: references allowed by every requested constraint."""
    together = jnp.ones_like(draw.allowed)
    for name, own in _allowed(task, draw).items():
        together &= own | ~asked[name][:, None]
    return together


def handover_speed(hand: Hand, task: TaskConfig) -> float:
    """Wrist speed (m/s) at the end of a planned reach: nine tenths of that at which the guidance
    moves it on.

    A target that leads by d moves the wrist at d stiffness / damping. A slower reach has a second
    peak after it.
    """
    stiffness, damping = hand.wrist_servos[:, 0]
    return float(0.9 * task.control.approach_position_limit * stiffness / damping)


def given(
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
    batch = request.rest.shape[0]
    nominal, index = jnp.ones(batch), jnp.zeros(batch, jnp.int32)
    reset_state = start(
        hand,
        task,
        resolution.goal,
        request.surface,
        request.rest,
        _nominal(task, batch)._replace(speed=jnp.full(batch, speed)),
        objects=index,
        mass_scale=nominal,
        friction=nominal,
        gain_scale=nominal,
        stationary=jnp.zeros(batch, bool),
    )
    holds = jnp.full(batch, hold, jnp.int32)
    sensors = draw_sensors(SensingConfig(), task.control_dt, jax.random.key(0), batch)
    return InitialConditions(
        reset_state, resolution.goal, request.surface, index, holds, sensors
    ), resolution


def start(  # noqa: PLR0913
    hand: Hand,
    task: TaskConfig,
    goal: Goal,
    surface: Surface,
    rest: Array,
    approach: Approach,
    *,
    objects: Array,
    mass_scale: Array,
    friction: Array,
    gain_scale: Array,
    stationary: Array,
) -> ResetState:
    """Returns initial conditions with the hand where its constraints place it, for objects in
    resting poses (B, 7).
    """
    q, base_position, base_quaternion = initial_hand(hand, task, goal, surface, rest, approach)
    along = rotations.rotate(rest[:, 3:], goal["heading"].direction)
    velocity = rotations.rotate(
        rotations.conjugate(base_quaternion), approach.speed[:, None] * along
    )
    return ResetState(
        object_index=objects,
        mass_scale=mass_scale,
        friction=friction,
        gain_scale=gain_scale,
        base_position=base_position,
        base_quaternion=base_quaternion,
        u_velocity=jnp.pad(velocity, ((0, 0), (0, 3))),
        q=q,
        object_position=rest[:, :3],
        object_quaternion=rest[:, 3:],
        stationary=stationary,
    )


def initial_hand(
    hand: Hand,
    task: TaskConfig,
    goal: Goal,
    surface: Surface,
    rest: Array,
    approach: Approach | None = None,
) -> tuple[Array, Array, Array]:
    """Initial finger angles (B, F) and world wrist poses (B, 3), (B, 4), determined by the
    constraints.

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
        q = preshape(hand, local_width(heading, surface.points)[:, 0], approach.margin)
    for constraint in known(task):
        if (fingers := constraint.initial_fingers(goal)) is not None:
            q = jnp.where(fingers[0][:, None], fingers[1], q)
    position, quaternion = jnp.zeros_like(rest[:, :3]), jnp.zeros_like(rest[:, 3:])
    for constraint in known(task):
        if (wrist := constraint.initial_wrist(hand, approach.back_off, goal, q)) is not None:
            where = wrist[0][:, None]
            position, quaternion = (
                jnp.where(where, wrist[1], position),
                jnp.where(where, wrist[2], quaternion),
            )
    position, quaternion = rotations.compose_pose(rest[:, :3], rest[:, 3:], position, quaternion)
    return (
        q,
        position.at[:, 2].add(
            jnp.maximum(_CLEARANCE - _lowest(hand, q, position, quaternion), 0.0)
        ),
        quaternion,
    )


def _lowest(hand: Hand, q: Array, position: Array, quaternion: Array) -> Array:
    """Height (B,) in m over the table of the lowest point of hands at wrist poses (B, 3), (B, 4),
    world frame.
    """
    ends = kinematics.capsules(hand, kinematics.link_transforms(hand, q)).reshape(len(q), -1, 3)
    height = jnp.sum(rotations.to_matrix(quaternion)[:, None, 2] * ends, -1) + position[:, 2:]
    return jnp.min(height - np.repeat(hand.capsule_radii, 2), -1)
