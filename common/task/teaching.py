"""What a teacher is asked with, and its action in the terms of a student that sees another state.

A residual is relative to the guidance that its policy has. Where a student's guidance is another, because a tracker is
off, the teacher's residual would put its wrist elsewhere. What the two share is the wrist's target: the student's label
is (u_tgt - u_g) / alpha_w with the teacher's target u_tgt and the student's own guidance u_g.
"""

import jax.numpy as jnp

from congrasp.common.config import ControlConfig
from congrasp.common.hands.spec import Hand
from congrasp.common.task.constraints.base import Scene
from congrasp.common.task.control import Guided, guided, wrist_lead
from congrasp.common.task.observation import observe
from congrasp.common.task.types import Array

EXTRA = 20
"""Numbers beside the observation: the teacher's `Guided`, then the student's lead by its guidance alone."""


def observe_for_teacher(true: Scene, seen: Scene, control: ControlConfig) -> Array:
    """(B, S) the full observation of the true state, then `EXTRA` numbers.

    Args:
      true: the scene as a policy sees it that sees all.
      seen: the same control step as the student sees it.
      control: limits and scales.
    """
    teacher = guided(true, control)
    limit, table = teacher.limit[:, None], jnp.asarray(teacher.table, teacher.ahead.dtype)[:, None]
    own = guided(seen, control).bounded(control)
    return jnp.concatenate([observe(true), teacher.ahead, limit, teacher.velocity, table, own], -1)


def student_action(hand: Hand, control: ControlConfig, rows: Array, action: Array) -> Array:
    """The action (..., M + 6) by which a student has the targets that a teacher's action gives.

    Args:
      hand: its servos.
      control: limits and scales.
      rows: (..., S) of `observe_for_teacher`.
      action: (..., M + 6) the teacher's.
    """
    ahead, limit, velocity, table, own = jnp.split(rows[..., -EXTRA:].astype(action.dtype), (6, 7, 13, 14), -1)
    teacher = Guided(ahead, limit[..., 0], velocity, table[..., 0] > 0.5)
    lead = wrist_lead(hand, control, teacher, action[..., -6:])
    scale = jnp.repeat(jnp.stack([control.wrist_position_scale, control.wrist_rotation_scale]), 3)
    return jnp.concatenate([action[..., :-6], (lead - own) / scale], -1)
