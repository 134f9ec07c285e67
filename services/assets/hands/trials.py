"""Trials of a hand without a policy: steps of its motors, closing in free air, and grips.

In free air, motors follow steps of their targets, and the empty hand closes. In a grip, a hand
closes around a ball, a cylinder or a box and lifts it, and the object is then pushed.

The hand is above: its heading axis points down, and the object is in the grasp frame, with the
length of cylinder and box across the closing plane of the fingers. Each object is tried in parallel
at several positions along the heading axis and with several forces. It is fixed until the fingers
have closed and then released, without a table. The lift and the pushes are those of
`actors.stress`.
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors import stress as protocols
from congrasp.actors.physics.engine import PhysicsState, ResetState
from congrasp.actors.physics.native import NativePhysics
from congrasp.common import rotations
from congrasp.common.hands.kinematics import grasp_frame, link_transforms
from congrasp.common.hands.motors import motor_limits, motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.families import draft
from congrasp.common.objects.procedural import plain_object
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task import plausibility
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.types import Array

OBJECTS = ("ball", "cylinder", "box")
SIZES = (0.4, 0.3)
"""Widths of the objects as shares of the hand's opening; cylinder and box are twice as long as
wide.
"""
DENSITY = 650.0
"""Density of the objects, the median of procedural ones, kg/m^3."""
_DEPTHS = (0.0, 0.5, 1.0)
"""Distances of the object from the hand centre towards the palm, in half widths."""
_FIRMNESS = (0.3, 0.8)
"""Shares of the torque limits with which fingers press."""
_SPEED = 0.06
"""Greatest closing speed of motors, rad per control step."""
_CLOSING_STEPS = 100
"""Control steps in which the hand closes."""
_HOLD_STEPS = 50
"""Control steps without support before the lift."""
STEP = 0.1
"""Step of a target in a control step, rad."""
_RESPONSE_STEPS = 60
"""Control steps of a response, and of the empty hand's closing."""
_SETTLED_STEPS = 10
"""Last control steps, in which a joint should be at rest."""
_OUT_OF_REACH = (0.0, 0.0, -5.0)
"""Position of the scene's object for a hand in free air, m."""
_ANY_WIDTH = 0.04
"""Width of that object, m."""


class Grip(NamedTuple):
    """Result of the best attempt at an object."""

    obj: GraspObject
    width: float
    """m."""
    held: bool
    """Held half a second after the release."""
    survived: dict[str, bool]
    """Survived parts, by the names of `actors.stress.SURVIVAL`."""
    touching: np.ndarray
    """(L,) bool, links in contact half a second after the release."""
    q: np.ndarray
    """(F,) finger angles at that time, rad."""
    object_position: np.ndarray
    """(3,) position of the object at that time, wrist frame, m."""
    object_quaternion: np.ndarray
    """(4,) object frame to wrist frame."""

    @property
    def rank(self) -> tuple[int, ...]:
        """Rank of the attempt."""
        return (self.held, *map(int, self.survived.values()), int(self.touching.sum()))


class Response(NamedTuple):
    """Response of a motor to a step of its target."""

    overshoot: float
    """Overshoot as a share of the step."""
    unrest: float
    """Standard deviation of the motor's speed in the last tenth of a second, rad/s; zero for a slow
    one.
    """
    error: float
    """Final distance from the target, as a share of the step."""
    diverged: bool
    """True if the simulation diverged."""


def grip_objects(width: float) -> list[GraspObject]:
    """Returns a ball, a cylinder and a box of a width in metres; their length is along y."""
    half = width / 2
    pieces = (
        draft.ellipsoid((half, half, half)),
        draft.cylinder((0, -width, 0), (0, width, 0), half),
        draft.box((half, width, half)),
    )
    return [
        plain_object(name, (piece,), DENSITY) for name, piece in zip(OBJECTS, pieces, strict=True)
    ]


def grips(hand: Hand, task: TaskConfig, threads: int) -> list[Grip]:
    """Returns the best attempt at each of `OBJECTS`.

    Smaller objects are tried unless the hand survives all parts with all of the larger ones.

    Args:
      hand: the hand.
      task: the task, for its physics: time step, contacts, collisions.
      threads: threads of the physics.
    """
    best: dict[str, Grip] = {}
    for share in SIZES:
        width = share * grasp_frame(hand).opening
        for grip in _attempts(hand, task, width, threads):
            name = grip.obj.name
            if name not in best or grip.rank > best[name].rank:
                best[name] = grip
        if all(all(grip.survived.values()) for grip in best.values()):
            break
    return [best[name] for name in OBJECTS]


def responses(hand: Hand, task: TaskConfig, threads: int) -> list[Response]:
    """Returns the responses (M) of the motors to steps, in turn.

    A step is `STEP` or half of the range, from the open pose towards the side with more room. The
    other motors stay, and links do not collide.
    """
    task = dataclasses.replace(task, hand_self_collision=False, hand_table_collision=False)
    lower, upper = motor_limits(hand)
    opened = motor_positions(hand, hand.q_open)
    size = np.minimum(STEP, (upper - lower) / 2)
    steps = np.where(upper - opened >= opened - lower, size, -size)
    targets = np.tile(opened + np.diag(steps), (_RESPONSE_STEPS, 1, 1))
    states = _states(hand, task, targets, threads)
    motors = np.arange(len(hand.motors))
    moved = motor_positions(hand, states.q)[:, motors, motors] - opened
    shares = moved / steps  # (T, M)
    speeds = motor_positions(hand, states.q_velocity)[-_SETTLED_STEPS:, motors, motors]
    return [
        Response(
            overshoot=float(max(shares[:, motor].max() - 1, 0.0)),
            unrest=float(speeds[:, motor].std()),
            error=float(abs(shares[-1, motor] - 1)),
            diverged=bool(states.diverged[:, motor].any()),
        )
        for motor in motors
    ]


def closed_overlap(hand: Hand, task: TaskConfig, threads: int) -> float:
    """Returns the greatest overlap of links after the empty hand has closed, m.

    It closes as far as its contacts allow.
    """
    steps = np.arange(1, 2 * _RESPONSE_STEPS + 1)
    share = np.minimum(steps / _RESPONSE_STEPS, 1.0)[:, None, None]
    opened = motor_positions(hand, hand.q_open)
    closed = motor_positions(hand, hand.q_closed)
    states = _states(hand, task, opened + share * (closed - opened), threads)
    return float(_overlap(hand, states.q[-1].astype(np.float32))[0])


def _attempts(hand: Hand, task: TaskConfig, width: float, threads: int) -> list[Grip]:
    """Runs all attempts at objects of one width, m."""
    objects = grip_objects(width)
    attempts = list(itertools.product(range(len(objects)), _DEPTHS, _FIRMNESS))
    index, depths, firmness = (np.array(column) for column in zip(*attempts, strict=True))
    physics = NativePhysics(hand, task, objects, threads)
    try:
        start = _start(hand, index, depths * width / 2)
        target = _close(physics, hand, start, firmness)
        states = _shake(physics, hand, task, start, target, objects)
    finally:
        physics.close()
    return _results(task, start, states, objects, width)


def _start(hand: Hand, index: np.ndarray, depth: np.ndarray) -> ResetState:
    """Open hands above objects fixed at the origin of the world frame.

    Args:
      hand: the hand.
      index: (B,) objects.
      depth: (B,) distances of the objects from the hand centre towards the palm, m.
    """
    frame = grasp_frame(hand)
    count = len(index)
    to_world = np.stack([frame.cross, np.cross(frame.cross, frame.heading), -frame.heading])
    ones = np.ones(count)
    orientation = np.asarray(rotations.from_matrix(jnp.asarray(to_world)))
    object_position = frame.center - depth[:, None] * frame.heading
    return ResetState(
        object_index=index,
        mass_scale=ones,
        friction=ones,
        gain_scale=ones,
        base_position=-object_position @ to_world.T,
        base_quaternion=np.tile(orientation, (count, 1)),
        u_velocity=np.zeros((count, 6)),
        q=np.tile(hand.q_open, (count, 1)),
        object_position=np.zeros((count, 3)),
        object_quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        stationary=ones > 0,
    )


def _close(
    physics: NativePhysics, hand: Hand, start: ResetState, firmness: np.ndarray
) -> np.ndarray:
    """Closes the fingers around the fixed object, which is then released.

    Args:
      physics: the physics.
      hand: the hand.
      start: B open hands.
      firmness: (B,) shares of the torque limits.

    Returns:
      (B, M) motor targets.
    """
    physics.start(start)
    full_torque_errors = np.array([motor.torque_limit / motor.kp for motor in hand.motors])
    reach = firmness[:, None] * full_torque_errors
    positions = motor_positions(hand, np.asarray(start.q))
    target = positions
    goal = motor_positions(hand, hand.q_closed)
    wrist = np.zeros((len(positions), 6))
    ended = np.zeros(len(positions), bool)
    for _ in range(_CLOSING_STEPS):
        target = target + np.clip(goal - target, -_SPEED, _SPEED)
        target = np.clip(target, positions - reach, positions + reach)
        _, state = physics.step(physics, np.concatenate([wrist, target], -1), ended)
        positions = motor_positions(hand, np.asarray(state.q))
    for instance in physics.instances:
        instance.data.eq_active[instance.model.equality("hold").id] = False
    return target


def _shake(
    physics: NativePhysics,
    hand: Hand,
    task: TaskConfig,
    start: ResetState,
    target: np.ndarray,
    objects: Sequence[GraspObject],
) -> PhysicsState:
    """Simulates half a second without support, the lift, and the pushes.

    Args:
      physics: the physics.
      hand: the hand.
      task: the task.
      start: the B open hands of the attempts.
      target: (B, M) motor targets of the closed hands.
      objects: the objects.

    Returns:
      The states, with a leading axis T.
    """
    task = dataclasses.replace(task, approach_steps=0)
    protocol = protocols.stress(task, objects, _HOLD_STEPS)
    time = np.arange(_HOLD_STEPS + protocols.stress_steps(task))
    base = np.tile(np.asarray(start.base_quaternion, np.float32)[:1], (len(time), 1))
    wrists, pushes = _disturbances(hand, task, len(objects), protocol, time, base)
    attempt_pushes = np.asarray(pushes)[:, start.object_index]
    ended = np.zeros(len(target), bool)
    states = []
    for wrist, forces in zip(np.asarray(wrists), attempt_pushes, strict=True):
        command = np.concatenate([np.tile(wrist, (len(target), 1)), target], -1)
        _, state = physics.step(physics, command, ended, forces)
        states.append(jax.tree.map(np.asarray, state))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *states)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _disturbances(
    hand: Hand, task: TaskConfig, count: int, protocol: protocols.Protocol, time: Array, base: Array
) -> tuple[Array, Array]:
    """Targets (T, 6) of a carried wrist, and pushes (T, N, 3) of N objects, N.

    Args:
      hand: the hand.
      task: the task.
      count: number N of objects.
      protocol: times of lift and pushes.
      time: (T,) control steps.
      base: (T, 4) orientations of the wrist's base.
    """
    frame = protocols.frame(protocol, task, time + 0.5)
    wrist = protocols.targets_to_world_frame(jnp.zeros((len(time), 6)), hand, base, frame)
    everywhere = jnp.ones(len(time))
    pushes = []
    for n in range(count):
        index = jnp.full(len(time), n)
        pushes.append(protocols.push(protocol, task, time, index, everywhere))
    return wrist, jnp.stack(pushes, 1)


@jax.jit
def _in_wrist_frame(start: ResetState, states: PhysicsState) -> tuple[Array, Array]:
    """Positions (T, B, 3) and orientations (T, B, 4) of the objects in the wrist frame."""
    wrist = rotations.compose_pose(
        start.base_position,
        start.base_quaternion,
        states.u[..., :3],
        rotations.euler_to_quaternion(states.u[..., 3:]),
    )
    return rotations.relative_pose(*wrist, states.object_position, states.object_quaternion)


def _results(
    task: TaskConfig,
    start: ResetState,
    states: PhysicsState,
    objects: Sequence[GraspObject],
    width: float,
) -> list[Grip]:
    """Results of the attempts at objects of a width, m."""
    positions, quaternions = map(np.asarray, _in_wrist_frame(start, states))
    last_hold = _HOLD_STEPS - 1
    # It was released at the origin
    moved = np.linalg.norm(states.object_position[last_hold], axis=-1)
    held = (moved < protocols.MAX_SHIFT_M) & ~states.diverged.any(0)
    survived = protocols.survival(positions[last_hold:], quaternions[last_hold:], held, task)
    touching = states.contact_found[last_hold].any(-1)
    results = []
    for i, index in enumerate(np.asarray(start.object_index)):
        results.append(
            Grip(
                obj=objects[index],
                width=width,
                held=bool(held[i]),
                survived={name: bool(attempts[i]) for name, attempts in survived.items()},
                touching=touching[i],
                q=states.q[last_hold, i],
                object_position=positions[last_hold, i],
                object_quaternion=quaternions[last_hold, i],
            )
        )
    return results


@functools.partial(jax.jit, static_argnums=0)
def _overlap(hand: Hand, q: Array) -> Array:
    """Greatest overlap (B,) in m of two links at finger angles (B, F), compiled as one program."""
    return plausibility.hand_hand(hand, link_transforms(hand, q))


def _states(hand: Hand, task: TaskConfig, targets: np.ndarray, threads: int) -> PhysicsState:
    """States, with leading axis T, for motor targets (T, B, M) from the open pose on."""
    count = targets.shape[1]
    start = _start(hand, np.zeros(count, int), np.zeros(count))
    start = start._replace(object_position=np.tile(_OUT_OF_REACH, (count, 1)))
    physics = NativePhysics(hand, task, grip_objects(_ANY_WIDTH)[:1], threads)
    wrist = np.zeros((count, 6))
    ended = np.zeros(count, bool)
    states = []
    try:
        physics.start(start)
        for target in targets:
            _, state = physics.step(physics, np.concatenate([wrist, target], -1), ended)
            states.append(jax.tree.map(np.asarray, state))
    finally:
        physics.close()
    return jax.tree.map(lambda *leaves: np.stack(leaves), *states)
