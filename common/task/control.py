"""Decodes actions to joint targets: incremental fingers and guided wrist (paper, section Control
Space).
"""

from typing import NamedTuple

import jax.numpy as jnp

from congrasp.common.hands.motors import joint_positions, motor_limits, motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints import known
from congrasp.common.task.geometry import wrist_to_joints
from congrasp.common.task.scene import Scene
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.traced_settings import ControlConfig
from congrasp.common.task.types import Action, Array, SceneState


def guidance_pose(scene: Scene, control: ControlConfig) -> tuple[Array, Array]:
    """World wrist pose T^g (B, 3), (B, 4) of the strongest active wrist constraint."""
    pose: tuple[Array, Array] | None = None
    for constraint in known(scene.task):
        if not constraint.guides:
            continue
        position, quaternion = constraint.guidance(scene, current=control.follow_object)
        if pose is None:
            pose = position, quaternion
            continue
        weaker_position, weaker_quaternion = pose
        active = scene.goal.active[constraint.guides][:, None]
        pose = (
            jnp.where(active, position, weaker_position),
            jnp.where(active, quaternion, weaker_quaternion),
        )
    assert pose is not None, "the heading guides if nothing else does"
    return pose


def decode(scene: Scene, control: ControlConfig, action: Array) -> Action:
    """Returns joint targets for a residual action (B, M + 6) of the M finger motors and the wrist.

    Motors: m_tgt = clamp(m_tgt_prev + alpha_f a_f, limits), which gives q_tgt of the joints. Wrist:
    u_tgt = u_g + alpha_w a_w, moved closer to the wrist if it would exceed the limits of speed or
    acceleration (`_lead`). After the table is removed, u_tgt also compensates the load
    (`wrist_load`), and the limits apply relative to that.
    """
    hand = scene.hand
    state = scene.state
    count = len(hand.motors)
    motors = motor_positions(hand, state.q_target) + control.finger_scale * action[..., :count]
    if control.finger_guidance:
        motors += _finger_guidance(scene, control.finger_guidance)
    q_target = joint_positions(hand, jnp.clip(motors, *motor_limits(hand)))
    lead = wrist_lead(hand, control, guided(scene, control), action[..., count:])
    return Action(q_target, state.u + lead + carried_lead(hand, state))


def _position_limit(scene: Scene, control: ControlConfig) -> Array:
    """Greatest distance (B,) of the wrist's target from the wrist, m.

    The limit is `guidance_position_limit`. While the table is present it is lower near the object,
    so that the hand arrives slowly: it rises from `closing_position_limit` at `closing_distance`
    from the object to `approach_position_limit` at twice that.
    """
    gap = jnp.min(jnp.linalg.norm(scene.features.nearest, axis=-1), -1)
    slow = control.closing_position_limit
    fast = control.approach_position_limit
    share = jnp.clip(gap / control.closing_distance - 1.0, 0.0, 1.0)
    approach_limit = slow + share * (fast - slow)
    return jnp.where(scene.state.table, approach_limit, control.guidance_position_limit)


class Guided(NamedTuple):
    """Guidance and state of the wrist, from which its target follows together with the action."""

    ahead: Array
    """(..., 6) displacement from the wrist to its guidance, m and rad."""
    limit: Array
    """(...,) greatest distance of the target from the wrist, m."""
    velocity: Array
    """(..., 6) speeds of the wrist joints, m/s and rad/s."""
    table: Array
    """(...,) bool: the table is present."""

    def bounded(self, control: ControlConfig) -> Array:
        """Returns the lead (..., 6) of the guidance alone, before the limits of acceleration."""
        slides = _limit(self.ahead[..., :3], self.limit[..., None])
        hinges = _limit(self.ahead[..., 3:], control.guidance_rotation_limit)
        return jnp.concatenate([slides, hinges], -1)


def guided(scene: Scene, control: ControlConfig) -> Guided:
    """Returns the guidance of the wrist in a scene."""
    state = scene.state
    ahead = wrist_to_joints(state, *guidance_pose(scene, control)) - state.u
    return Guided(ahead, _position_limit(scene, control), state.u_velocity, state.table)


def wrist_lead(hand: Hand, control: ControlConfig, wrist: Guided, residual: Array) -> Array:
    """Returns u_tgt - u (..., 6) without the part that carries the load, see `decode`.

    Args:
      hand: the hand, for its servos.
      control: limits and scales.
      wrist: guidance and state of the wrist.
      residual: (..., 6) wrist part of the action.
    """
    slide_stiffness, slide_damping = hand.wrist_servos[:, 0]
    hinge_stiffness, hinge_damping = hand.wrist_servos[:, 3]
    slide_servo = _Servo(
        stiffness=slide_stiffness,
        damping=slide_damping,
        max_lead=wrist.limit[..., None],
        max_acceleration=control.wrist_acceleration,
    )
    hinge_servo = _Servo(
        stiffness=hinge_stiffness,
        damping=hinge_damping,
        max_lead=control.guidance_rotation_limit,
        max_acceleration=control.wrist_angular_acceleration,
    )
    share = jnp.where(wrist.table, 1.0, control.hold_acceleration)
    slides = _lead(
        slide_servo,
        wrist.ahead[..., :3],
        control.wrist_position_scale * residual[..., :3],
        wrist.velocity[..., :3],
        share,
    )
    hinges = _lead(
        hinge_servo,
        wrist.ahead[..., 3:6],
        control.wrist_rotation_scale * residual[..., 3:6],
        wrist.velocity[..., 3:6],
        share,
    )
    return jnp.concatenate([slides, hinges], -1)


def carried_lead(hand: Hand, state: SceneState) -> Array:
    """Lead (B, 6) of the wrist's target with which the servos carry the load, m and rad.

    It is zero until the table is removed.
    """
    stiffness, _ = hand.wrist_servos
    return jnp.where(state.table[..., None], 0.0, -state.wrist_load / stiffness)


def track_load(
    hand: Hand, task: TaskSettings, momentum: Array, u: Array, u_velocity: Array, u_target: Array
) -> Array:
    """Updates the load observer's momentum z (B, 6) after a control step, m/s and rad/s; initially
    zero.

    With w = v + damping u, the servos' law is dw/dt = stiffness (u_tgt - u) + d, where d is the
    acceleration of the wrist by everything else. The observer integrates dz/dt = stiffness (u_tgt -
    u) + rate (w - z), so that rate (w - z) is d after a low-pass filter of time constant 1 / rate
    (De Luca and Mattone 2003, doi 10.1109/ROBOT.2003.1241662). In discrete time the servos act on
    the mean of u over the step (trapezoidal rule), which only changes w (`_generalised_speed`).

    Args:
      hand: the hand, for its servos.
      task: the task, for the length of a control step and the rate.
      momentum: (B, 6) z before the step.
      u: (B, 6) wrist joints after the step.
      u_velocity: (B, 6).
      u_target: (B, 6) the step's targets.
    """
    stiffness, _ = hand.wrist_servos
    decay = task.control_dt * task.control.load_rate
    speed = _generalised_speed(hand, task, u, u_velocity)
    gained = task.control_dt * stiffness * (u_target - u) + decay * speed
    return (momentum + gained) / (1.0 + decay)


def wrist_load(
    hand: Hand, task: TaskSettings, momentum: Array, u: Array, u_velocity: Array
) -> Array:
    """Acceleration d (B, 6) of the wrist by everything but its servos, m/s^2 and rad/s^2; see
    `track_load`.
    """
    return task.control.load_rate * (_generalised_speed(hand, task, u, u_velocity) - momentum)


def _generalised_speed(hand: Hand, task: TaskSettings, u: Array, u_velocity: Array) -> Array:
    """Speed w (B, 6) of `track_load`: with steps of dt, v + (damping - stiffness dt / 2) u."""
    stiffness, damping = hand.wrist_servos
    return u_velocity + (damping - 0.5 * task.control_dt * stiffness) * u


class _Servo(NamedTuple):
    """Servos of three wrist joints: a = stiffness (target - u) - damping v."""

    stiffness: Array | float
    """kp / m, 1/s^2."""
    damping: Array | float
    """kv / m, 1/s."""
    max_lead: Array | float
    """Greatest lead (..., 1) of the target over the joint, m or rad."""
    max_acceleration: float
    """Greatest acceleration, m/s^2 or rad/s^2; 0 for no limit."""


def _lead(servo: _Servo, ahead: Array, residual: Array, velocity: Array, share: Array) -> Array:
    """Lead (..., 3) of the target over three wrist joints.

    A target that leads by damping v / stiffness keeps a joint's speed; one r from there accelerates
    it by stiffness r. Braking along the guidance may use v stiffness / damping, however small the
    share is.

    Args:
      servo: servos of the joints.
      ahead: (..., 3) displacement from the joints to the guidance.
      residual: (..., 3) displacement added by the action.
      velocity: (..., 3) speeds of the joints.
      share: (...,) share of the greatest acceleration, except for braking.
    """
    rate = servo.stiffness / servo.damping
    max_acceleration = jnp.asarray(servo.max_acceleration)
    steady = velocity / rate
    slowing = rate * jnp.linalg.norm(velocity, axis=-1)
    acceleration = jnp.clip(slowing, share * max_acceleration, max_acceleration)
    max_change = acceleration[..., None] / servo.stiffness
    target = _limit(_limit(ahead, servo.max_lead) + residual, servo.max_lead)
    limited = jnp.where(max_acceleration > 0, max_change, jnp.inf)
    return steady + _limit(target - steady, limited)


def _finger_guidance(scene: Scene, rate: float) -> Array:
    """(B, M) rad by which motors move towards the closed hand, at most `rate`, from the middle of
    the approach on.
    """
    closing = 2.0 * scene.state.time >= scene.task.approach_steps
    ahead = motor_positions(scene.hand, jnp.array(scene.hand.q_closed) - scene.state.q_target)
    return closing[:, None] * jnp.clip(ahead, -rate, rate)


def _limit(vector: Array, length: Array | float) -> Array:
    """Vectors (..., 3) scaled down to a norm of at most `length`."""
    norm = jnp.sqrt(jnp.sum(vector**2, -1, keepdims=True) + 1e-12)
    return vector * jnp.minimum(1.0, length / norm)
