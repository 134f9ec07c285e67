"""Constraint sets of captured objects: their demonstrations as reference poses and trajectories."""

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from congrasp.common.hands.closure import CENTER_ONLY, outline
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.spec import Hand
from congrasp.common.objects import store
from congrasp.common.objects.pool import object_scale
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.sampling.headings import Headings
from congrasp.common.task.sampling.object_headings import HEADINGS, headings_of
from congrasp.common.task.sampling.sets import set_of
from congrasp.common.task.sampling.table import (
    SOFT,
    above_table,
    clear_of_table,
    height_over_table,
)
from congrasp.common.wire.codec import Message
from congrasp.services.assets.captures.extract import Demonstration
from congrasp.services.assets.captures.options import Options
from congrasp.services.assets.captures.postures import posture_deviations
from congrasp.services.assets.captures.references import (
    demonstrated_headings,
    greatest_overlap,
    separate_fingers,
    transfer,
)
from congrasp.services.assets.captures.surface import Surface

MAX_DEPTH_IN_TABLE_M = 0.005
"""Tolerated depth of a captured hand in the table if no resting pose avoids it."""
_above_table = jax.jit(above_table)
_clear_of_table = jax.jit(clear_of_table, static_argnums=0)
_height_over_table = jax.jit(height_over_table, static_argnums=0)


@dataclasses.dataclass
class Group:
    """Demonstrations on one object with one partition."""

    obj: GraspObject
    demonstrations: list[Demonstration] = dataclasses.field(default_factory=list)
    training: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, bool))
    """(M,) bool, those for training."""


class BuiltSet(NamedTuple):
    """The constraint set of M demonstrations on an object."""

    message: Message
    captured_q: np.ndarray
    """(M, F) finger angles before fingers were separated, rad."""


class References(NamedTuple):
    """M reference poses and wrist trajectories of K waypoints, in the object frame."""

    q: np.ndarray
    """(M, F) rad."""
    position: np.ndarray
    """(M, K, 3) m."""
    quaternion: np.ndarray
    """(M, K, 4)."""


def build_set(hand: Hand, group: Group, options: Options, number: int, source: str) -> BuiltSet:
    """Builds the constraint set of an object scaled for the hand.

    Args:
      hand: hand of the constraints.
      group: the object and its M demonstrations.
      options: options for building.
      number: number of the group, for its seed.
      source: name of the data set.

    Raises:
      CongraspError: the hand cannot approach the object in any resting pose.
    """
    task = TaskConfig(hand=hand.name, trajectory_points=options.waypoints)
    obj = group.obj
    scale = object_scale(hand, task)
    scaled = obj.scaled(scale)
    headings = None
    if options.headings == "demonstrated":
        captured = demonstrated_headings(group.demonstrations, scale)
        headings = Headings(*(np.resize(field, (HEADINGS, 3)) for field in captured))
    # Human grasps are not tested against the hand's outline, since their table was elsewhere.
    tested_outline = CENTER_ONLY if headings else outline(hand)
    seed = (options.seed, number)
    fields = headings_of(task, scaled, seed, headings, scale, tested_outline)
    references = _references(hand, group.demonstrations, scaled, scale)
    position = references.position
    quaternion = references.quaternion
    q = separate_fingers(hand, references.q)
    clear = usable_resting_poses(hand, references._replace(q=q), fields["rest"])
    agrees = _ends_nearer_to_graspable(position[:, -1], fields["points"], fields["avoid"])
    own_fields = {
        name: value
        for name, value in fields.items()
        if name != "weight" and not name.startswith("chosen")
    }
    row = ConstraintBank(
        **own_fields,
        pose_q=_for_both_regions(q),
        pose_position=_for_both_regions(position[:, -1]),
        pose_quaternion=_for_both_regions(quaternion[:, -1]),
        trajectory_position=_for_both_regions(position),
        trajectory_quaternion=_for_both_regions(quaternion),
        pose_valid=np.stack([clear.T, (clear & agrees[:, None]).T]),
        weight=np.float32(1.0),  # people held it, however flat it lies
        mass=np.float32(scaled.mass),
        renewable=np.bool_(False),
        grasps=np.zeros(2, int),
    )
    about = {
        "source": source,
        "demonstrations": [demonstration.name for demonstration in group.demonstrations],
        "object_scale": scale,
        "object_digest": store.digest(obj),
    }
    # Demonstrated headings repeat, and each belongs to the split of its demonstration.
    heading_training = np.resize(group.training, HEADINGS) if headings else None
    message = set_of(
        hand,
        row,
        scaled,
        options.seed,
        about,
        pose_training=group.training,
        heading_training=heading_training,
    )
    return BuiltSet(message, references.q)


def report_rows(hand: Hand, group: Group, built: BuiltSet) -> Iterator[dict[str, Any]]:
    """Yields the outcome of each of M kept demonstrations on an object.

    Args:
      hand: hand of the set.
      group: the object and its demonstrations.
      built: their constraint set.
    """
    arrays = built.message.arrays
    usable = arrays["pose/allowed"].any((0, 1))
    below = from_below(hand, built.message)
    overlap = np.asarray(greatest_overlap(hand, built.captured_q))
    moved = np.abs(arrays["pose/q"][0] - built.captured_q).max(-1)
    posture = posture_deviations(
        hand,
        arrays["pose/q"][0],
        arrays["pose/position"][0],
        arrays["pose/quaternion"][0],
        Surface(group.obj.scaled(float(built.message.meta["object_scale"]))),
    )
    for m, demonstration in enumerate(group.demonstrations):
        yield {
            "sequence": demonstration.name,
            "object": group.obj.name,
            "frame": demonstration.frame,
            "frames_after_touch": demonstration.later,
            "first_frame": demonstration.start,
            "residual_rad": round(demonstration.fit.angle, 5),
            "residual_tip_m": round(demonstration.fit.tip, 5),
            "overlap_m": round(float(overlap[m]), 5),
            "moved_apart_rad": round(float(moved[m]), 5),
            "posture_rad": round(float(posture[m]), 5),
            "touched_points": len(demonstration.contact),
            "clear_of_table": bool(usable[m]),
            "from_below": bool(below[m]),
            "split": "training" if group.training[m] else "held-out",
        }


def _references(
    hand: Hand, demonstrations: list[Demonstration], scaled: GraspObject, scale: float
) -> References:
    """The demonstrations as references of a hand, float32.

    Args:
      hand: any hand.
      demonstrations: M demonstrations on one object.
      scaled: the object scaled for the hand.
      scale: factor of this scaling.
    """
    if hand is HUMAN:
        q = np.stack([demonstration.q for demonstration in demonstrations])
        position = np.stack([demonstration.position for demonstration in demonstrations])
        quaternion = np.stack([demonstration.quaternion for demonstration in demonstrations])
    else:
        q, position, quaternion = transfer(hand, demonstrations, scaled, scale)
    return References(
        q.astype(np.float32), position.astype(np.float32), quaternion.astype(np.float32)
    )


def usable_resting_poses(hand: Hand, references: References, rest: np.ndarray) -> np.ndarray:
    """(M, R) bool: resting poses of the object in which each of M captured references is used.

    The wrist must stay above the table and the hand outside it, as for other references. If no
    resting pose allows that, because captured hands are off by some millimetres, the one with the
    least depth is used, up to `MAX_DEPTH_IN_TABLE_M`.

    Args:
      hand: hand of the references.
      references: M references; the pose is at the last waypoint.
      rest: (R, 7) resting poses.
    """
    q, position, quaternion = references
    rests = np.stack([rest] * len(position))
    clear = np.asarray(_clear_of_table(hand, quaternion[:, -1], position, rests))
    height = _height_over_table(hand, q, position, quaternion, rests)
    clear_height = np.where(clear, height, -np.inf)
    highest = clear_height.max(1, keepdims=True)
    return clear & (clear_height >= np.clip(highest, -MAX_DEPTH_IN_TABLE_M, -SOFT))


def from_below(hand: Hand, message: Message) -> np.ndarray:
    """(M,) bool: demonstrations excluded in every resting pose.

    In one of the poses only the approach from below excludes them.
    """
    path = message.arrays["trajectory/position"][0]
    quaternion = message.arrays["pose/quaternion"][0]
    rests = np.stack([message.arrays["rest"]] * len(path))
    clear = np.asarray(_clear_of_table(hand, quaternion, path, rests))
    above = np.asarray(_above_table(path, rests))
    return np.asarray(above.any(-1) & ~clear.any(-1))


def _for_both_regions(values: np.ndarray) -> np.ndarray:
    """Repeats values for both regions (2, ...): the whole surface, and the graspable region."""
    return np.stack([values, values])


def _ends_nearer_to_graspable(
    wrist: np.ndarray, points: np.ndarray, avoid: np.ndarray
) -> np.ndarray:
    """(M,) bool: wrist positions (M, 3) agree with the affordance.

    They are nearer to the graspable region than to the others
    (`common.task.constraints.priority`).
    """
    distances = np.linalg.norm(points[None] - wrist[:, None], axis=-1)
    to_graspable = distances[:, ~avoid].min(-1, initial=np.inf)
    to_avoid = distances[:, avoid].min(-1, initial=np.inf)
    return to_graspable < to_avoid
