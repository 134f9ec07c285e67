"""Configuration of the task: settings, reward weights and probabilities of the constraints.

Weights and probabilities repeat name, default and meaning of the rows in
`common.task.reward.GRASP` and `common.task.constraints.CONSTRAINTS`, so that editors and type
checkers know them; a test compares the two. Rows that a program outside the package adds before it
imports this module become fields here as well.
"""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Annotated, NamedTuple, TypeVar

from typing_extensions import Doc

from congrasp.common.task.constraints import CONSTRAINTS, OURS
from congrasp.common.task.reward import GRASP
from congrasp.common.task.sensors import SENSORS
from congrasp.common.task.settings import ControlConfig, SensingConfig, TaskSettings

__all__ = ["SENSORS", "ControlConfig", "RewardWeights", "SensingConfig", "TaskConfig"]

_Class = TypeVar("_Class")


class _Setting(NamedTuple):
    """A number of the configuration."""

    name: str
    default: float
    meaning: str
    """Its help on the command line."""


def _weights() -> list[_Setting]:
    """Weights of all reward terms, those of the grasp first."""
    weights = [_Setting(term.name, term.default, term.meaning) for term in GRASP]
    for constraint in CONSTRAINTS:
        weights += [_Setting(*weight) for weight in constraint.weights]
    return weights


def _probabilities() -> list[_Setting]:
    """Probabilities of the constraints that may be inactive."""
    probabilities = []
    for constraint in CONSTRAINTS:
        if not constraint.optional:
            continue
        meaning = (
            f"Probability that an episode has the constraint '{constraint.name}', where the object "
            f"allows it."
        )
        probabilities.append(_Setting(f"p_{constraint.name}", 0.5, meaning))
    return probabilities


def _with_outside_fields(settings: Iterable[_Setting]) -> Callable[[type[_Class]], type[_Class]]:
    """Decorator that adds settings of outside extensions, which a class does not list."""

    def extend(cls: type[_Class]) -> type[_Class]:
        for setting in settings:
            if setting.name in cls.__annotations__:
                continue
            cls.__annotations__[setting.name] = Annotated[float, Doc(setting.meaning)]
            setattr(cls, setting.name, setting.default)
        return cls

    return extend


@dataclasses.dataclass(frozen=True)
@_with_outside_fields(_weights())
class RewardWeights:
    """Weights of all reward terms, of the grasp and of each constraint, in units of reward per
    control step.
    """

    distance: float = 0.3
    """w_dis: per metre of the weighted distance from the hand's keypoints to the object's surface
    (0.3 m at most)."""
    contact: float = 1.0
    """w_c: for all links in contact (weighted by the links' contact weights, which sum to one)."""
    force: float = 0.5
    """w_f: for all links pressing with `force_max` or more."""
    force_max: float = 5.0
    """f_max, N per link: force beyond it earns nothing."""
    force_excess: float = 0.01
    """Penalty per newton above `force_max`, per link (ours: the paper only clamps, and hands then
    squeeze hard)."""
    force_per_weight: float = 0.0
    """Growth of `force_max` with the object's weight, N per N: what is heavy may be pressed harder
    (ours)."""
    grip: float = 0.0
    """For contacts that can resist twice the object's weight and twice its torque (ours, see
    `common.task.grip`)."""
    posture: float = 0.0
    """Per square radian of the fingers' deviation from natural postures (ours, see
    `common.task.posture`)."""
    object_position: float = 20.0
    """w_o: per square metre of the object's displacement (at most 0.04 m^2)."""
    object_rotation: float = 0.1
    """w_R: per square radian of the object's rotation (at most 1 rad^2)."""
    wrist_velocity: float = 0.01
    """w_u: per squared velocity of the six wrist joints (m/s and rad/s)."""
    finger_deviation: float = 0.002
    """w_q of the regulariser: per squared radian from the initial finger pose."""
    drop: float = 1.0
    """w_drop: per step with the object fallen."""
    heading_direction: float = 0.3
    """w_dir: for the heading axis along the target direction (cosine)."""
    heading_position: float = 3.0
    """w_pos: per metre between hand centre and heading position."""
    affordance_distance: float = 0.05
    """w_d: for each unit of softplus((m - d)/tau) near the avoid region."""
    affordance_force: float = 0.1
    """w_f of the affordance term: per newton on the avoid region (clipped at 10 N per link)."""
    pose_finger: float = 0.1
    """w_q of the pose term: per squared radian of the finger joints, gated by the hand's
    distance."""
    pose_link: float = 5.0
    """w_x: per square metre of the finger links' positions, gated by the hand's distance."""
    pose_wrist_position: float = 20.0
    """w_p: per square metre of the wrist's position."""
    pose_wrist_rotation: float = 0.5
    """w_R of the pose term: per square radian of the wrist's rotation."""
    trajectory_position: float = 20.0
    """w_traj-p: per square metre between the wrist and the active waypoint."""
    trajectory_rotation: float = 0.5
    """w_traj-q: per square radian between the wrist and the active waypoint."""
    fingers_distance: float = 0.02
    """For each unit of softplus((margin - d)/sharpness), finger by finger."""
    fingers_contact: float = 0.3
    """For each link of another finger that touches the object."""
    force_over: float = 0.05
    """Per newton beyond the limit, per link (at most 10 N each)."""


@dataclasses.dataclass(frozen=True)
@_with_outside_fields(_probabilities())
class ConstraintProbabilities:
    """Probabilities of the constraints in training."""

    p_affordance: float = 0.5
    """Probability that an episode has the constraint 'affordance', where the object allows it."""
    p_pose: float = 0.5
    """Probability that an episode has the constraint 'pose', where the object allows it."""
    p_trajectory: float = 0.5
    """Probability that an episode has the constraint 'trajectory', where the object allows it."""
    p_fingers: float = 0.5
    """Probability that an episode has the constraint 'fingers', where the object allows it."""
    p_force: float = 0.5
    """Probability that an episode has the constraint 'force', where the object allows it."""


@dataclasses.dataclass(frozen=True)
class TaskConfig(TaskSettings, ConstraintProbabilities):
    """The task: hand, timing, observation, control, reward and constraint sampling."""

    constraints: tuple[str, ...] = OURS
    """Constraints that the policy supports: it observes them, and requests may contain them."""
    reward: RewardWeights = RewardWeights()
    """Weights of the reward terms."""
