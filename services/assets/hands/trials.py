"""Trials of a hand without a policy: motors follow a step, the empty hand closes, objects are
gripped, lifted, pushed.

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
_PLACES = (0.0, 0.5, 1.0)
"""Distances of the object from the hand centre towards the palm, in half widths."""
_FIRMNESS = (0.3, 0.8)
"""Shares of the torque limits with which fingers press."""
_SPEED = 0.06
"""Greatest closing speed of motors, rad per control step."""
_CLOSE, _HOLD = 100, 50
"""Durations in control steps."""


STEP = 0.1
"""Step of a target in a control step, rad."""
_STEPS = 60
_SETTLED = 10  # last control steps, in which a joint should be at rest
_FAR = (0.0, 0.0, -5.0)  # distance at which the scene's object is out of reach, m


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
    """Returns the best attempt at each of `OBJECTS`, of the larger size, and of the smaller one
    unless all survive.

    Args:
      hand: the hand.
      task: the task, for its physics: time step, contacts, collisions.
      threads: threads of the physics.
    """
    found: dict[str, Grip] = {}
    for share in SIZES:
        for grip in _attempts(hand, task, share * grasp_frame(hand).opening, threads):
            if grip.obj.name not in found or grip.rank > found[grip.obj.name].rank:
                found[grip.obj.name] = grip
        if all(all(grip.survived.values()) for grip in found.values()):
            break
    return [found[name] for name in OBJECTS]


def _attempts(hand: Hand, task: TaskConfig, width: float, threads: int) -> list[Grip]:
    """Runs all attempts at objects of one width."""
    objects = grip_objects(width)
    tried = list(itertools.product(range(len(objects)), _PLACES, _FIRMNESS))
    index, places, firmness = (np.array(column) for column in zip(*tried, strict=True))
    physics = NativePhysics(hand, task, objects, threads)
    try:
        start = _start(hand, index, places * width / 2)
        target = _close(physics, hand, start, firmness)
        states = _shake(physics, hand, task, start, target, objects)
    finally:
        physics.close()
    return _judged(task, start, states, objects, width)


def _start(hand: Hand, index: np.ndarray, depth: np.ndarray) -> ResetState:
    """Open hands above objects fixed at the origin of the world frame, `depth` (B,) m from the hand
    centre.
    """
    frame, count = grasp_frame(hand), len(index)
    # To x, y and z
    own = np.stack([frame.cross, np.cross(frame.cross, frame.heading), -frame.heading])
    ones, turn = np.ones(count), np.asarray(rotations.from_matrix(jnp.asarray(own)))
    return ResetState(
        object_index=index,
        mass_scale=ones,
        friction=ones,
        gain_scale=ones,
        base_position=-(frame.center - depth[:, None] * frame.heading) @ own.T,
        base_quaternion=np.tile(turn, (count, 1)),
        u_velocity=np.zeros((count, 6)),
        q=np.tile(hand.q_open, (count, 1)),
        object_position=np.zeros((count, 3)),
        object_quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        stationary=ones > 0,
    )


def _close(
    physics: NativePhysics, hand: Hand, start: ResetState, firmness: np.ndarray
) -> np.ndarray:
    """Targets (B, M) of fingers closed around the fixed object, which is then released."""
    physics.start(start)
    reach = firmness[:, None] * np.array([motor.torque_limit / motor.kp for motor in hand.motors])
    q = target = motor_positions(hand, np.asarray(start.q))
    goal = motor_positions(hand, hand.q_closed)
    still, away = np.zeros((len(q), 6)), np.zeros(len(q), bool)
    for _ in range(_CLOSE):
        target = np.clip(target + np.clip(goal - target, -_SPEED, _SPEED), q - reach, q + reach)
        _, state = physics.step(physics, np.concatenate([still, target], -1), away)
        q = motor_positions(hand, np.asarray(state.q))
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
    """Simulates half a second without support, the lift, and the pushes; the states have a leading
    axis T.
    """
    task = dataclasses.replace(task, approach_steps=0)
    protocol, time = (
        protocols.stress(task, objects, _HOLD),
        np.arange(_HOLD + protocols.stress_steps(task)),
    )
    base = np.tile(np.asarray(start.base_quaternion, np.float32)[:1], (len(time), 1))
    wrist, pushes = map(np.asarray, _disturbances(hand, task, len(objects), protocol, time, base))
    states, away = [], np.zeros(len(target), bool)
    for u, force in zip(wrist, pushes[:, start.object_index], strict=True):
        _, state = physics.step(
            physics, np.concatenate([np.tile(u, (len(target), 1)), target], -1), away, force
        )
        states.append(jax.tree.map(np.asarray, state))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *states)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _disturbances(
    hand: Hand, task: TaskConfig, count: int, protocol: protocols.Protocol, time: Array, base: Array
) -> tuple[Array, Array]:
    """Targets (T, 6) of a carried wrist and pushes (T, N, 3) of N objects, in N, at control steps
    `time` (T,).

    Args:
      hand: the hand.
      task: the task.
      count: number N of objects.
      protocol: times of lift and pushes.
      time: (T,) control steps.
      base: (T, 4) orientations of the wrist's base.
    """
    frame = protocols.frame(protocol, task, time + 0.5)
    wrist = protocols.carried_targets(jnp.zeros((len(time), 6)), hand, base, frame)
    which = [jnp.full(len(time), n) for n in range(count)]
    return wrist, jnp.stack(
        [protocols.push(protocol, task, time, n, jnp.ones(len(time))) for n in which], 1
    )


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


def _judged(
    task: TaskConfig,
    start: ResetState,
    states: PhysicsState,
    objects: Sequence[GraspObject],
    width: float,
) -> list[Grip]:
    """Results of the attempts."""
    position, quaternion = map(np.asarray, _in_wrist_frame(start, states))
    last = _HOLD - 1
    moved = np.linalg.norm(states.object_position[last], axis=-1)  # it was released at the origin
    held = (moved < protocols.FARTHEST) & ~states.diverged.any(0)
    survived = protocols.survival(position[last:], quaternion[last:], held, task)
    touching = states.contact_found[last].any(-1)
    return [
        Grip(
            obj=objects[index],
            width=width,
            held=bool(held[i]),
            survived={name: bool(column[i]) for name, column in survived.items()},
            touching=touching[i],
            q=states.q[last, i],
            object_position=position[last, i],
            object_quaternion=quaternion[last, i],
        )
        for i, index in enumerate(np.asarray(start.object_index))
    ]


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


def responses(hand: Hand, task: TaskConfig, threads: int) -> list[Response]:
    """Responses (M) of the motors to steps, in turn.

    A step is `STEP` or half of the range, from the open pose towards the side with more room. The
    other motors stay, and links do not collide.
    """
    task = dataclasses.replace(task, hand_self_collision=False, hand_table_collision=False)
    (lower, upper), opened = motor_limits(hand), motor_positions(hand, hand.q_open)
    size = np.minimum(STEP, (upper - lower) / 2)
    way = np.where(upper - opened >= opened - lower, size, -size)
    states = _states(hand, task, np.tile(opened + np.diag(way), (_STEPS, 1, 1)), threads)
    each = np.arange(len(hand.motors))
    gone = (
        motor_positions(hand, states.q)[:, each, each] - opened
    ) / way  # (T, M) as shares of the step
    speed = motor_positions(hand, states.q_velocity)[-_SETTLED:, each, each]
    return [
        Response(
            float(max(gone[:, j].max() - 1, 0.0)),
            float(speed[:, j].std()),
            float(abs(gone[-1, j] - 1)),
            bool(states.diverged[:, j].any()),
        )
        for j in each
    ]


def closed_overlap(hand: Hand, task: TaskConfig, threads: int) -> float:
    """Greatest overlap in m of links after the empty hand has closed, as far as its contacts
    allow.
    """
    share = np.minimum(np.arange(1, 2 * _STEPS + 1) / _STEPS, 1.0)[:, None, None]
    opened, closed = (motor_positions(hand, q) for q in (hand.q_open, hand.q_closed))
    states = _states(hand, task, opened + share * (closed - opened), threads)
    return float(_overlap(hand, states.q[-1].astype(np.float32))[0])


@functools.partial(jax.jit, static_argnums=0)
def _overlap(hand: Hand, q: Array) -> Array:
    """Greatest overlap (B,) in m of two links at finger angles (B, F), compiled as one program."""
    return plausibility.hand_hand(hand, link_transforms(hand, q))


def _states(hand: Hand, task: TaskConfig, targets: np.ndarray, threads: int) -> PhysicsState:
    """States, with leading axis T, for motor targets (T, B, M) from the open pose on."""
    count = targets.shape[1]
    start = _start(hand, np.zeros(count, int), np.zeros(count))._replace(
        object_position=np.tile(_FAR, (count, 1))
    )
    physics, found = NativePhysics(hand, task, grip_objects(0.04)[:1], threads), []
    try:
        physics.start(start)
        for target in targets:
            command = np.concatenate([np.zeros((count, 6)), target], -1)
            _, state = physics.step(physics, command, np.zeros(count, bool))
            found.append(jax.tree.map(np.asarray, state))
    finally:
        physics.close()
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found)
