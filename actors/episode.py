"""One environment's episode for logs, pictures and exports."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.actors.rollout import Trace
from congrasp.common import rotations
from congrasp.common.episode.constraints import active_constraints
from congrasp.common.episode.episode import Episode, Pieces, Recorded
from congrasp.common.episode.hand_arrays import hand_arrays
from congrasp.common.hands.kinematics import link_poses
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import PIECE_KINDS, Colours, GraspObject
from congrasp.common.task import metrics
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.reward import terms
from congrasp.common.task.types import Array, Goal, Surface


class EpisodeFacts(NamedTuple):
    """Facts of an episode other than its arrays."""

    success: bool
    """See `Episode`."""
    metrics: dict[str, float]
    """By the names in `common.task.metrics`."""
    about: dict[str, Any]
    """Origin: at least version of the policy, and actor."""


def traced_episode(
    hand: Hand,
    task: TaskConfig,
    trace: Trace,
    goal: Goal,
    surface: Surface,
    obj: GraspObject,
    facts: EpisodeFacts,
) -> Episode:
    """Returns the episode up to its end within the trace, or the whole trace if it does not end.

    Args:
      hand: the hand.
      task: the task, for the length of its control step.
      trace: T steps of one environment.
      goal: goal of the environment, without a batch axis.
      surface: surface of its object, without a batch axis.
      obj: its object.
      facts: result and origin.
    """
    ends = np.flatnonzero(np.asarray(trace.terminal))
    steps = len(np.asarray(trace.terminal))
    if len(ends):
        steps = int(ends[0]) + 1
    cut = Trace(*(_plain(field)[:steps] for field in trace))
    # For the whole trace, however early the episode ends: another length would be recompiled.
    position, quaternion = _frames(hand, trace.q, trace.wrist_position, trace.wrist_quaternion)
    active = {name: bool(value) for name, value in goal.active.items()}
    of_hand: dict[str, Any] = hand_arrays(hand)
    return Episode(
        hand=hand.name,
        object=obj.name,
        success=facts.success,
        control_dt=task.control_dt,
        constraints=active_constraints(active),
        metrics=facts.metrics,
        about=facts.about,
        time=task.control_dt * np.arange(steps),
        table=cut.table,
        joint_position=cut.q,
        joint_target=cut.q_target,
        link_position=_plain(position)[:steps],
        link_quaternion=_plain(quaternion)[:steps],
        link_force=cut.contact_force,
        object_position=cut.object_position,
        object_quaternion=cut.object_quaternion,
        object_vertices=_plain(obj.visual_vertices),
        object_faces=obj.visual_faces.astype(np.int32),
        object_file_origin=np.array([-x for x in obj.origin], np.float64),
        object_file_scale=np.asarray(obj.file_scale, np.float64),
        **of_hand,
        surface_points=_plain(surface.points),
        surface_avoid=_plain(surface.avoid),
        colours=_colours(obj),
        goal={name: _plain(value) for name, value in goal.flat().items()},
        active=active,
        recorded=Recorded(
            hand_reference=hand.reference,
            wrist_joints=cut.u,
            wrist_targets=cut.u_target,
            action=cut.action,
            rewards={name: cut.terms[:, i] for i, name in enumerate(terms(task))},
            errors={spec.name: cut.errors[:, i] for i, spec in enumerate(metrics.specs(task))},
            pieces=object_pieces(obj),
        ),
    )


@functools.partial(jax.jit, static_argnums=0)
def _frames(
    hand: Hand, q: Array, wrist_position: Array, wrist_quaternion: Array
) -> tuple[Array, Array]:
    """Frames (T, L, 3), (T, L, 4) of the links in the world frame."""
    local_position, local_quaternion = link_poses(hand, q)
    turn = jnp.broadcast_to(wrist_quaternion[:, None], local_quaternion.shape)
    return rotations.compose_pose(wrist_position[:, None], turn, local_position, local_quaternion)


def object_pieces(obj: GraspObject) -> Pieces:
    """Returns the convex pieces of the object as arrays, sizes as real numbers."""
    pieces = obj.pieces
    return Pieces(
        kind=np.array([PIECE_KINDS.index(piece.kind) for piece in pieces], np.int32),
        size=np.array([piece.size for piece in pieces], np.float64),
        pos=_plain([piece.pos for piece in pieces]),
        quat=_plain([piece.quat for piece in pieces]),
        part=np.array([piece.part for piece in pieces], np.int32),
    )


def _colours(obj: GraspObject) -> Colours | None:
    """Colours of the object, if it has any."""
    if obj.colours is None:
        return None
    return Colours(_plain(obj.colours.points), _plain(obj.colours.values))


def _plain(values: Any) -> np.ndarray:
    """Returns values as an array, with float64 converted to float32."""
    array = np.asarray(values)
    if array.dtype == np.float64:
        return array.astype(np.float32)
    return array
