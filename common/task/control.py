"""From actions to joint targets: incremental fingers and feed-forward wrist guidance (paper, section Control Space)."""

import jax
import jax.numpy as jnp

from common.config import ControlConfig
from common.hands.motors import joint_positions, motor_limits, motor_positions
from common.task.constraints import known
from common.task.constraints.base import Scene
from common.task.geometry import wrist_to_joints
from common.task.types import Action, Array

jax.tree_util.register_dataclass(
    ControlConfig,
    data_fields=[
        "finger_scale",
        "wrist_position_scale",
        "wrist_rotation_scale",
        "guidance_position_limit",
        "guidance_rotation_limit",
        "wrist_acceleration",
        "wrist_angular_acceleration",
    ],
    meta_fields=["lookahead", "follow_object", "finger_guidance"],
)


def guidance_pose(scene: Scene, control: ControlConfig) -> tuple[Array, Array]:
    """World wrist pose T^g (B, 3), (B, 4) of the highest active wrist constraint."""
    pose: tuple[Array, Array] | None = None
    for constraint in known(scene.task):
        if not constraint.guides:
            continue
        own = constraint.guidance(scene, current=control.follow_object)
        if pose is None:
            pose = own
        else:
            active = scene.goal.active[constraint.guides][:, None]
            pose = jnp.where(active, own[0], pose[0]), jnp.where(active, own[1], pose[1])
    assert pose is not None, "the heading guides where nothing else does"
    return pose


def decode(scene: Scene, control: ControlConfig, action: Array) -> Action:
    """Joint targets of a residual action (B, M + 6), of the M finger motors and the wrist.

    m_tgt = clamp(m_tgt_prev + alpha_f a_f, limits) of the motors, which put joints at q_tgt; u_tgt = u_g + alpha_w a_w,
    nearer to the wrist where it would else become faster or be accelerated harder than the limits allow (`_lead`).
    """
    hand, state = scene.hand, scene.state
    fingers = len(hand.motors)
    motors = motor_positions(hand, state.q_target) + control.finger_scale * action[..., :fingers]
    if control.finger_guidance:
        motors += _finger_guidance(scene, control.finger_guidance)
    q_target = joint_positions(hand, jnp.clip(motors, *motor_limits(hand)))
    ahead = wrist_to_joints(state, *guidance_pose(scene, control)) - state.u
    gains, (mass, inertia) = hand.wrist, hand.wrist_inertia
    slides = _lead(
        ahead[..., :3],
        control.wrist_position_scale * action[..., fingers : fingers + 3],
        state.u_velocity[..., :3] * (gains.slide_kv / gains.slide_kp),
        control.guidance_position_limit,
        control.wrist_acceleration * (mass / gains.slide_kp),
    )
    hinges = _lead(
        ahead[..., 3:],
        control.wrist_rotation_scale * action[..., fingers + 3 :],
        state.u_velocity[..., 3:] * (gains.hinge_kv / gains.hinge_kp),
        control.guidance_rotation_limit,
        control.wrist_angular_acceleration * (inertia / gains.hinge_kp),
    )
    return Action(q_target, state.u + jnp.concatenate([slides, hinges], -1))


def _lead(ahead: Array, residual: Array, steady: Array, farthest: Array | float, hardest: Array | float) -> Array:
    """How far (B, 3) the target is ahead of three wrist joints.

    A servo moves a mass m by m a = kp (target - u) - kv v: at a target that is kv v / kp ahead it goes on at its speed,
    and a target r from there accelerates it by kp r / m.

    Args:
      ahead: (B, 3) how far the guidance is ahead.
      residual: (B, 3) what the action adds.
      steady: (B, 3) kv v / kp.
      farthest: length of the lead.
      hardest: m / kp times the greatest acceleration; 0 for any.
    """
    wanted = _limit(_limit(ahead, farthest) + residual, farthest)
    return steady + _limit(wanted - steady, jnp.where(jnp.asarray(hardest) > 0, hardest, jnp.inf))


def _finger_guidance(scene: Scene, rate: float) -> Array:
    """(B, M) rad by which motors go on to the closed hand, at most `rate`, once half the approach is over."""
    begun = 2.0 * scene.state.time >= scene.task.approach_steps
    ahead = motor_positions(scene.hand, jnp.array(scene.hand.q_closed) - scene.state.q_target)
    return begun[:, None] * jnp.clip(ahead, -rate, rate)


def _limit(vector: Array, length: Array | float) -> Array:
    """Vectors (..., 3) shortened to at most `length`."""
    norm = jnp.sqrt(jnp.sum(vector**2, -1, keepdims=True) + 1e-12)
    return vector * jnp.minimum(1.0, length / norm)
