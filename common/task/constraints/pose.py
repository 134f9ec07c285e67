"""Reference pose: target pose of wrist and fingers in the grasp.

In training, references are disturbed like captured human grasps. In a captured pose, joints are off
by some tenths of a radian and the wrist by a centimetre, the fingers are more or less closed than
those of the hand that follows it, and the waypoints of a captured path jitter. The size of the
disturbance is drawn for each episode, between none and the maxima below.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from congrasp.common import chance, rotations
from congrasp.common.hands import kinematics
from congrasp.common.hands.motors import coupled
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.constraints.base import (
    Constraint,
    ErrorSpec,
    Ghost,
    GoalArray,
    Marker,
    ObservationField,
    Option,
    Relation,
    Scene,
    Weight,
)
from congrasp.common.task.constraints.heading import (
    TURNED,
    heading_of_wrist,
    heading_turn,
    object_pose,
)
from congrasp.common.task.geometry import flat, in_world, square, squared_distances, wrist_to_joints
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Contacts, Features, Goal, Surface

JOINTS = 0.3
"""rad, largest standard deviation of an independent error of every finger joint."""
CLOSURE = (0.6, 1.1)
"""Least and greatest closure at full scale, as a share of the range from the open hand to the
reference's fingers.
"""
WRIST = 0.01, 0.2
"""m and rad, largest standard deviation of the wrist's errors along and about each axis."""
JITTER = 0.005
"""m, largest standard deviation of an independent error of every coordinate of every waypoint but
the last.
"""


def fingers_numbers(hand: Hand) -> int:
    """Number of random numbers that `disturbed_fingers` uses for a pose: the closure, and each
    joint.
    """
    return 1 + len(hand.joints)


def wrist_numbers(waypoints: int) -> int:
    """Number of random numbers that `disturbed_wrist` uses for K waypoints: translation, rotation,
    3 K of jitter.
    """
    return 6 + 3 * waypoints


def disturbed_fingers(hand: Hand, q: Array, amount: Array, uniform: Array) -> Array:
    """Disturbs reference fingers (B, F), within their limits.

    Args:
      hand: the hand.
      q: (B, F) finger angles, rad.
      amount: (B,) between 0 and 1, scale of the errors.
      uniform: (B, 1 + F) random numbers in [0, 1).
    """
    share = CLOSURE[0] + (CLOSURE[1] - CLOSURE[0]) * uniform[:, :1]
    q_open, amount = jnp.array(hand.q_open), amount[:, None]
    q = q_open + (1 + amount * (share - 1)) * (q - q_open)
    q = q + amount * JOINTS * chance.normal(uniform[:, 1:])
    return coupled(hand, jnp.clip(q, hand.lower, hand.upper))


def disturbed_wrist(
    position: Array, quaternion: Array, amount: Array, uniform: Array
) -> tuple[Array, Array]:
    """Disturbs wrist poses (B, K, 3), (B, K, 4) by one rigid motion for all K, with jitter of the
    waypoints.

    All rotate about the last one, so that a path keeps its shape.

    Args:
      position: positions in the object frame, m.
      quaternion: rotations from the wrist frame to the object frame.
      amount: (B,) between 0 and 1, scale of the errors.
      uniform: (B, 6 + 3 K) random numbers in [0, 1).
    """
    noise = amount[:, None] * chance.normal(uniform)
    move, turn = WRIST[0] * noise[:, :3], rotations.from_rotation_vector(WRIST[1] * noise[:, 3:6])
    last_is_kept = (np.arange(position.shape[1]) < position.shape[1] - 1)[:, None]
    jitter = JITTER * last_is_kept * noise[:, 6:].reshape(position.shape)
    turn, last = jnp.broadcast_to(turn[:, None], quaternion.shape), position[:, -1:]
    return last + move[:, None] + rotations.rotate(
        turn, position - last
    ) + jitter, rotations.multiply(turn, quaternion)


TOUCHING = 0.015
"""Distance from a joint or fingertip of a reference pose to the surface below which it counts as
touching, m.
"""
_FAR, _TURNED = 0.15, 0.5
"""Errors (m, rad) beyond which the tracking cost saturates."""
_GATE_FAR, _GATE_NEAR = 0.10, 0.03


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

    name, title, goal = "pose", "reference pose", PoseGoal
    blocks = ("pose_finger", "pose_wrist")
    overrides = ("heading", "affordance")
    guides = "pose_wrist"
    from_reference, harvested = True, False
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
        ErrorSpec("pose_rad", "rad", "hold", 0.25, 0.25, "mean over joints and wrist hinges"),
        ErrorSpec("pose_m", "m", "hold", 0.03, 0.02, "distance of the wrist", block="pose_wrist"),
    )
    options = (
        Option(
            "pose",
            "Reference pose: a grasp.npz, a constraint set (FILE:NUMBER), or JSON with joints, "
            "position, quaternion.",
            "pose",
        ),
    )

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

    def numbers(self, hand: Hand, task: TaskSettings) -> int:
        """Those of disturbed fingers and of a disturbed wrist."""
        return fingers_numbers(hand) + wrist_numbers(1)

    def sample(self, hand: Hand, draw: Draw, uniform: Array) -> PoseGoal:
        """Samples one of the object's reference poses."""
        index = draw.objects, draw.region, draw.reference["pose"]
        q, position, quaternion = (
            getattr(draw.bank, f"pose_{name}")[index] for name in PoseGoal._fields
        )
        if draw.disturbance is not None:
            fingers, turned = jnp.split(uniform, [fingers_numbers(hand)], -1)
            q = disturbed_fingers(hand, q, draw.disturbance, fingers)
            wrist = disturbed_wrist(
                position[:, None], quaternion[:, None], draw.disturbance, turned
            )
            position, quaternion = (part[:, 0] for part in wrist)
        return PoseGoal(q, position, quaternion)

    def override(
        self, hand: Hand, surface: Surface, asked: Mapping[str, Array], goal: Goal
    ) -> Goal:
        """Replaces the heading by that of the reference pose."""
        own = goal["pose"]
        return goal.where(
            asked["pose"], "heading", **heading_of_wrist(hand, own.q, own.position, own.quaternion)
        )

    def wrist_path(self, own: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Reference wrist pose."""
        return np.asarray(own["position"])[None], np.asarray(own["quaternion"])

    def initial_fingers(self, goal: Goal) -> tuple[Array, Array]:
        """Reference finger angles (paper, section Hand Initialization)."""
        return goal.active["pose_finger"], goal["pose"].q

    def features(
        self, hand: Hand, contacts: Contacts, features: Features, goal: Goal
    ) -> PoseFeatures:
        """Keypoints of the reference pose."""
        own = goal["pose"]
        points = kinematics.keypoints(hand, kinematics.link_transforms(hand, own.q))
        points = rotations.transform(own.position, own.quaternion, points)
        return PoseFeatures(
            rotations.transform(features.object_position, features.object_quaternion, points)
        )

    def guidance(self, scene: Scene, *, current: bool) -> tuple[Array, Array]:
        """Reference wrist pose in the world frame."""
        own = scene.goal["pose"]
        return in_world(*object_pose(scene, current=current), own.position, own.quaternion)

    def observe(self, scene: Scene) -> tuple[list[Array], ...]:
        """Residuals q-bar - q and x-bar - x; u-bar - u."""
        own, state, features = scene.goal["pose"], scene.state, scene.features
        fingers = [own.q - state.q, flat(features.of["pose"].keypoints - features.keypoints)]
        wrist = in_world(
            state.object_position, state.object_quaternion, own.position, own.quaternion
        )
        return fingers, [wrist_to_joints(state, *wrist) - state.u]

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Reward term r^pose."""
        own, state, features, active = scene.goal["pose"], scene.state, scene.features, scene.gate
        position, quaternion = in_world(
            state.object_position, state.object_quaternion, own.position, own.quaternion
        )
        gate = pose_gate(jnp.min(jnp.linalg.norm(features.nearest, axis=-1), -1)) * active(
            "pose_finger"
        )
        far = jnp.minimum(square(features.wrist_position - position), _FAR**2)
        turned = jnp.minimum(rotations.angle(features.wrist_quaternion, quaternion), _TURNED)
        return {
            "pose_finger": -gate * square(state.q - own.q),
            "pose_link": -gate
            * jnp.sum(square(features.of["pose"].keypoints - features.keypoints), -1),
            "pose_wrist_position": -active("pose_wrist") * far,
            "pose_wrist_rotation": -active("pose_wrist") * turned**2,
        }

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Mean absolute error of the finger joints and the three wrist hinges; distance of the
        wrist.
        """
        own, state = scene.goal["pose"], scene.state
        position, quaternion = in_world(
            state.object_position, state.object_quaternion, own.position, own.quaternion
        )
        hinges = wrist_to_joints(state, position, quaternion)[..., 3:] - state.u[..., 3:]
        angles = jnp.concatenate([state.q - own.q, hinges], -1)
        return {
            "pose_rad": jnp.mean(jnp.abs(angles), -1),
            "pose_m": jnp.linalg.norm(scene.features.wrist_position - position, axis=-1),
        }

    def parse(
        self, given: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Returns the arrays of the file."""
        return given["pose"]

    def markers(self, own: PoseGoal, blocks: Collection[str]) -> tuple[Marker, ...]:
        """Ghost of the reference hand, or of its wrist only."""
        return (Ghost(own.position, own.quaternion, own.q if "pose_finger" in blocks else None),)

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """Effect of the pose: it guides wrist and fingers, or only the fingers."""
        if overridden:
            return [
                "Only the fingers of the reference pose count: the trajectory determines the wrist."
            ]
        return ["The reference pose guides wrist and fingers; the heading follows from it."]


def pose_gate(distance: Array) -> Array:
    """Gate g(d) that rises linearly from 0 at 0.10 m to 1 at 0.03 m between hand and object."""
    return jnp.clip((_GATE_FAR - distance) / (_GATE_FAR - _GATE_NEAR), 0.0, 1.0)


def _apart_from_heading(hand: Hand, surface: Surface, goal: Goal) -> dict[str, Array]:
    """Angle (B,) in rad between the heading and that of the reference."""
    return {"turn": heading_turn(hand, goal["heading"], goal["pose"].quaternion)}


def _heading_message(hand: Hand, apart: Mapping[str, Any]) -> str:
    return heading_message("pose", apart["turn"])


def heading_message(stronger: str, turn: float) -> str:
    """Message for a heading that contradicts a stronger constraint by an angle in rad."""
    return (
        f"The heading differs by {np.degrees(turn):.0f} degrees from the approach of the "
        f"{stronger}. The "
        f"{stronger} overrides it: the heading follows from it."
    )


def _touches(hand: Hand, surface: Surface, goal: Goal) -> dict[str, Array]:
    """(B, P) bool: keypoints of the reference pose that would touch the avoid region."""
    own = goal["pose"]
    points = kinematics.keypoints(hand, kinematics.link_transforms(hand, own.q))
    points = rotations.transform(own.position, own.quaternion, points)
    away = squared_distances(surface.points, points)
    avoid = jnp.min(jnp.where(surface.avoid[..., None], away, jnp.inf), -2)
    graspable = jnp.min(jnp.where(surface.avoid[..., None], jnp.inf, away), -2)
    return {"touching": (avoid < TOUCHING**2) & (avoid < graspable)}


def _affordance_message(hand: Hand, apart: Mapping[str, Any]) -> str:
    names = dict.fromkeys(
        hand.links[hand.keypoint_links[i]].name for i in np.flatnonzero(apart["touching"])
    )
    return (
        f"In the reference pose, {', '.join(names)} would touch the avoid region. The pose defines "
        f"the contacts "
        "and overrides the affordance."
    )


Pose.relations = (
    Relation(
        "affordance",
        "overridden",
        _touches,
        lambda apart: jnp.any(apart["touching"], -1),
        _affordance_message,
    ),
    Relation(
        "heading",
        "overridden",
        _apart_from_heading,
        lambda apart: apart["turn"] > TURNED,
        _heading_message,
    ),
)
