"""Help and function of each reward term belong together: the paper's symbol, and the one quantity
that changes it.
"""

import dataclasses
import re
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common import rotations
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.reward import GRASP, reward_terms, terms
from tests.scenes import HAND, L, evaluated, near_targets, scene, scene_of

TASK, X = TaskConfig(), np.array([1.0, 0.0, 0.0])
turned = partial(rotations.multiply, rotations.from_rotation_vector(0.2 * X))
# Links of thumb and index finger
PRESSING, HARD, SOFT, FREE = np.flatnonzero(np.isin(HAND.link_fingers, (0, 1)))[:4]
LITTLE = HAND.link_fingers == 4
DOCS = (
    "distance from",
    "links in contact",
    "shares of",
    "newtons beyond",
    "displacement",
    "rotation",
    "i_drop",
)
"""Words in the docstrings of the grasp terms' functions, in order."""


def add(by, *index):
    """A change of an array's elements in all environments."""
    return lambda array: jnp.asarray(array).at[:, *index].add(by)


# The beginning of the help, the array on which alone the term's value depends in `base`, and a
# change of it.
CASES = {
    "distance": ("w_dis:", "features.nearest", add(0.1, 0, 0)),
    "contact": ("w_c:", "features.touching", lambda flags: flags | (np.arange(L) == FREE)),
    "force": ("w_f:", "features.force", add(0.5, PRESSING, 0)),
    "force_excess": ("Penalty per newton above `force_max`", "features.force", add(0.5, SOFT, 0)),
    "object_position": ("w_o:", "state.object_position_initial", add(-0.9, 0)),
    "object_rotation": ("w_R:", "state.object_quaternion_initial", turned),
    "wrist_velocity": ("w_u:", "state.u_velocity", add(0.5, 0)),
    "finger_deviation": ("w_q of the regulariser:", "state.q_initial", add(0.1, 0)),
    "drop": ("w_drop:", "state.object_position_initial", add(0.06, 2)),
    "heading_direction": ("w_dir:", "features.of.heading.direction", add(0.1)),
    "heading_position": ("w_pos:", "features.of.heading.position", add(0.03, 0)),
    "affordance_distance": ("w_d:", "features.of.affordance.distance", add(-0.008)),
    "affordance_force": (
        "w_f of the affordance term:",
        "features.of.affordance.force",
        add(1.0, HARD, 0),
    ),
    "pose_finger": ("w_q of the pose term:", "goal.values.pose.q", add(0.1, 0)),
    "pose_link": ("w_x:", "features.of.pose.keypoints", add(0.05, 0, 0)),
    "pose_wrist_position": ("w_p:", "goal.values.pose.position", add(0.02, 0)),
    "pose_wrist_rotation": ("w_R of the pose term:", "goal.values.pose.quaternion", turned),
    "trajectory_position": (
        "w_traj-p:",
        "goal.values.trajectory.position",
        add(0.02, slice(None), 0),
    ),
    "trajectory_rotation": ("w_traj-q:", "goal.values.trajectory.quaternion", turned),
    "fingers_distance": (
        "For each unit of softplus(",
        "features.nearest",
        add(-0.005, LITTLE[HAND.keypoint_links], 0),
    ),
    "fingers_contact": (
        "For each link of another finger",
        "features.touching",
        lambda flags: flags | LITTLE,
    ),
    "force_over": ("Per newton beyond the limit", "goal.values.force.limit", add(1.0)),
}
HELP = {
    entry.name: entry.meaning
    for entry in (*GRASP, *(weight for c in CONSTRAINTS for weight in c.weights))
}


def test_each_symbol_begins_the_help_of_its_term_and_is_in_no_other():
    begins = {name: begin for name, (begin, *_) in CASES.items()} | {"force_max": "f_max,"}
    assert begins.keys() == HELP.keys() and len({*begins.values()}) == len(HELP)
    for name, text in HELP.items():
        symbols = re.findall(r"\bw_[\w-]+|\bf_max\b", text)
        assert text.startswith(begins[name]) and symbols == re.findall(
            r"w_[\w-]+|f_max", begins[name]
        ), (name, text)
    docs = [term.value.__doc__.lower() for term in GRASP if term.value and term.value.__doc__]
    assert all(words in text for words, text in zip(DOCS, docs, strict=True))


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
    found = scene_of(TASK, state, surface, goal)
    for path, value in {
        "state.object_position_initial": state.object_position
        + X,  # beyond 0.2 m, where the cost saturates
        "state.object_quaternion_initial": state.object_quaternion,
        "features.nearest": 0.02 * X,
        "features.force": force,
        "features.touching": np.arange(L) == PRESSING,
        "features.of.affordance.distance": 0.02,
        "features.of.affordance.force": 0.0,
        "features.of.affordance.touching_graspable": True,
        "goal.values.trajectory.position": goal["pose"].position[:, None],
        "goal.values.trajectory.quaternion": goal["pose"].quaternion[:, None],
        "goal.values.fingers.allowed": np.arange(len(HAND.fingers)) < 2,
        "goal.values.force.limit": 8.0,
    }.items():
        found = replaced(
            found,
            path,
            lambda old, value=value: np.broadcast_to(value, old.shape).astype(old.dtype),
        )
    return found, evaluated(reward_terms, found, RewardWeights())


@pytest.mark.parametrize("name", terms(TASK))
def test_a_quantity_changes_its_term_alone(name, base):
    found, before = base
    after = evaluated(reward_terms, replaced(found, *CASES[name][1:]), RewardWeights())
    assert {other for other, value in after.items() if np.any(value != before[other])} == {name}
    assert np.all(after[name] != before[name])
