"""Heading: approach direction of the hand and target of its centre. The default, which is always
active.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from congrasp.common import chance, rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.constraints.base import Constraint
from congrasp.common.task.constraints.fingers import chosen_fingers
from congrasp.common.task.constraints.markers import Arrow, Marker
from congrasp.common.task.constraints.specs import (
    ErrorSpec,
    GoalArray,
    ObservationField,
    Option,
    Weight,
)
from congrasp.common.task.geometry import flat, hand_center, in_world
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.scene import Scene
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Contacts, Features, Goal

ABOVE = "above"
"""Literal for the heading straight down, in any pose of the object."""
TURNED = float(np.radians(30.0))
"""Angle between a heading and that of a stronger constraint above which they contradict, rad."""
_MAX_COST_DISTANCE = 0.15
"""Distance beyond which the cost saturates, m: a fallen object that rolls away must not dominate
the reward.
"""


class HeadingGoal(NamedTuple):
    """Approach direction and target of the hand, object frame."""

    position: Annotated[
        Array, GoalArray((3,), "m, target of the hand's centre (p-bar)", "position")
    ]
    direction: Annotated[
        Array,
        GoalArray(
            (3,),
            "unit, direction in which the hand moves (v-bar)",
            "direction",
            neutral=(0.0, 0.0, -1.0),
        ),
    ]
    cross: Annotated[
        Array,
        GoalArray(
            (3,),
            "unit, orthogonal to the direction: along the cross-finger axis w; it only sets the "
            "roll of the guidance",
            neutral=(1.0, 0.0, 0.0),
            required=False,
        ),
    ]


class HeadingFeatures(NamedTuple):
    """The heading in the wrist frame."""

    position: Array
    """(B, 3) p-bar, m."""
    direction: Array
    """(B, 3) v-bar, unit."""


class Heading(Constraint):
    """Approach direction and position (paper, section Constraint Formulation)."""

    name = "heading"
    title = "heading"
    goal = HeadingGoal
    guides = "heading"
    weights = (
        Weight(
            "heading_direction",
            0.3,
            "w_dir: for the heading axis along the target direction (cosine).",
        ),
        Weight(
            "heading_position", 3.0, "w_pos: per metre between hand centre and heading position."
        ),
    )
    errors = (
        ErrorSpec(
            name="heading_rad",
            unit="rad",
            window="hold",
            tolerance=0.25,
            scale=0.2,
            meaning="direction",
        ),
        ErrorSpec(
            name="heading_m",
            unit="m",
            window="hold",
            tolerance=0.03,
            scale=0.02,
            meaning="distance of the hand's centre from the heading's line",
        ),
    )
    options = (
        Option(
            "heading",
            'Approach direction: three numbers in the axes of the object\'s file ("0 0 -1"), or '
            "'above' for a direction within 30 degrees of straight down. Any direction by default.",
            "direction",
            words=(ABOVE,),
        ),
        Option(
            "at",
            "Target position of the hand's centre in the grasp: three numbers in metres, in the "
            "coordinates of the object's file.",
            "place",
        ),
    )

    def sample(self, hand: Hand, draw: Draw, uniform: Array) -> HeadingGoal:
        """Samples one of the object's headings for its resting pose and region, moved back clear of
        the table.
        """
        bank = draw.bank
        slot = chance.index(uniform[:, 0], bank.heading_index.shape[-1])
        slot_index = draw.objects, draw.region, draw.rests, slot
        heading_index = draw.objects, draw.region, bank.heading_index[slot_index]
        back = bank.heading_back[slot_index][:, None]
        direction = bank.heading_direction[heading_index]
        return HeadingGoal(
            position=bank.heading_position[heading_index] - back * direction,
            direction=direction,
            cross=bank.heading_cross[heading_index],
        )

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """Effect of the heading: it guides the wrist unless a stronger constraint does."""
        if overridden:
            return []
        return ["The heading guides the wrist."]

    def initial_wrist(
        self, hand: Hand, back_off: Array, goal: Goal, q: Array
    ) -> tuple[Array, Array, Array]:
        """Wrist aligned with the heading and backed off (paper, section Hand Initialization)."""
        points = kinematics.keypoints(hand, kinematics.link_transforms(hand, q))
        center = hand_center(hand, points, chosen_fingers(goal.values, goal))
        position, quaternion = heading_wrist_pose(hand, goal["heading"], center)
        position = position - back_off[:, None] * goal["heading"].direction
        everywhere = jnp.ones(position.shape[0], bool)
        return everywhere, position, quaternion

    def features(
        self, hand: Hand, contacts: Contacts, features: Features, goal: Goal
    ) -> HeadingFeatures:
        """Target in the wrist frame."""
        heading = goal["heading"]
        turn = features.object_quaternion
        return HeadingFeatures(
            position=features.object_position + rotations.rotate(turn, heading.position),
            direction=rotations.rotate(turn, heading.direction),
        )

    def guidance(self, scene: Scene, *, current: bool) -> tuple[Array, Array]:
        """Wrist pose that aligns the current hand with the heading."""
        pose = heading_wrist_pose(scene.hand, scene.goal["heading"], scene.features.center)
        return in_world(*object_pose(scene, current=current), *pose)

    def fields(self, hand: Hand, task: TaskSettings) -> tuple[tuple[ObservationField, ...], ...]:
        """Fields for hand centre, target, residual, direction and object rotation."""
        block = (
            ObservationField(
                "center",
                3,
                "m, midpoint of the thumb's tip and the mean of the other tips, wrist frame",
            ),
            ObservationField("heading_position", 3, "m, target of the centre, wrist frame"),
            ObservationField("heading_position - center", 3, "m, wrist frame"),
            ObservationField("heading_direction", 3, "unit, approach direction, wrist frame"),
            ObservationField(
                "object_matrix", 9, "rotation matrix from object to wrist frame, row by row"
            ),
        )
        return (block,)

    def observe(self, scene: Scene) -> tuple[list[Array], ...]:
        """p, p-bar, p-bar - p, v-bar and the object's rotation matrix, in the wrist frame."""
        center = scene.features.center
        target = scene.features.by_constraint["heading"]
        block = [
            center,
            target.position,
            target.position - center,
            target.direction,
            flat(rotations.to_matrix(scene.features.object_quaternion)),
        ]
        return (block,)

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Reward term r^head."""
        axis = jnp.array(grasp_frame(scene.hand).heading)
        target = scene.features.by_constraint["heading"]
        distance = jnp.linalg.norm(scene.features.center - target.position, axis=-1)
        return {
            "heading_direction": jnp.sum(axis * target.direction, -1),
            "heading_position": -jnp.minimum(distance, _MAX_COST_DISTANCE),
        }

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Geodesic distance between v and v-bar; length of p - p-bar projected on the plane
        perpendicular to v-bar.
        """
        axis = jnp.array(grasp_frame(scene.hand).heading)
        target = scene.features.by_constraint["heading"]
        direction = target.direction
        cosine = jnp.sum(axis * direction, -1)
        sine = jnp.linalg.norm(
            jnp.cross(jnp.broadcast_to(axis, direction.shape), direction), axis=-1
        )
        offset = scene.features.center - target.position
        lateral = offset - jnp.sum(offset * direction, -1, keepdims=True) * direction
        return {
            "heading_rad": jnp.arctan2(sine, cosine),
            "heading_m": jnp.linalg.norm(lateral, axis=-1),
        }

    def parse(
        self, option_values: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Returns direction and position, if given."""
        arrays = {}
        direction = option_values["heading"]
        if direction is not None and not isinstance(direction, str):
            arrays["direction"] = direction
        position = option_values["at"]
        if position is not None:
            arrays["position"] = position
        return arrays or None

    def markers(self, values: HeadingGoal, blocks: Collection[str]) -> tuple[Marker, ...]:
        """Arrow to the target of the hand's centre."""
        return (Arrow(values.position, values.direction),)


def heading_wrist_pose(hand: Hand, heading: HeadingGoal, center: Array) -> tuple[Array, Array]:
    """Wrist pose in the object frame (B, 3), (B, 4) that aligns v, w and the hand centre with the
    heading.

    Args:
      hand: the hand.
      heading: the heading.
      center: (B, 3) hand centre in the wrist frame.
    """
    grasp = grasp_frame(hand)
    axes = rotations.frame_from_axes(jnp.array(grasp.heading), jnp.array(grasp.cross))
    target = rotations.frame_from_axes(heading.direction, heading.cross)
    quaternion = rotations.multiply(target, rotations.conjugate(axes))
    return heading.position - rotations.rotate(quaternion, center), quaternion


def heading_of_wrist(
    hand: Hand, q: Array, position: Array, quaternion: Array, fingers: Array | None = None
) -> dict[str, Array]:
    """Heading (B, 3) arrays of a wrist pose (B, 3), (B, 4) with finger angles (B, F), in the same
    frame.

    `fingers` (B, G) bool selects the tips that define the hand centre; all by default.
    """
    grasp = grasp_frame(hand)
    keypoints = kinematics.keypoints(hand, kinematics.link_transforms(hand, q))
    center = hand_center(hand, keypoints, fingers)
    heading = jnp.broadcast_to(jnp.array(grasp.heading), center.shape)
    cross = jnp.broadcast_to(jnp.array(grasp.cross), center.shape)
    return {
        "position": position + rotations.rotate(quaternion, center),
        "direction": rotations.rotate(quaternion, heading),
        "cross": rotations.rotate(quaternion, cross),
    }


def heading_turn(hand: Hand, heading: HeadingGoal, quaternion: Array) -> Array:
    """Angle (B,) in rad between the heading's direction and the heading axis of wrists (B, 4),
    object frame.
    """
    axis = jnp.broadcast_to(jnp.array(grasp_frame(hand).heading), heading.direction.shape)
    cosine = jnp.sum(rotations.rotate(quaternion, axis) * heading.direction, -1)
    return jnp.arccos(jnp.clip(cosine, -1.0, 1.0))


def orthogonal_cross(heading: HeadingGoal) -> HeadingGoal:
    """Returns the heading with its cross-finger direction normalised and orthogonal to its
    direction.

    Where the two are parallel an arbitrary orthogonal direction is used, since the remainder is
    rounding error.
    """
    direction = heading.direction
    axis = jnp.eye(3)[jnp.argmin(jnp.abs(direction), -1)]
    cross = _orthogonal_part(heading.cross, direction)
    arbitrary = _orthogonal_part(axis, direction)
    parallel = jnp.linalg.norm(cross, axis=-1, keepdims=True) < 1e-3
    cross = jnp.where(parallel, arbitrary, cross)
    return heading._replace(cross=cross / jnp.linalg.norm(cross, axis=-1, keepdims=True))


def _orthogonal_part(vector: Array, direction: Array) -> Array:
    """Component of vectors (B, 3) orthogonal to unit directions (B, 3)."""
    return vector - jnp.sum(vector * direction, -1, keepdims=True) * direction


def object_pose(scene: Scene, *, current: bool) -> tuple[Array, Array]:
    """Current pose (B, 3), (B, 4) of the object in the world frame, or its pose at the start of the
    episode.
    """
    state = scene.state
    if current:
        return state.object_position, state.object_quaternion
    return state.object_position_initial, state.object_quaternion_initial
