"""Inputs of a teacher, and its actions converted to those of a student that observes another state.

A residual is relative to the guidance of its policy. A student's guidance differs if its tracker has errors, so that
the teacher's residual would move its wrist to another place. Both share the wrist's target: the student's label is
(u_tgt - u_g) / alpha_w with the teacher's target u_tgt and the student's guidance u_g.

Both share the fingers' targets likewise. The teacher continues from the targets m that the servos follow, the student
from its newest ones m', which the servos follow later (`SensingConfig.latency`): its label is a_f + (m - m') / alpha_f.
"""

import jax.numpy as jnp

from congrasp.common.hands.motors import motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints.base import Scene
from congrasp.common.task.control import Guided, guided, wrist_lead
from congrasp.common.task.observation import observe
from congrasp.common.task.settings import ControlConfig
from congrasp.common.task.types import Array

_WRIST = (6, 7, 13, 14, 20)
"""Ends of the wrist's numbers: the teacher's `Guided`, then the lead of the student's guidance alone."""


def extra(hand: Hand) -> int:
    """Numbers after the observation: the wrist's, and the lag (M) of the motors' followed targets, rad."""
    return _WRIST[-1] + len(hand.motors)


def observe_for_teacher(true: Scene, seen: Scene, control: ControlConfig) -> Array:
    """Returns the full observation of the true state and the numbers of `extra` (B, S).

    Args:
      true: the true scene.
      seen: the scene of the same control step as the student observes it.
      control: limits and scales.
    """
    teacher = guided(true, control)
    limit, table = teacher.limit[:, None], jnp.asarray(teacher.table, teacher.ahead.dtype)[:, None]
    own = guided(seen, control).bounded(control)
    lag = motor_positions(true.hand, true.state.q_target - seen.state.q_target)
    return jnp.concatenate([observe(true), teacher.ahead, limit, teacher.velocity, table, own, lag], -1)


def student_action(hand: Hand, control: ControlConfig, rows: Array, action: Array) -> Array:
    """Returns the action (..., M + 6) that gives a student the targets of its teacher.

    Args:
      hand: the hand, for its servos.
      control: limits and scales.
      rows: (..., S) of `observe_for_teacher`.
      action: (..., M + 6) action of the teacher.
    """
    numbers = rows[..., -extra(hand) :].astype(action.dtype)
    ahead, limit, velocity, table, own, lag = jnp.split(numbers, _WRIST, -1)
    teacher = Guided(ahead, limit[..., 0], velocity, table[..., 0] > 0.5)
    lead = wrist_lead(hand, control, teacher, action[..., -6:])
    scale = jnp.repeat(jnp.stack([control.wrist_position_scale, control.wrist_rotation_scale]), 3)
    return jnp.concatenate([action[..., :-6] + lag / control.finger_scale, (lead - own) / scale], -1)
