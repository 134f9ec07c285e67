"""Heading: approach direction of the hand and target of its centre. The default, which is always
active.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from congrasp.common import chance, rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.constraints.base import (
    Arrow,
    Constraint,
    ErrorSpec,
    GoalArray,
    Marker,
    ObservationField,
    Option,
    Scene,
    Weight,
)
from congrasp.common.task.constraints.fingers import chosen_fingers
from congrasp.common.task.geometry import flat, hand_center, in_world
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Contacts, Features, Goal

ABOVE = "above"
"""Literal for the heading straight down, in any pose of the object."""
_FAR = 0.15
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

    name, title, goal = "heading", "heading", HeadingGoal
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
        ErrorSpec("heading_rad", "rad", "hold", 0.25, 0.2, "direction"),
        ErrorSpec(
            "heading_m",
            "m",
            "hold",
            0.03,
            0.02,
            "distance of the hand's centre from the heading's line",
        ),
    )
    options = (
        Option(
            "heading",
            'Approach direction: three numbers in the axes of the object\'s file ("0 0 -1"), or '
            "'above'. Free "
            "by default.",
            "direction",
            words=(ABOVE,),
        ),
        Option(
            "at",
            "Target of the grasping hand's centre: three numbers in metres, in the coordinates of "
            "the file.",
            "place",
        ),
    )

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

    def sample(self, hand: Hand, draw: Draw, uniform: Array) -> HeadingGoal:
        """Samples one of the object's headings for its resting pose and region, moved back clear of
        the table.
        """
        bank, where = draw.bank, (draw.objects, draw.region)
        slot = chance.index(uniform[:, 0], bank.heading_index.shape[-1])
        index = *where, bank.heading_index[*where, draw.rests, slot]
        back = bank.heading_back[*where, draw.rests, slot][:, None]
        direction = bank.heading_direction[index]
        return HeadingGoal(
            bank.heading_position[index] - back * direction, direction, bank.heading_cross[index]
        )

    def initial_wrist(
        self, hand: Hand, back_off: Array, goal: Goal, q: Array
    ) -> tuple[Array, Array, Array]:
        """Wrist aligned with the heading and backed off (paper, section Hand Initialization)."""
        points = kinematics.keypoints(hand, kinematics.link_transforms(hand, q))
        center = hand_center(hand, points, chosen_fingers(goal.values, goal))
        position, quaternion = heading_wrist_pose(hand, goal["heading"], center)
        position = position - back_off[:, None] * goal["heading"].direction
        return jnp.ones(position.shape[0], bool), position, quaternion

    def features(
        self, hand: Hand, contacts: Contacts, features: Features, goal: Goal
    ) -> HeadingFeatures:
        """Target in the wrist frame."""
        own = goal["heading"]
        return HeadingFeatures(
            features.object_position + rotations.rotate(features.object_quaternion, own.position),
            rotations.rotate(features.object_quaternion, own.direction),
        )

    def guidance(self, scene: Scene, *, current: bool) -> tuple[Array, Array]:
        """Wrist pose that aligns the current hand with the heading."""
        pose = heading_wrist_pose(scene.hand, scene.goal["heading"], scene.features.center)
        return in_world(*object_pose(scene, current=current), *pose)

    def observe(self, scene: Scene) -> tuple[list[Array], ...]:
        """p, p-bar, p-bar - p, v-bar and the object's rotation matrix, in the wrist frame."""
        features, own = scene.features, scene.features.of["heading"]
        block = [
            features.center,
            own.position,
            own.position - features.center,
            own.direction,
            flat(rotations.to_matrix(features.object_quaternion)),
        ]
        return (block,)

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Reward term r^head."""
        axis, own = jnp.array(grasp_frame(scene.hand).heading), scene.features.of["heading"]
        return {
            "heading_direction": jnp.sum(axis * own.direction, -1),
            "heading_position": -jnp.minimum(
                jnp.linalg.norm(scene.features.center - own.position, axis=-1), _FAR
            ),
        }

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Geodesic distance between v and v-bar; length of p - p-bar projected on the plane
        perpendicular to v-bar.
        """
        axis, own = jnp.array(grasp_frame(scene.hand).heading), scene.features.of["heading"]
        target = own.direction
        cosine = jnp.sum(axis * target, -1)
        sine = jnp.linalg.norm(jnp.cross(jnp.broadcast_to(axis, target.shape), target), axis=-1)
        off = scene.features.center - own.position
        lateral = off - jnp.sum(off * target, -1, keepdims=True) * target
        return {
            "heading_rad": jnp.arctan2(sine, cosine),
            "heading_m": jnp.linalg.norm(lateral, axis=-1),
        }

    def parse(
        self, given: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Parses direction and position, if given."""
        direction = None if isinstance(given["heading"], str) else given["heading"]
        found = {"direction": direction, "position": given["at"]}
        return {name: value for name, value in found.items() if value is not None} or None

    def markers(self, own: HeadingGoal, blocks: Collection[str]) -> tuple[Marker, ...]:
        """Arrow to the target of the hand's centre."""
        return (Arrow(own.position, own.direction),)

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """Effect of the heading: it guides the wrist unless a stronger constraint does."""
        return [] if overridden else ["The heading guides the wrist."]


def heading_wrist_pose(hand: Hand, heading: HeadingGoal, center: Array) -> tuple[Array, Array]:
    """Wrist pose in the object frame (B, 3), (B, 4) that aligns v, w and the hand centre with the
    heading.

    Args:
      hand: the hand.
      heading: the heading.
      center: (B, 3) hand centre in the wrist frame.
    """
    frame = grasp_frame(hand)
    own = rotations.frame_from_axes(jnp.array(frame.heading), jnp.array(frame.cross))
    target = rotations.frame_from_axes(heading.direction, heading.cross)
    quaternion = rotations.multiply(target, rotations.conjugate(own))
    return heading.position - rotations.rotate(quaternion, center), quaternion


def heading_of_wrist(
    hand: Hand, q: Array, position: Array, quaternion: Array, fingers: Array | None = None
) -> dict[str, Array]:
    """Heading (B, 3) arrays of a wrist pose (B, 3), (B, 4) with finger angles (B, F), in the same
    frame.

    `fingers` (B, G) bool selects the tips that define the hand centre; all by default.
    """
    frame = grasp_frame(hand)
    center = hand_center(
        hand, kinematics.keypoints(hand, kinematics.link_transforms(hand, q)), fingers
    )
    axes = [
        jnp.broadcast_to(jnp.array(axis), center.shape) for axis in (frame.heading, frame.cross)
    ]
    return {
        "position": position + rotations.rotate(quaternion, center),
        "direction": rotations.rotate(quaternion, axes[0]),
        "cross": rotations.rotate(quaternion, axes[1]),
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
    axis = jnp.eye(3)[jnp.argmin(jnp.abs(heading.direction), -1)]
    cross, other = (
        vector - jnp.sum(vector * heading.direction, -1, keepdims=True) * heading.direction
        for vector in (heading.cross, axis)
    )
    cross = jnp.where(jnp.linalg.norm(cross, axis=-1, keepdims=True) < 1e-3, other, cross)
    return heading._replace(cross=cross / jnp.linalg.norm(cross, axis=-1, keepdims=True))


def object_pose(scene: Scene, *, current: bool) -> tuple[Array, Array]:
    """Current pose (B, 3), (B, 4) of the object in the world frame, or its pose at the start of the
    episode.
    """
    state = scene.state
    if current:
        return state.object_position, state.object_quaternion
    return state.object_position_initial, state.object_quaternion_initial


TURNED = float(np.radians(30.0))
"""Angle between a heading and that of a stronger constraint above which they contradict, rad."""
