"""One environment's episode as a message for logs, pictures and exports."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors.rollout import Trace
from congrasp.common import rotations
from congrasp.common.hands.kinematics import link_poses
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import PIECE_KINDS, GraspObject
from congrasp.common.task import metrics
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.reward import terms
from congrasp.common.task.types import Array, Goal, Surface
from congrasp.common.wire.codec import Message

_TRACED = (
    "object_position",
    "object_quaternion",
    "contact_force",
    "q",
    "u",
    "q_target",
    "u_target",
    "action",
    "table",
)


def episode_message(
    hand: Hand,
    task: TaskConfig,
    trace: Trace,
    goal: Goal,
    surface: Surface,
    obj: GraspObject,
    meta: dict[str, Any],
) -> Message:
    """Returns the episode up to its end within the trace, or the whole trace if it does not end.

    Args:
      hand: the hand.
      task: the task, for the length of its control step.
      trace: T steps of one environment.
      goal: goal of the environment, without a batch axis.
      surface: surface of its object, without a batch axis.
      obj: its object.
      meta: further entries: version, actor, success, metrics.
    """
    ends = np.flatnonzero(np.asarray(trace.terminal))
    steps = int(ends[0]) + 1 if len(ends) else len(np.asarray(trace.terminal))
    cut = Trace(*(np.asarray(field)[:steps] for field in trace))
    # For the whole trace, however early the episode ends: another length would be recompiled.
    position, quaternion = _frames(hand, trace.q, trace.wrist_position, trace.wrist_quaternion)
    arrays = {
        "link_position": position[:steps],
        "link_quaternion": quaternion[:steps],
        **{name: getattr(cut, name) for name in _TRACED},
        **{f"reward/{name}": cut.terms[:, i] for i, name in enumerate(terms(task))},
        **{f"error/{spec.name}": cut.errors[:, i] for i, spec in enumerate(metrics.specs(task))},
        **{f"goal/{name}": value for name, value in goal.flat().items()},
        **{f"active/{name}": value for name, value in goal.active.items()},
        "surface_points": surface.points,
        "surface_avoid": surface.avoid,
        **_geometry(obj),
    }
    return Message(
        {name: _plain(np.asarray(value)) for name, value in arrays.items()},
        {"hand": hand.reference, "object": obj.name, "control_dt": task.control_dt, **meta},
    )


@functools.partial(jax.jit, static_argnums=0)
def _frames(
    hand: Hand, q: Array, wrist_position: Array, wrist_quaternion: Array
) -> tuple[Array, Array]:
    """Frames (T, L, 3), (T, L, 4) of the links in the world frame."""
    local_position, local_quaternion = link_poses(hand, q)
    turn = jnp.broadcast_to(wrist_quaternion[:, None], local_quaternion.shape)
    return rotations.compose_pose(wrist_position[:, None], turn, local_position, local_quaternion)


def _geometry(obj: GraspObject) -> dict[str, np.ndarray]:
    """Convex pieces and mesh of the object, as arrays of the message."""
    pieces = obj.pieces
    colours = (
        {"colour_points": obj.colours.points, "colour_values": obj.colours.values}
        if obj.colours
        else {}
    )
    return {
        "piece_kind": np.array([PIECE_KINDS.index(piece.kind) for piece in pieces], np.int32),
        "piece_size": np.array([piece.size for piece in pieces], np.float64),
        "piece_pos": np.array([piece.pos for piece in pieces]),
        "piece_quat": np.array([piece.quat for piece in pieces]),
        "piece_part": np.array([piece.part for piece in pieces], np.int32),
        "visual_vertices": obj.visual_vertices,
        "visual_faces": obj.visual_faces.astype(np.int32),
        **colours,
    }


def _plain(array: np.ndarray) -> np.ndarray:
    """Returns the array, with float64 converted to float32."""
    return array.astype(np.float32) if array.dtype == np.float64 else array
