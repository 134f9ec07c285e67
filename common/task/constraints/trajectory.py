"""Wrist trajectory: path of the approaching wrist."""

from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.task.constraints.base import (
    Constraint,
    ErrorSpec,
    GoalArray,
    Marker,
    ObservationField,
    Option,
    Polyline,
    Relation,
    Scene,
    Weight,
)
from congrasp.common.task.constraints.fingers import chosen_fingers
from congrasp.common.task.constraints.heading import (
    TURNED,
    heading_of_wrist,
    heading_turn,
    object_pose,
)
from congrasp.common.task.constraints.pose import disturbed_wrist, heading_message, wrist_numbers
from congrasp.common.task.geometry import flat, in_world, least_distance, square, wrist_to_joints
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.settings import TaskSettings
from congrasp.common.task.types import Array, Goal, Surface

APART = 0.02
"""Distance between a pose's wrist and a trajectory's end above which they contradict, m."""
TWISTED = 0.3
"""Angle between their orientations above which they contradict, rad."""
CLOSED = 0.4
"""Closure, between the open hand and the fist, at which the hand centre is computed if no pose
gives the fingers. Median distance to the centres of closed reference poses, for the shares 0, 0.4,
0.5 and 1: human 21, 19, 19 and 42 mm, Allegro 32, 26, 24 and 46 mm, Sharpa 25, 19, 20 and 51 mm
(432, 398 and 417 poses on 32 objects of all families)."""
_FAR, _TURNED = 0.15, 0.5
"""Errors (m, rad) beyond which the tracking cost saturates."""


class TrajectoryGoal(NamedTuple):
    """Wrist poses from the first, distant one to the grasp, object frame."""

    position: Annotated[Array, GoalArray(("K", 3), "m, object frame: wrist waypoints", "position")]
    quaternion: Annotated[
        Array,
        GoalArray(
            ("K", 4), "wrist frame to object frame", "quaternion", neutral=(1.0, 0.0, 0.0, 0.0)
        ),
    ]


class Trajectory(Constraint):
    """A sequence of wrist poses (paper, section Constraint Formulation)."""

    name, title, goal = "trajectory", "wrist trajectory", TrajectoryGoal
    blocks = ("trajectory",)
    overrides = ("heading", "pose_wrist")
    guides = "trajectory"
    from_reference, harvested = True, False
    weights = (
        Weight(
            "trajectory_position",
            20.0,
            "w_traj-p: per square metre between the wrist and the active waypoint.",
        ),
        Weight(
            "trajectory_rotation",
            0.5,
            "w_traj-q: per square radian between the wrist and the active waypoint.",
        ),
    )
    errors = (
        ErrorSpec(
            "trajectory_rad",
            "rad",
            "approach",
            0.3,
            0.2,
            "angle of the wrist to the waypoint",
            "traj_rad",
        ),
        ErrorSpec(
            "trajectory_m",
            "m",
            "approach",
            0.03,
            0.03,
            "distance of the wrist from the waypoint",
            "traj_m",
        ),
    )
    options = (
        Option(
            "trajectory",
            "Wrist path: a grasp.npz, a constraint set, JSON with position and quaternion, CSV (x "
            "y z w x y z), "
            "or BVH (cm, y up; FILE:JOINT, RightHand by default).",
            "path",
        ),
    )

    def fields(self, hand: Hand, task: TaskSettings) -> tuple[tuple[ObservationField, ...], ...]:
        """Fields for residuals of the virtual wrist joints, of every waypoint."""
        size, meaning = (
            6 * task.trajectory_points,
            "m and rad, wrist joints of every waypoint minus the current ones",
        )
        return ((ObservationField("waypoint_u - u", size, meaning),),)

    def allowed(self, draw: Draw) -> Array:
        """References clear of the table that agree with an affordance, if one is requested (region
        1).
        """
        ends = draw.bank.trajectory_position[draw.objects, draw.region, :, -1]
        return draw.allowed & jax.vmap(_agrees, (None, 1), 1)(draw, ends)

    def numbers(self, hand: Hand, task: TaskSettings) -> int:
        """Those of a disturbed wrist."""
        return wrist_numbers(task.trajectory_points)

    def joined(
        self, task: TaskSettings, active: Mapping[str, Array], uniform: Array
    ) -> Array | None:
        """Episodes with an affordance, with probability `p_together`."""
        return (
            active["affordance"] & (uniform < task.p_together) if "affordance" in active else None
        )

    def sample(self, hand: Hand, draw: Draw, uniform: Array) -> TrajectoryGoal:
        """Samples the trajectory to one of the object's reference poses.

        A disturbance that would make it contradict an affordance is dropped.
        """
        index = draw.objects, draw.region, draw.reference["trajectory"]
        path = TrajectoryGoal(
            draw.bank.trajectory_position[index], draw.bank.trajectory_quaternion[index]
        )
        if draw.disturbance is None:
            return path
        disturbed = TrajectoryGoal(*disturbed_wrist(*path, draw.disturbance, uniform))
        kept = _agrees(draw, disturbed.position[:, -1])[:, None, None]
        return TrajectoryGoal(
            *(jnp.where(kept, *pair) for pair in zip(disturbed, path, strict=True))
        )

    def override(
        self, hand: Hand, surface: Surface, asked: Mapping[str, Array], goal: Goal
    ) -> Goal:
        """Replaces the wrist of a reference pose by the last waypoint, and the heading by the
        waypoint's.

        The heading's position is the hand centre with the pose's fingers or, without a pose, of a
        partly closed hand.
        """
        here, last = asked["trajectory"], last_waypoint(goal)
        q = jnp.broadcast_to(jnp.array(closing(hand)), (here.shape[0], len(hand.joints)))
        if "pose" in goal.values:
            q = jnp.where(asked["pose"][:, None], goal["pose"].q, q)
            goal = goal.where(here, "pose", position=last[0], quaternion=last[1])
        return goal.where(
            here, "heading", **heading_of_wrist(hand, q, *last, chosen_fingers(asked, goal))
        )

    def wrist_path(self, own: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Waypoints."""
        return np.asarray(own["position"]), np.asarray(own["quaternion"])[-1]

    def initial_wrist(
        self, hand: Hand, back_off: Array, goal: Goal, q: Array
    ) -> tuple[Array, Array, Array]:
        """First waypoint (paper, section Hand Initialization)."""
        own = goal["trajectory"]
        return goal.active["trajectory"], own.position[:, 0], own.quaternion[:, 0]

    def guidance(self, scene: Scene, *, current: bool) -> tuple[Array, Array]:
        """Waypoint after the one nearest to the wrist."""
        return tracked_waypoint(scene, current=current)

    def observe(self, scene: Scene) -> tuple[list[Array], ...]:
        """Residuals u-bar^(k) - u of every waypoint."""
        own, state = scene.goal["trajectory"], scene.state
        waypoints = in_world(
            state.object_position, state.object_quaternion, own.position, own.quaternion
        )
        return ([flat(wrist_to_joints(state, *waypoints) - state.u[..., None, :])],)

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Reward term r^traj."""
        active, features = scene.gate("trajectory"), scene.features
        position, quaternion = tracked_waypoint(scene, current=True)
        far = jnp.minimum(square(features.wrist_position - position), _FAR**2)
        turned = jnp.minimum(rotations.angle(features.wrist_quaternion, quaternion), _TURNED)
        return {"trajectory_position": -active * far, "trajectory_rotation": -active * turned**2}

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Angle and distance between the wrist and the tracked waypoint."""
        position, quaternion = tracked_waypoint(scene, current=True)
        return {
            "trajectory_rad": rotations.angle(scene.features.wrist_quaternion, quaternion),
            "trajectory_m": jnp.linalg.norm(scene.features.wrist_position - position, axis=-1),
        }

    def parse(
        self, given: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Returns the waypoints of the file."""
        return given["trajectory"]

    def markers(self, own: TrajectoryGoal, blocks: Collection[str]) -> tuple[Marker, ...]:
        """Path of the wrist."""
        return (Polyline(own.position),)

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """Effect of the trajectory: it guides the wrist."""
        return [
            "The wrist trajectory guides the wrist; the heading follows from its last waypoint."
        ]


def closing(hand: Hand) -> np.ndarray:
    """Finger angles (F,) q_open + 0.4 (q_closed - q_open), for estimating the hand centre of an
    unknown grasp.
    """
    return np.asarray(hand.q_open + CLOSED * (hand.q_closed - hand.q_open), np.float32)


def last_waypoint(goal: Goal) -> tuple[Array, Array]:
    """Wrist pose (B, 3), (B, 4) at the end of the trajectory, object frame."""
    own = goal["trajectory"]
    return own.position[:, -1], own.quaternion[:, -1]


def active_waypoint(wrist_position: Array, waypoints: Array, lookahead: int) -> Array:
    """Index (B,) min(k* + lookahead, K - 1), where k* is the waypoint (B, K, 3) nearest to the
    wrist (B, 3).
    """
    nearest = jnp.argmin(jnp.sum((waypoints - wrist_position[..., None, :]) ** 2, -1), -1)
    return jnp.minimum(nearest + lookahead, waypoints.shape[-2] - 1)


def tracked_waypoint(scene: Scene, *, current: bool) -> tuple[Array, Array]:
    """World pose (B, 3), (B, 4) of the active waypoint, relative to the object's current or initial
    pose.

    Guidance, reward and errors use the same waypoint, selected with the object's pose of the
    guidance.
    """
    own, control = scene.goal["trajectory"], scene.task.control
    guiding, _ = in_world(
        *object_pose(scene, current=control.follow_object), own.position, own.quaternion
    )
    index = active_waypoint(scene.features.wrist_position, guiding, control.lookahead)[
        ..., None, None
    ]
    position, quaternion = (jnp.take_along_axis(array, index, -2)[..., 0, :] for array in own)
    return in_world(*object_pose(scene, current=current), position, quaternion)


def _apart_from_pose(hand: Hand, surface: Surface, goal: Goal) -> dict[str, Array]:
    """Distance (m) and angle (rad) between the reference pose's wrist and the trajectory's end."""
    position, quaternion = last_waypoint(goal)
    return {
        "apart": jnp.linalg.norm(goal["pose"].position - position, axis=-1),
        "twist": rotations.angle(goal["pose"].quaternion, quaternion),
    }


def _pose_message(hand: Hand, apart: Mapping[str, Any]) -> str:
    return (
        f"The reference pose puts the wrist {100 * apart['apart']:.1f} cm and "
        f"{np.degrees(apart['twist']):.0f} "
        "degrees from the trajectory's end. The trajectory determines the wrist; only the fingers "
        "of the pose "
        "count."
    )


def _apart_from_regions(surface: Surface, end: Array) -> dict[str, Array]:
    """Distances in m from a trajectory's end (B, 3) to either region."""
    return {
        "avoid": least_distance(surface.points, surface.avoid, end),
        "graspable": least_distance(surface.points, ~surface.avoid, end),
    }


def _agrees(draw: Draw, end: Array) -> Array:
    """(B,) bool: trajectories that end at (B, 3) agree with the affordance of a draw, or it has
    none (region 0).
    """
    surface = Surface(draw.bank.points[draw.objects], draw.bank.avoid[draw.objects])
    return (draw.region == 0) | ~_contradicts_affordance(_apart_from_regions(surface, end))


def _contradicts_affordance(apart: Mapping[str, Array]) -> Array:
    """(B,) bool: the trajectory ends no farther from the avoid region than from the graspable
    one.
    """
    return apart["avoid"] <= apart["graspable"]


def _affordance_message(hand: Hand, apart: Mapping[str, Any]) -> str:
    return (
        f"The trajectory ends {100 * apart['avoid']:.1f} cm from the avoid region, and "
        f"{100 * apart['graspable']:.1f} cm from the graspable region. Neither overrides the "
        f"other: let it end "
        "nearer to the graspable region, or remove one of the two."
    )


def _apart_from_heading(hand: Hand, surface: Surface, goal: Goal) -> dict[str, Array]:
    return {"turn": heading_turn(hand, goal["heading"], last_waypoint(goal)[1])}


Trajectory.relations = (
    Relation(
        "pose",
        "overridden",
        _apart_from_pose,
        lambda apart: (apart["apart"] > APART) | (apart["twist"] > TWISTED),
        _pose_message,
    ),
    Relation(
        "affordance",
        "refused",
        lambda hand, surface, goal: _apart_from_regions(surface, last_waypoint(goal)[0]),
        _contradicts_affordance,
        _affordance_message,
    ),
    Relation(
        "heading",
        "overridden",
        _apart_from_heading,
        lambda apart: apart["turn"] > TURNED,
        lambda hand, apart: heading_message("trajectory", apart["turn"]),
    ),
)
