"""Stress test of a grasp after the table is removed: the hand is lifted, and the object is pushed.

The lift is a moving frame: the policy observes hand and object relative to it, so that features and
goals are independent of the lift, and the wrist's joint targets include the motion of the frame.
Pushes are forces on the object. Both depend on the control steps since the table's removal; the
episode is otherwise unchanged.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors.physics.engine import PhysicsState
from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task import plausibility
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.plausibility import Sample
from congrasp.common.task.settings import GRAVITY
from congrasp.common.task.types import Array

LIFT_HEIGHT_M = 0.15
"""Height of the lift."""
LIFT_SPEED_M_S = 0.3
"""Largest speed of the lift."""
LIFT_ACCELERATION_M_S2 = 3.0
"""Acceleration of the lift."""
PUSH_S = 0.25
"""Duration of each push."""
PUSH_FORCE_N = 1.0
"""Force of the second six pushes; that of the first six is half of the object's weight."""
MAX_SHIFT_M = 0.05
"""Largest displacement of the object in the wrist frame for survival (as in DexGraspBench)."""
MAX_TURN_RAD = float(np.radians(15.0))
"""Largest rotation of the object in the wrist frame for survival (likewise)."""
SURVIVAL_NAMES = ("lift_survival", "push_survival_weight", "push_survival")
"""Names of the survived parts."""
ASSESSED_NAMES = (*plausibility.MEASURES, "clean", *SURVIVAL_NAMES)
"""Names of all results of `assess`."""
_REST_AFTER_LIFT_S = 0.1
"""Time until the hand is at rest after the lift."""
_DIRECTIONS = np.concatenate([np.stack([axis, -axis]) for axis in np.eye(3, dtype=np.float32)])


class Protocol(NamedTuple):
    """A lift, then six pushes with half of the object's weight and six with 1 N; times count from
    the table's removal.

    The pushes are those of DexGraspBench (along each axis of the world frame, in both directions),
    but they follow one another in the same grasp, last 0.25 s instead of 2 s, and act in addition
    to gravity. Its force, 10 m/s^2 times the mass, is 1 N for its objects of 100 g.
    """

    lift_start: Array
    """() start of the lift, control steps."""
    lift_height: Array
    """() m."""
    push_start: Array
    """() start of the pushes, control steps."""
    masses: Array
    """(N,) masses of the engine's objects, kg."""
    table: Array | bool = False
    """() bool: the table stays. The policy observes it as removed, which signals the lift."""


class Frame(NamedTuple):
    """Height and motion of the carried frame relative to the world frame, in B environments."""

    height: Array
    """(B,) m."""
    speed: Array
    """(B,) m/s."""
    acceleration: Array
    """(B,) m/s^2."""


def stress(
    task: TaskConfig, objects: Sequence[GraspObject], start: int, height: float = LIFT_HEIGHT_M
) -> Protocol:
    """Returns a lift by `height` metres and all pushes, starting `start` control steps after the
    table's removal.
    """
    push_start = np.float32(start + lift_steps(task, height))
    masses = np.array([obj.mass for obj in objects], np.float32)
    return Protocol(np.float32(start), np.float32(height), push_start, masses)


def lift_first(
    task: TaskConfig, objects: Sequence[GraspObject], hold: int, height: float
) -> Protocol:
    """Returns a lift by `height` metres off the table, which stays, instead of its removal; all
    pushes after `hold`.
    """
    protocol = stress(task, objects, hold, 0.0)
    return protocol._replace(lift_start=np.float32(0), lift_height=np.float32(height), table=True)


def lift_steps(task: TaskConfig, height: float = LIFT_HEIGHT_M) -> int:
    """Control steps of a lift, including the time until the hand is at rest; 0 without a height."""
    if not height:
        return 0
    seconds = height / LIFT_SPEED_M_S + LIFT_SPEED_M_S / LIFT_ACCELERATION_M_S2 + _REST_AFTER_LIFT_S
    return math.ceil(round(seconds / task.control_dt, 6))


def push_steps(task: TaskConfig) -> int:
    """Control steps of one push."""
    return round(PUSH_S / task.control_dt)


def stress_steps(task: TaskConfig, height: float = LIFT_HEIGHT_M) -> int:
    """Control steps of `stress`."""
    return lift_steps(task, height) + 2 * len(_DIRECTIONS) * push_steps(task)


def frame(protocol: Protocol, task: TaskConfig, time: Array) -> Frame:
    """Carried frame `time` (B,) control steps into the episode.

    Its acceleration is at most `LIFT_ACCELERATION_M_S2` and its speed at most `LIFT_SPEED_M_S`: a
    ramp minus the same ramp delayed by height / speed.
    """
    since = (time - task.approach_steps - protocol.lift_start) * task.control_dt
    rise = LIFT_SPEED_M_S / LIFT_ACCELERATION_M_S2

    def ramp(seconds: Array) -> Frame:
        """Frame that accelerates to `LIFT_SPEED_M_S` and continues."""
        speeding = jnp.clip(seconds, 0.0, rise)
        way = 0.5 * LIFT_ACCELERATION_M_S2 * speeding**2 + LIFT_SPEED_M_S * jnp.maximum(
            seconds - rise, 0.0
        )
        speeds_up = (seconds > 0.0) & (seconds < rise)
        # Zeros of this type, or the frame's weak type would compile every program of an episode
        # again.
        pull = jnp.where(speeds_up, LIFT_ACCELERATION_M_S2, jnp.zeros_like(seconds))
        return Frame(way, LIFT_ACCELERATION_M_S2 * speeding, pull)

    ramped = ramp(since)
    delayed = ramp(since - protocol.lift_height / LIFT_SPEED_M_S)
    return Frame(
        height=ramped.height - delayed.height,
        speed=ramped.speed - delayed.speed,
        acceleration=ramped.acceleration - delayed.acceleration,
    )


def push(
    protocol: Protocol, task: TaskConfig, time: Array, index: Array, mass_scale: Array
) -> Array:
    """Force (B, 3) on the objects in the control step that begins `time` (B,) steps into the
    episode, world frame, N.

    Args:
      protocol: times of the pushes.
      task: the task, for the length of a control step.
      time: (B,) control steps since the start of the episode.
      index: (B,) int, indices of the objects.
      mass_scale: (B,) factors on their masses.
    """
    since = time - task.approach_steps - protocol.push_start
    number = jnp.floor(since / push_steps(task)).astype(jnp.int32)
    weight = GRAVITY * jnp.asarray(protocol.masses)[index] * mass_scale
    newtons = jnp.where(number < len(_DIRECTIONS), 0.5 * weight, PUSH_FORCE_N)
    newtons = jnp.where((number >= 0) & (number < 2 * len(_DIRECTIONS)), newtons, 0.0)
    return newtons[:, None] * jnp.asarray(_DIRECTIONS)[number % len(_DIRECTIONS)]


def to_carried_frame(state: PhysicsState, base_quaternion: Array, frame: Frame) -> PhysicsState:
    """Transforms hand and object to the carried frame.

    Args:
      state: state in the world frame.
      base_quaternion: (B, 4) orientation of the wrist's base, along whose axes the slides move.
      frame: the carried frame.
    """
    way = up(frame.height)
    speed = up(frame.speed)
    return state._replace(
        u=state.u - slides(base_quaternion, frame.height),
        u_velocity=state.u_velocity - slides(base_quaternion, frame.speed),
        object_position=state.object_position - way,
        object_velocity=state.object_velocity - speed,
        contact_position=state.contact_position - way[:, None, None],
    )


def targets_to_world_frame(
    u_target: Array, hand: Hand, base_quaternion: Array, frame: Frame
) -> Array:
    """Transforms wrist targets (B, 6) from the carried frame to the world frame, at the middle of a
    control step.

    They lead to compensate for the servo's damping of the frame's speed, and for the hand's
    inertia.
    """
    gains = hand.wrist
    lead = (
        gains.slide_kv * frame.speed + hand.wrist_inertia[0] * frame.acceleration
    ) / gains.slide_kp
    return u_target + slides(base_quaternion, frame.height + lead)


def slides(base_quaternion: Array, height: Array) -> Array:
    """Wrist joints (B, 6) of a rise by `height` (B,)."""
    return jnp.pad(
        rotations.rotate(rotations.conjugate(base_quaternion), up(height)), ((0, 0), (0, 3))
    )


def up(length: Array) -> Array:
    """Upward vectors (B, 3) of these lengths (B,)."""
    return jnp.pad(length[:, None], ((0, 0), (2, 0)))


def assess(
    samples: Sample, held: np.ndarray, task: TaskConfig, hold: int, height: float = LIFT_HEIGHT_M
) -> dict[str, np.ndarray]:
    """Measures (B,) of episodes and the survival of their grasps.

    Args:
      samples: samples of the approach, the hold and, if simulated, `stress`; NumPy arrays (T, B,
        ...).
      held: (B,) bool, True if the object was held until the end of the hold.
      task: the task.
      hold: control steps without the table.
      height: height of the lift, m.

    Returns:
      Those of `common.task.plausibility.measures` up to the end of the hold; `clean`, 0 or 1, which
      is defined for a hold of two seconds; and those of `survival`, NaN without `stress`.
    """
    end = task.approach_steps + hold
    until_end = jax.tree.map(lambda array: array[:end], samples)
    after = jax.tree.map(lambda array: array[end - 1 :], samples)
    measures = plausibility.measures(until_end, task.control_dt)
    survived = survival(after.object_position, after.object_quaternion, held, task, height)
    results = {**measures, "clean": plausibility.is_clean(held, measures), **survived}
    return {name: np.asarray(value, np.float32) for name, value in results.items()}


def survival(
    object_position: np.ndarray,
    object_quaternion: np.ndarray,
    held: np.ndarray,
    task: TaskConfig,
    height: float = LIFT_HEIGHT_M,
) -> dict[str, np.ndarray]:
    """Survival of the parts of `stress`: (B,) 1 or 0 each, NaN if it was not simulated.

    Every control step counts, and each part is relative to the object's pose at its beginning; an
    object lost in one part is lost in the following ones.

    Args:
      object_position: (1 + T, B, 3) in the wrist frame, m, after the last control step of the hold
        and after the `stress_steps` that follow it.
      object_quaternion: (1 + T, B, 4) object frame to wrist frame.
      held: (B,) bool, True if the object was held until then.
      task: the task, for the length of a control step.
      height: height of the lift, m.

    Returns:
      `lift_survival`, `push_survival_weight` (six pushes with half of the object's weight), and
      `push_survival` (these and six with 1 N).
    """
    six = len(_DIRECTIONS) * push_steps(task)
    ends = np.cumsum([0, lift_steps(task, height), six, six])
    is_simulated = len(object_position) > ends[-1]
    survived = np.asarray(held, bool)
    results = {}
    for name, (first, last) in zip(SURVIVAL_NAMES, itertools.pairwise(ends), strict=True):
        position = object_position[first : last + 1]
        quaternion = object_quaternion[first : last + 1]
        way = np.linalg.norm(position - position[:1], axis=-1)
        cosine = np.minimum(np.abs((quaternion * quaternion[:1]).sum(-1)), 1.0)
        turn = 2 * np.arccos(cosine)
        survived = survived & ((way < MAX_SHIFT_M) & (turn < MAX_TURN_RAD)).all(0)
        results[name] = (1.0 if is_simulated else np.nan) * survived
    return results
