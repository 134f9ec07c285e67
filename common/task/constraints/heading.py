"""Heading: from where the hand comes, and where its centre should be. The default that is always active."""

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.constraints.base import (
    Constraint,
    ErrorSpec,
    GoalArray,
    ObservationField,
    Option,
    Scene,
    Weight,
)
from congrasp.common.task.constraints.fingers import chosen_fingers
from congrasp.common.task.constraints.markers import Arrow, Marker
from congrasp.common.task.geometry import flat, hand_center, in_world
from congrasp.common.task.types import Array, Goal

if TYPE_CHECKING:
    from congrasp.common.config import TaskConfig
    from congrasp.common.task.features import Contacts, Features
    from congrasp.common.task.sampling.bank import Draw

ABOVE = "above"
"""What is written for the heading straight down, whatever the object's pose."""
_FAR = 0.15
"""Metres beyond which the distance costs no more: what a fallen object carries away must not drown all else."""


class HeadingGoal(NamedTuple):
    """Where the hand comes from and to, object frame."""

    position: Annotated[Array, GoalArray((3,), "m, where the hand's centre should be (p-bar)")]
    direction: Annotated[
        Array, GoalArray((3,), "unit, the way the hand moves (v-bar)", "direction", neutral=(0.0, 0.0, -1.0))
    ]
    cross: Annotated[
        Array,
        GoalArray(
            (3,),
            "unit, orthogonal to the direction: along the cross-finger axis w; fixes the guidance's roll only",
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
        Weight("heading_direction", 0.3, "w_dir: for the heading axis along the target direction (cosine)."),
        Weight("heading_position", 3.0, "w_pos: per metre between hand centre and heading position."),
    )
    errors = (
        ErrorSpec("heading_rad", "rad", "hold", 0.25, 0.2, "direction"),
        ErrorSpec("heading_m", "m", "hold", 0.03, 0.02, "hand's centre beside the arrow"),
    )
    options = (
        Option(
            "heading",
            "The way the hand comes, three numbers in the axes of the object's file (\"0 0 -1\"), or 'above'. Free by "
            "default.",
            "direction",
            words=(ABOVE,),
        ),
        Option(
            "at",
            "Where the middle of the grasping hand should be, three numbers in metres, in the coordinates of the file.",
            "place",
        ),
    )

    def fields(self, hand: Hand, task: "TaskConfig") -> tuple[tuple[ObservationField, ...], ...]:
        """Hand centre, target, residual, direction, object rotation."""
        block = (
            ObservationField("center", 3, "m, middle between thumb's tip and the other tips' mean, wrist frame"),
            ObservationField("heading_position", 3, "m, where the centre should be, wrist frame"),
            ObservationField("heading_position - center", 3, "m, wrist frame"),
            ObservationField("heading_direction", 3, "unit, the way the hand should come, wrist frame"),
            ObservationField("object_matrix", 9, "rotation matrix from object to wrist frame, row by row"),
        )
        return (block,)

    def sample(self, hand: Hand, draw: "Draw", key: Array) -> HeadingGoal:
        """One of the object's headings that its resting pose and region allow, moved back clear of the table."""
        bank, where = draw.bank, (draw.objects, draw.region)
        slot = jax.random.randint(key, draw.objects.shape, 0, bank.heading_index.shape[-1])
        index = *where, bank.heading_index[*where, draw.rests, slot]
        back = bank.heading_back[*where, draw.rests, slot][:, None]
        direction = bank.heading_direction[index]
        return HeadingGoal(bank.heading_position[index] - back * direction, direction, bank.heading_cross[index])

    def initial_wrist(self, hand: Hand, back_off: Array, goal: Goal, q: Array) -> tuple[Array, Array, Array]:
        """Aligned with the heading and backed off (paper, section Hand Initialization)."""
        points = kinematics.keypoints(hand, kinematics.link_transforms(hand, q))
        center = hand_center(hand, points, chosen_fingers(goal.values, goal))
        position, quaternion = heading_wrist_pose(hand, goal["heading"], center)
        position = position - back_off[:, None] * goal["heading"].direction
        return jnp.ones(position.shape[0], bool), position, quaternion

    def features(self, hand: Hand, contacts: "Contacts", features: "Features", goal: Goal) -> HeadingFeatures:
        """The target in the wrist frame."""
        own = goal["heading"]
        return HeadingFeatures(
            features.object_position + rotations.rotate(features.object_quaternion, own.position),
            rotations.rotate(features.object_quaternion, own.direction),
        )

    def guidance(self, scene: Scene, *, current: bool) -> tuple[Array, Array]:
        """The wrist pose that aligns the present hand with the heading."""
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
        """r^head."""
        axis, own = jnp.array(grasp_frame(scene.hand).heading), scene.features.of["heading"]
        return {
            "heading_direction": jnp.sum(axis * own.direction, -1),
            "heading_position": -jnp.minimum(jnp.linalg.norm(scene.features.center - own.position, axis=-1), _FAR),
        }

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Geodesic distance between v and v-bar; length of p - p-bar projected on the plane perpendicular to v-bar."""
        axis, own = jnp.array(grasp_frame(scene.hand).heading), scene.features.of["heading"]
        target = own.direction
        cosine = jnp.sum(axis * target, -1)
        sine = jnp.linalg.norm(jnp.cross(jnp.broadcast_to(axis, target.shape), target), axis=-1)
        off = scene.features.center - own.position
        lateral = off - jnp.sum(off * target, -1, keepdims=True) * target
        return {"heading_rad": jnp.arctan2(sine, cosine), "heading_m": jnp.linalg.norm(lateral, axis=-1)}

    def parse(self, given: Mapping[str, Any], hand: Hand, obj: GraspObject) -> dict[str, np.ndarray] | None:
        """Direction and position, as far as they are given."""
        direction = None if isinstance(given["heading"], str) else given["heading"]
        found = {"direction": direction, "position": given["at"]}
        return {name: value for name, value in found.items() if value is not None} or None

    def markers(self, own: HeadingGoal, blocks: Collection[str]) -> tuple[Marker, ...]:
        """An arrow to the hand centre's target."""
        return (Arrow(own.position, own.direction),)

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """It guides the wrist where nothing stronger does."""
        return [] if overridden else ["The heading guides the wrist."]


def heading_wrist_pose(hand: Hand, heading: HeadingGoal, center: Array) -> tuple[Array, Array]:
    """Wrist pose in the object frame (B, 3), (B, 4) that aligns v, w and the hand centre with the heading.

    Args:
      hand: the hand.
      heading: the target.
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
    """The heading (B, 3) each that a wrist pose (B, 3), (B, 4) with finger angles (B, F) has, in the same frame.

    `fingers` (B, G) bool are those whose tips make the hand centre; all by default.
    """
    frame = grasp_frame(hand)
    center = hand_center(hand, kinematics.keypoints(hand, kinematics.link_transforms(hand, q)), fingers)
    axes = [jnp.broadcast_to(jnp.array(axis), center.shape) for axis in (frame.heading, frame.cross)]
    return {
        "position": position + rotations.rotate(quaternion, center),
        "direction": rotations.rotate(quaternion, axes[0]),
        "cross": rotations.rotate(quaternion, axes[1]),
    }


def heading_turn(hand: Hand, heading: HeadingGoal, quaternion: Array) -> Array:
    """(B,) rad between the heading's direction and the heading axis of wrists (B, 4), object frame."""
    axis = jnp.broadcast_to(jnp.array(grasp_frame(hand).heading), heading.direction.shape)
    cosine = jnp.sum(rotations.rotate(quaternion, axis) * heading.direction, -1)
    return jnp.arccos(jnp.clip(cosine, -1.0, 1.0))


def orthogonal_cross(heading: HeadingGoal) -> HeadingGoal:
    """The heading with its cross-finger direction made unit and orthogonal to its direction.

    Where the two are parallel any orthogonal one is taken: of what remains rounding would decide.
    """
    axis = jnp.eye(3)[jnp.argmin(jnp.abs(heading.direction), -1)]
    cross, other = (
        vector - jnp.sum(vector * heading.direction, -1, keepdims=True) * heading.direction
        for vector in (heading.cross, axis)
    )
    cross = jnp.where(jnp.linalg.norm(cross, axis=-1, keepdims=True) < 1e-3, other, cross)
    return heading._replace(cross=cross / jnp.linalg.norm(cross, axis=-1, keepdims=True))


def object_pose(scene: Scene, *, current: bool) -> tuple[Array, Array]:
    """The object's present pose (B, 3), (B, 4) in the world, or that at the start of the episode."""
    state = scene.state
    if current:
        return state.object_position, state.object_quaternion
    return state.object_position_initial, state.object_quaternion_initial


TURNED = float(np.radians(30.0))
"""Angle between a heading and that of a stronger constraint from which on they contradict, rad."""
