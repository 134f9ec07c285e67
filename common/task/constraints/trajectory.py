"""Wrist trajectory: path of the approaching wrist."""

from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from congrasp.common import rotations
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.lazy_jax import jax, jnp
from congrasp.common.task.constraints.base import Constraint
from congrasp.common.task.constraints.disturbance import disturbed_wrist, wrist_numbers
from congrasp.common.task.constraints.fingers import chosen_fingers
from congrasp.common.task.constraints.heading import (
    TURNED,
    heading_of_wrist,
    heading_turn,
    object_pose,
)
from congrasp.common.task.constraints.markers import Marker, Polyline
from congrasp.common.task.constraints.pose import heading_message
from congrasp.common.task.constraints.specs import (
    ErrorSpec,
    GoalArray,
    ObservationField,
    Option,
    Relation,
    Weight,
)
from congrasp.common.task.geometry import flat, in_world, least_distance, square, wrist_to_joints
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.scene import Scene
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
_MAX_COST_DISTANCE = 0.15
"""Distance from the waypoint beyond which the tracking cost saturates, m."""
_MAX_COST_ANGLE = 0.5
"""Angle to the waypoint beyond which the tracking cost saturates, rad."""


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

    name = "trajectory"
    title = "wrist trajectory"
    goal = TrajectoryGoal
    blocks = ("trajectory",)
    overrides = ("heading", "pose_wrist")
    guides = "trajectory"
    from_reference = True
    harvested = False
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
            name="trajectory_rad",
            unit="rad",
            window="approach",
            tolerance=0.3,
            scale=0.2,
            meaning="angle of the wrist to the waypoint",
            column="traj_rad",
        ),
        ErrorSpec(
            name="trajectory_m",
            unit="m",
            window="approach",
            tolerance=0.03,
            scale=0.03,
            meaning="distance of the wrist from the waypoint",
            column="traj_m",
        ),
    )
    options = (
        Option(
            "trajectory",
            "Wrist path: a grasp.npz, a constraint set (FILE:NUMBER), a JSON file with position "
            "and quaternion, a CSV file (x,y,z,qw,qx,qy,qz), or a BVH file (cm, y up; FILE:JOINT "
            "names the joint, RightHand by default).",
            "path",
        ),
    )

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
        if "affordance" not in active:
            return None
        return active["affordance"] & (uniform < task.p_together)

    def sample(self, hand: Hand, draw: Draw, uniform: Array) -> TrajectoryGoal:
        """Samples the trajectory to one of the object's reference poses.

        A disturbance that would make it contradict an affordance is dropped.
        """
        index = draw.objects, draw.region, draw.reference["trajectory"]
        position = draw.bank.trajectory_position[index]
        quaternion = draw.bank.trajectory_quaternion[index]
        if draw.disturbance is None:
            return TrajectoryGoal(position, quaternion)
        moved, turned = disturbed_wrist(position, quaternion, draw.disturbance, uniform)
        agrees = _agrees(draw, moved[:, -1])[:, None, None]
        return TrajectoryGoal(
            position=jnp.where(agrees, moved, position),
            quaternion=jnp.where(agrees, turned, quaternion),
        )

    def override(
        self, hand: Hand, surface: Surface, requested: Mapping[str, Array], goal: Goal
    ) -> Goal:
        """Replaces the wrist of a reference pose by the last waypoint, and the heading by the
        waypoint's.

        The heading's position is the hand centre with the pose's fingers or, without a pose, of a
        partly closed hand.
        """
        mask = requested["trajectory"]
        position, quaternion = last_waypoint(goal)
        q = jnp.broadcast_to(jnp.array(closing(hand)), (mask.shape[0], len(hand.joints)))
        if "pose" in goal.values:
            q = jnp.where(requested["pose"][:, None], goal["pose"].q, q)
            goal = goal.where(mask, "pose", position=position, quaternion=quaternion)
        fingers = chosen_fingers(requested, goal)
        heading = heading_of_wrist(hand, q, position, quaternion, fingers)
        return goal.where(mask, "heading", **heading)

    def explain(self, overridden: Sequence[str], redirected: bool) -> list[str]:
        """Effect of the trajectory: it guides the wrist."""
        return [
            "The wrist trajectory guides the wrist; the heading follows from its last waypoint."
        ]

    def initial_wrist(
        self, hand: Hand, back_off: Array, goal: Goal, q: Array
    ) -> tuple[Array, Array, Array]:
        """First waypoint (paper, section Hand Initialization)."""
        path = goal["trajectory"]
        return goal.active["trajectory"], path.position[:, 0], path.quaternion[:, 0]

    def guidance(self, scene: Scene, *, current: bool) -> tuple[Array, Array]:
        """Waypoint after the one nearest to the wrist."""
        return tracked_waypoint(scene, current=current)

    def fields(self, hand: Hand, task: TaskSettings) -> tuple[tuple[ObservationField, ...], ...]:
        """Fields for residuals of the virtual wrist joints, of every waypoint."""
        residuals = ObservationField(
            "waypoint_u - u",
            6 * task.trajectory_points,
            "m and rad, wrist joints of every waypoint minus the current ones",
        )
        return ((residuals,),)

    def observe(self, scene: Scene) -> tuple[list[Array], ...]:
        """Residuals u-bar^(k) - u of every waypoint."""
        state = scene.state
        path = scene.goal["trajectory"]
        waypoints = in_world(
            state.object_position, state.object_quaternion, path.position, path.quaternion
        )
        residuals = wrist_to_joints(state, *waypoints) - state.u[..., None, :]
        return ([flat(residuals)],)

    def reward(self, scene: Scene) -> dict[str, Array]:
        """Reward term r^traj."""
        active = scene.gate("trajectory")
        features = scene.features
        position, quaternion = tracked_waypoint(scene, current=True)
        away = jnp.minimum(square(features.wrist_position - position), _MAX_COST_DISTANCE**2)
        angle = rotations.angle(features.wrist_quaternion, quaternion)
        turned = jnp.minimum(angle, _MAX_COST_ANGLE)
        return {"trajectory_position": -active * away, "trajectory_rotation": -active * turned**2}

    def measure(self, scene: Scene) -> dict[str, Array | tuple[Array, Array]]:
        """Angle and distance between the wrist and the tracked waypoint."""
        position, quaternion = tracked_waypoint(scene, current=True)
        return {
            "trajectory_rad": rotations.angle(scene.features.wrist_quaternion, quaternion),
            "trajectory_m": jnp.linalg.norm(scene.features.wrist_position - position, axis=-1),
        }

    def parse(
        self, option_values: Mapping[str, Any], hand: Hand, obj: GraspObject
    ) -> dict[str, np.ndarray] | None:
        """Returns the waypoints of the file."""
        return option_values["trajectory"]

    def wrist_path(self, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Waypoints."""
        return np.asarray(values["position"]), np.asarray(values["quaternion"])[-1]

    def markers(self, values: TrajectoryGoal, blocks: Collection[str]) -> tuple[Marker, ...]:
        """Path of the wrist."""
        return (Polyline(values.position),)


def closing(hand: Hand) -> np.ndarray:
    """Finger angles (F,) q_open + 0.4 (q_closed - q_open), for estimating the hand centre of an
    unknown grasp.
    """
    return np.asarray(hand.q_open + CLOSED * (hand.q_closed - hand.q_open), np.float32)


def last_waypoint(goal: Goal) -> tuple[Array, Array]:
    """Wrist pose (B, 3), (B, 4) at the end of the trajectory, object frame."""
    path = goal["trajectory"]
    return path.position[:, -1], path.quaternion[:, -1]


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
    path = scene.goal["trajectory"]
    control = scene.task.control
    guiding_pose = object_pose(scene, current=control.follow_object)
    guiding, _ = in_world(*guiding_pose, path.position, path.quaternion)
    index = active_waypoint(scene.features.wrist_position, guiding, control.lookahead)
    index = index[..., None, None]
    position = jnp.take_along_axis(path.position, index, -2)[..., 0, :]
    quaternion = jnp.take_along_axis(path.quaternion, index, -2)[..., 0, :]
    return in_world(*object_pose(scene, current=current), position, quaternion)


def _apart_from_pose(hand: Hand, surface: Surface, goal: Goal) -> dict[str, Array]:
    """Distance (m) and angle (rad) between the reference pose's wrist and the trajectory's end."""
    position, quaternion = last_waypoint(goal)
    return {
        "apart": jnp.linalg.norm(goal["pose"].position - position, axis=-1),
        "twist": rotations.angle(goal["pose"].quaternion, quaternion),
    }


def _contradicts_pose(apart: Mapping[str, Array]) -> Array:
    """(B,) bool: the trajectory ends at another wrist pose."""
    return (apart["apart"] > APART) | (apart["twist"] > TWISTED)


def _pose_message(hand: Hand, apart: Mapping[str, Any]) -> str:
    """Message for a pose whose wrist the trajectory overrides."""
    return (
        f"The reference pose puts the wrist {100 * apart['apart']:.1f} cm and "
        f"{np.degrees(apart['twist']):.0f} degrees from the trajectory's end. The trajectory "
        f"determines the wrist; only the fingers of the pose count."
    )


def _apart_from_affordance(hand: Hand, surface: Surface, goal: Goal) -> dict[str, Array]:
    """Distances in m from the trajectory's end to either region."""
    end, _ = last_waypoint(goal)
    return _apart_from_regions(surface, end)


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
    """Message for an affordance and a trajectory that cannot both be met."""
    return (
        f"The trajectory ends {100 * apart['avoid']:.1f} cm from the avoid region, and "
        f"{100 * apart['graspable']:.1f} cm from the graspable region. Neither overrides the "
        f"other: let it end nearer to the graspable region, or remove one of the two."
    )


def _apart_from_heading(hand: Hand, surface: Surface, goal: Goal) -> dict[str, Array]:
    """Angle (B,) in rad between the heading and that of the last waypoint."""
    _, quaternion = last_waypoint(goal)
    return {"turn": heading_turn(hand, goal["heading"], quaternion)}


def _contradicts_heading(apart: Mapping[str, Array]) -> Array:
    """(B,) bool: the heading differs from that of the last waypoint."""
    return apart["turn"] > TURNED


def _heading_message(hand: Hand, apart: Mapping[str, Any]) -> str:
    """Message for a heading that the trajectory overrides."""
    return heading_message("trajectory", apart["turn"])


Trajectory.relations = (
    Relation(
        weaker="pose",
        settled="overridden",
        measure=_apart_from_pose,
        contradicts=_contradicts_pose,
        message=_pose_message,
    ),
    Relation(
        weaker="affordance",
        settled="refused",
        measure=_apart_from_affordance,
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
