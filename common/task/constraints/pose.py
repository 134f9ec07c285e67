"""Reference pose: target pose of wrist and fingers in the grasp.

In training, references are disturbed like captured grasps (`constraints.disturbance`).
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from congrasp.common import rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.lazy_jax import jnp
from congrasp.common.task.constraints.base import Constraint
from congrasp.common.task.constraints.disturbance import (
    disturbed_fingers,
    disturbed_wrist,
    fingers_numbers,
    wrist_numbers,
)
from congrasp.common.task.constraints.heading import (
    TURNED,
    heading_of_wrist,
    heading_turn,
    object_pose,
)
from congrasp.common.task.constraints.markers import Ghost, Marker
from congrasp.common.task.constraints.specs import (
    ErrorSpec,
    GoalArray,
    ObservationField,
    Option,
    Relation,
    Weight,
)
from congrasp.common.task.geometry import flat, in_world, square, squared_distances, wrist_to_joints
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.scene import Scene
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Contacts, Features, Goal, Surface

TOUCHING = 0.015
"""Distance from a joint or fingertip of a reference pose to the surface below which it counts as
touching, m.
"""
_MAX_COST_DISTANCE = 0.15
"""Distance of the wrist beyond which the cost saturates, m."""
_MAX_COST_ANGLE = 0.5
"""Angle of the wrist beyond which the cost saturates, rad."""
_GATE_FAR = 0.10
"""Distance between hand and object from which on the fingers are not rewarded, m."""
_GATE_NEAR = 0.03
"""Distance between hand and object below which the fingers are fully rewarded, m."""


class PoseGoal(NamedTuple):
    """A wrist pose in the object frame, and finger angles."""

    q: Annotated[Array, GoalArray(("F",), "rad, finger angles (q-bar)")]
    position: Annotated[Array, GoalArray((3,), "m, object frame: wrist position", "position")]
    quaternion: Annotated[
        Array,
        GoalArray((4,), "wrist frame to object frame", "quaternion", neutral=(1.0, 0.0, 0.0, 0.0)),
    ]


class PoseFeatures(NamedTuple):
    """The reference pose in the wrist frame."""

    keypoints: Array
    """(B, P, 3) x-bar: keypoints of the reference pose, placed by its wrist pose in the object
    frame.
    """


class Pose(Constraint):
    """Finger angles and wrist pose of the grasp; the two are gated separately (paper, section
    Observation Space).
    """

    name = "pose"
    title = "reference pose"
    goal = PoseGoal
    blocks = ("pose_finger", "pose_wrist")
    overrides = ("heading", "affordance")
    guides = "pose_wrist"
    finger_pose = "pose_finger"
    from_reference = True
    harvested = False
    weights = (
        Weight(
            "pose_finger",
            0.1,
            "w_q of the pose term: per squared radian of the finger joints, gated by the hand's "
            "distance.",
        ),
        Weight(
            "pose_link",
            5.0,
            "w_x: per square metre of the finger links' positions, gated by the hand's distance.",
        ),
        Weight("pose_wrist_position", 20.0, "w_p: per square metre of the wrist's position."),
        Weight(
            "pose_wrist_rotation",
            0.5,
            "w_R of the pose term: per square radian of the wrist's rotation.",
        ),
    )
    errors = (
        ErrorSpec(
            name="pose_rad",
            unit="rad",
            window="hold",
            tolerance=0.25,
            scale=0.25,
            meaning="mean over joints and wrist hinges",
        ),
        ErrorSpec(
            name="pose_m",
            unit="m",
            window="hold",
            tolerance=0.03,
            scale=0.02,
            meaning="distance of the wrist",
            block="pose_wrist",
        ),
    )
    options = (
        Option(
            "pose",
            "Reference pose: a grasp.npz, a pose of a constraint set (FILE:NUMBER), or a JSON file "
            "with joints, position and quaternion.",
            "pose",
        ),
    )

    def numbers(self, hand: Hand, task: TaskSettings) -> int:
        """Those of disturbed fingers and of a disturbed wrist."""
        return fingers_numbers(hand) + wrist_numbers(1)

    def sample(self, hand: Hand, draw: Draw, uniform: Array) -> PoseGoal:
        """Samples one of the object's reference poses."""
        index = draw.objects, draw.region, draw.reference["pose"]
        q = draw.bank.pose_q[index]
        position = draw.bank.pose_position[index]
        quaternion = draw.bank.pose_quaternion[index]
        if draw.disturbance is None:
            return PoseGoal(q, position, quaternion)
        for_fingers, for_wrist = jnp.split(uniform, [fingers_numbers(hand)], -1)
        q = disturbed_fingers(hand, q, draw.disturbance, for_fingers)
        positions, quaternions = disturbed_wrist(
            position[:, None], quaternion[:, None], draw.disturbance, for_wrist
        )
        return PoseGoal(q, positions[:, 0], quaternions[:, 0])

    def override(
        self, hand: Hand, surface: Surface, requested: Mapping[str, Array], goal: Goal
    ) -> Goal:
        """Replaces the heading by that of the reference pose."""
        pose = goal["pose"]
        heading = heading_of_wrist(hand, pose.q, pose.position, pose.quaternion)
        return goal.where(requested["pose"], "heading", **heading)

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """Effect of the pose: it guides wrist and fingers, or only the fingers."""
        if overridden:
            return [
                "Only the fingers of the reference pose count: the trajectory determines the wrist."
            ]
        return ["The reference pose guides wrist and fingers; the heading follows from it."]

    def initial_fingers(self, goal: Goal) -> tuple[Array, Array]:
        """Reference finger angles (paper, section Hand Initialization)."""
        return goal.active["pose_finger"], goal["pose"].q

    def features(
        self, hand: Hand, contacts: Contacts, features: Features, goal: Goal
    ) -> PoseFeatures:
        """Keypoints of the reference pose."""
        points = rotations.transform(
            features.object_position,
            features.object_quaternion,
            _reference_keypoints(hand, goal["pose"]),
        )
        return PoseFeatures(points)

    def guidance(self, scene: Scene, *, current: bool) -> tuple[Array, Array]:
        """Reference wrist pose in the world frame."""
        pose = scene.goal["pose"]
        return in_world(*object_pose(scene, current=current), pose.position, pose.quaternion)

    def fields(self, hand: Hand, task: TaskSettings) -> tuple[tuple[ObservationField, ...], ...]:
        """Fields for residuals of joints and keypoints, and of the virtual wrist joints."""
        fingers = (
            ObservationField("pose_q - q", len(hand.joints), "rad, to the reference pose"),
            ObservationField(
                "pose_keypoints - keypoints", 3 * len(hand.keypoints), "m, wrist frame"
            ),
        )
        wrist = ObservationField(
            "pose_u - u", 6, "m and rad, wrist joints of the reference pose minus the current ones"
        )
        return fingers, (wrist,)

    def observe(self, scene: Scene) -> tuple[list[Array], ...]:
        """Residuals q-bar - q and x-bar - x; u-bar - u."""
        state = scene.state
        features = scene.features
        keypoint_residuals = features.by_constraint["pose"].keypoints - features.keypoints
        fingers = [scene.goal["pose"].q - state.q, flat(keypoint_residuals)]
        return fingers, [wrist_to_joints(state, *_wrist_target(scene)) - state.u]

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Reward term r^pose."""
        features = scene.features
        position, quaternion = _wrist_target(scene)
        gap = jnp.min(jnp.linalg.norm(features.nearest, axis=-1), -1)
        fingers_active = pose_gate(gap) * scene.gate("pose_finger")
        wrist_active = scene.gate("pose_wrist")
        keypoint_residuals = features.by_constraint["pose"].keypoints - features.keypoints
        away = jnp.minimum(square(features.wrist_position - position), _MAX_COST_DISTANCE**2)
        angle = rotations.angle(features.wrist_quaternion, quaternion)
        turned = jnp.minimum(angle, _MAX_COST_ANGLE)
        return {
            "pose_finger": -fingers_active * square(scene.state.q - scene.goal["pose"].q),
            "pose_link": -fingers_active * jnp.sum(square(keypoint_residuals), -1),
            "pose_wrist_position": -wrist_active * away,
            "pose_wrist_rotation": -wrist_active * turned**2,
        }

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Mean absolute error of the finger joints and the three wrist hinges; distance of the
        wrist.
        """
        state = scene.state
        position, quaternion = _wrist_target(scene)
        hinges = wrist_to_joints(state, position, quaternion)[..., 3:] - state.u[..., 3:]
        angles = jnp.concatenate([state.q - scene.goal["pose"].q, hinges], -1)
        return {
            "pose_rad": jnp.mean(jnp.abs(angles), -1),
            "pose_m": jnp.linalg.norm(scene.features.wrist_position - position, axis=-1),
        }

    def parse(
        self, option_values: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Returns the arrays of the file."""
        return option_values["pose"]

    def wrist_path(self, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Reference wrist pose."""
        return np.asarray(values["position"])[None], np.asarray(values["quaternion"])

    def markers(self, values: PoseGoal, blocks: Collection[str]) -> tuple[Marker, ...]:
        """Ghost of the reference hand, or of its wrist only."""
        q = values.q if "pose_finger" in blocks else None
        return (Ghost(values.position, values.quaternion, q),)


def pose_gate(distance: Array) -> Array:
    """Gate g(d) that rises linearly from 0 at 0.10 m to 1 at 0.03 m between hand and object."""
    return jnp.clip((_GATE_FAR - distance) / (_GATE_FAR - _GATE_NEAR), 0.0, 1.0)


def heading_message(stronger: str, turn: float) -> str:
    """Message for a heading that contradicts a stronger constraint by an angle in rad."""
    return (
        f"The heading differs by {np.degrees(turn):.0f} degrees from the approach of the "
        f"{stronger}. The {stronger} overrides it: the heading follows from it."
    )


def _reference_keypoints(hand: Hand, pose: PoseGoal) -> Array:
    """Keypoints (B, P, 3) of reference poses, object frame."""
    points = kinematics.keypoints(hand, kinematics.link_transforms(hand, pose.q))
    return rotations.transform(pose.position, pose.quaternion, points)


def _wrist_target(scene: Scene) -> tuple[Array, Array]:
    """Reference wrist pose (B, 3), (B, 4) relative to the object's current pose, world frame."""
    state = scene.state
    pose = scene.goal["pose"]
    return in_world(state.object_position, state.object_quaternion, pose.position, pose.quaternion)


def _touching_keypoints(hand: Hand, surface: Surface, goal: Goal) -> dict[str, Array]:
    """(B, P) bool: keypoints of the reference pose that would touch the avoid region."""
    squared = squared_distances(surface.points, _reference_keypoints(hand, goal["pose"]))
    avoid = jnp.min(jnp.where(surface.avoid[..., None], squared, jnp.inf), -2)
    graspable = jnp.min(jnp.where(surface.avoid[..., None], jnp.inf, squared), -2)
    return {"touching": (avoid < TOUCHING**2) & (avoid < graspable)}


def _contradicts_affordance(apart: Mapping[str, Array]) -> Array:
    """(B,) bool: a keypoint would touch the avoid region."""
    return jnp.any(apart["touching"], -1)


def _affordance_message(hand: Hand, apart: Mapping[str, Any]) -> str:
    """Message for an affordance that the pose overrides."""
    touching = hand.keypoint_links[np.flatnonzero(apart["touching"])]
    names = dict.fromkeys(hand.links[link].name for link in touching)
    return (
        f"In the reference pose, {', '.join(names)} would touch the avoid region. The pose defines "
        f"the contacts and overrides the affordance."
    )


def _apart_from_heading(hand: Hand, surface: Surface, goal: Goal) -> dict[str, Array]:
    """Angle (B,) in rad between the heading and that of the reference."""
    return {"turn": heading_turn(hand, goal["heading"], goal["pose"].quaternion)}


def _contradicts_heading(apart: Mapping[str, Array]) -> Array:
    """(B,) bool: the heading differs from that of the reference."""
    return apart["turn"] > TURNED


def _heading_message(hand: Hand, apart: Mapping[str, Any]) -> str:
    """Message for a heading that the pose overrides."""
    return heading_message("pose", apart["turn"])


Pose.relations = (
    Relation(
        weaker="affordance",
        settled="overridden",
        measure=_touching_keypoints,
        contradicts=_contradicts_affordance,
        message=_affordance_message,
    ),
    Relation(
        weaker="heading",
        settled="overridden",
        measure=_apart_from_heading,
        contradicts=_contradicts_heading,
        message=_heading_message,
    ),
)
