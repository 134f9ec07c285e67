"""Each reward term depends on one quantity, which no other term depends on."""

import dataclasses
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common import rotations
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.reward import reward_terms
from tests.scenes import HAND, L, evaluated, near_targets, scene, scene_of

TASK = TaskConfig()
X = np.array([1.0, 0.0, 0.0])
turned = partial(rotations.multiply, rotations.from_rotation_vector(0.2 * X))
# Links of thumb and index finger
PRESSING, HARD, SOFT, FREE = np.flatnonzero(np.isin(HAND.link_fingers, (0, 1)))[:4]
LITTLE = HAND.link_fingers == 4


def add(by, *index):
    """A change of an array's elements in all environments."""
    return lambda array: jnp.asarray(array).at[:, *index].add(by)


# The array on which alone the term's value depends in `base`, and a change of it.
CASES = {
    "distance": ("features.nearest", add(0.1, 0, 0)),
    "contact": ("features.touching", lambda flags: flags | (np.arange(L) == FREE)),
    "force": ("features.force", add(0.5, PRESSING, 0)),
    "force_excess": ("features.force", add(0.5, SOFT, 0)),
    "object_position": ("state.object_position_initial", add(-0.9, 0)),
    "object_rotation": ("state.object_quaternion_initial", turned),
    "wrist_velocity": ("state.u_velocity", add(0.5, 0)),
    "finger_deviation": ("state.q_initial", add(0.1, 0)),
    "drop": ("state.object_position_initial", add(0.06, 2)),
    "heading_direction": ("features.by_constraint.heading.direction", add(0.1)),
    "heading_position": ("features.by_constraint.heading.position", add(0.03, 0)),
    "affordance_distance": ("features.by_constraint.affordance.distance", add(-0.008)),
    "affordance_force": (
        "features.by_constraint.affordance.force",
        add(1.0, HARD, 0),
    ),
    "pose_finger": ("goal.values.pose.q", add(0.1, 0)),
    "pose_link": ("features.by_constraint.pose.keypoints", add(0.05, 0, 0)),
    "pose_wrist_position": ("goal.values.pose.position", add(0.02, 0)),
    "pose_wrist_rotation": ("goal.values.pose.quaternion", turned),
    "trajectory_position": (
        "goal.values.trajectory.position",
        add(0.02, slice(None), 0),
    ),
    "trajectory_rotation": ("goal.values.trajectory.quaternion", turned),
    "fingers_distance": (
        "features.nearest",
        add(-0.005, LITTLE[HAND.keypoint_links], 0),
    ),
    "fingers_contact": (
        "features.touching",
        lambda flags: flags | LITTLE,
    ),
    "force_over": ("goal.values.force.limit", add(1.0)),
}


def replaced(thing, path, change):
    """A copy of nested fields in which the array at a path is changed."""
    name, _, rest = path.partition(".")
    old = thing[name] if isinstance(thing, dict) else getattr(thing, name)
    new = {name: replaced(old, rest, change) if rest else change(np.array(old))}
    if isinstance(thing, dict):
        return thing | new
    return (
        dataclasses.replace(thing, **new)
        if dataclasses.is_dataclass(thing)
        else thing._replace(**new)
    )


@pytest.fixture(scope="module")
def base():
    """The hand near the object and its targets; only the thumb and the index finger are allowed to
    touch.
    """
    state, surface, goal = scene(0)
    goal, force = near_targets(state, goal, 0), np.zeros((L, 3))
    force[[PRESSING, HARD, SOFT], 0] = 1.0, 12.0, 6.0  # of which the first is in contact
    base_scene = scene_of(TASK, state, surface, goal)
    for path, value in {
        "state.object_position_initial": state.object_position
        + X,  # beyond 0.2 m, where the cost saturates
        "state.object_quaternion_initial": state.object_quaternion,
        "features.nearest": 0.02 * X,
        "features.force": force,
        "features.touching": np.arange(L) == PRESSING,
        "features.by_constraint.affordance.distance": 0.02,
        "features.by_constraint.affordance.force": 0.0,
        "features.by_constraint.affordance.touching_graspable": True,
        "goal.values.trajectory.position": goal["pose"].position[:, None],
        "goal.values.trajectory.quaternion": goal["pose"].quaternion[:, None],
        "goal.values.fingers.allowed": np.arange(len(HAND.fingers)) < 2,
        "goal.values.force.limit": 8.0,
    }.items():
        base_scene = replaced(
            base_scene,
            path,
            lambda old, value=value: np.broadcast_to(value, old.shape).astype(old.dtype),
        )
    return base_scene, evaluated(reward_terms, base_scene, RewardWeights())


@pytest.mark.parametrize("name", CASES)
def test_quantity_changes_only_its_term(name, base):
    base_scene, before = base
    after = evaluated(reward_terms, replaced(base_scene, *CASES[name]), RewardWeights())
    assert {other for other, value in after.items() if np.any(value != before[other])} == {name}
    assert np.all(after[name] != before[name])


def test_natural_postures_count_only_where_no_pose_is_requested(base):
    """The index finger is hooked: all its joints are bent by 1.5 rad more than in the open hand,
    and it touches nothing.
    """
    weights = RewardWeights(posture=1.0)
    hooked = replaced(base[0], "features.touching", np.zeros_like)
    hooked = replaced(hooked, "state.q", add(1.5, HAND.link_fingers[HAND.joint_links] == 1))
    free = replaced(hooked, "goal.active.pose_finger", np.zeros_like)
    requested = replaced(hooked, "goal.active.pose_finger", np.ones_like)
    assert np.all(evaluated(reward_terms, free, weights)["posture"] < -0.05)
    assert np.all(evaluated(reward_terms, requested, weights)["posture"] == 0.0)
