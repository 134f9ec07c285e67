"""Methods for comparison: the paper's method, its baselines and its ablations, each defined by its
changes to a run.

`congrasp train --method NAME` trains those that learn. The task of a policy records its method, and
`congrasp evaluate --method NAME` rejects policies of other methods.
"""

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from congrasp.common.config import CurriculumConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.task.config import TaskConfig

_NO_CHANGES: Mapping[str, Any] = MappingProxyType({})
STUDENT = "student"
"""Method of policies with a robot's sensors; `congrasp train --teacher` distils them."""
CAMERA = "camera"
"""Method of students with a depth camera instead of a tracker; `congrasp train --teacher NAME
--method camera`.
"""
STUDENTS = (STUDENT, CAMERA)
STATIONARY_SHARE = 0.6
"""Share of the updates with stationary objects, in training with two phases: the paper's 15 of 25
hours.
"""


def _unchanged(run: RunConfig) -> RunConfig:
    """Returns the run with its own curriculum."""
    return run


class Method(NamedTuple):
    """Changes by a method, and its requirements."""

    meaning: str
    """Description in help and tables."""
    task: Mapping[str, Any] = _NO_CHANGES
    """Changed fields of `TaskConfig`."""
    control: Mapping[str, Any] = _NO_CHANGES
    """Changed fields of `ControlConfig`."""
    weights: Mapping[str, float] = _NO_CHANGES
    """Changed fields of `RewardWeights`, also at the end of the curriculum's ramp."""
    schedule: Callable[[RunConfig], RunConfig] = _unchanged
    """Changes the curriculum of a run."""
    needs: tuple[str, ...] = ()
    """Constraints of which every episode must have one; empty if the heading is enough."""
    learns: bool = True
    """True if there is a policy to train; otherwise the actions are ignored."""


def _two_phases(run: RunConfig) -> RunConfig:
    """Stationary objects first, then free ones; the weights of the ramp's end apply from the change
    on.
    """
    stationary_updates = max(round(STATIONARY_SHARE * run.updates), 1)
    ramp = run.curriculum.ramp
    if run.curriculum.ramped:
        ramp = (stationary_updates - 1, stationary_updates)
    curriculum = dataclasses.replace(
        run.curriculum, stationary_updates=stationary_updates, ramp=ramp
    )
    return dataclasses.replace(run, curriculum=curriculum)


def _single_stage(run: RunConfig) -> RunConfig:
    """Free objects and the weights of the ramp's end from the first update on."""
    weights = run.curriculum.reward if run.curriculum.ramped else run.task.reward
    task = dataclasses.replace(run.task, reward=weights)
    return dataclasses.replace(run, curriculum=CurriculumConfig(), task=task)


METHODS = {
    "ours": Method(
        "one policy for every combination of constraints, objects free from the start, weights "
        "ramped"
    ),
    "pd": Method(
        "no learning: the wrist follows its guidance, then the fingers close from their initial "
        "angles to a fist",
        control={
            "finger_scale": 0.0,
            "wrist_position_scale": 0.0,
            "wrist_rotation_scale": 0.0,
            "finger_guidance": 0.05,
            "lookahead": 3,
        },
        needs=("pose", "trajectory"),
        learns=False,
    ),
    "graspxl": Method(
        "heading and affordance only, with the hand centre fixed at that of the initial fingers",
        task={"constraints": ("heading", "affordance"), "dynamic_center": False},
    ),
    "dgrasp": Method(
        "a reference pose in every episode and no other constraint: the heading is not rewarded",
        task={"constraints": ("heading", "pose"), "p_pose": 1.0, "own_references": False},
        weights={"heading_direction": 0.0, "heading_position": 0.0},
        needs=("pose",),
    ),
    "no-dynamic-center": Method(
        "the hand centre fixed at that of the initial fingers", task={"dynamic_center": False}
    ),
    "no-feedforward": Method(
        "the guidance aims at the nearest waypoint, not the next", control={"lookahead": 0}
    ),
    "two-phase": Method(
        "the paper's two phases: stationary objects, then free ones with larger constraint weights",
        schedule=_two_phases,
    ),
    "single-stage": Method(
        "free objects and the final weights from the start, no ramp", schedule=_single_stage
    ),
    STUDENT: Method(
        "no privileged observations: joints, wrist and a tracker's object poses over some steps, "
        "no forces and "
        "no velocities",
        task={"observation": "tracked"},
    ),
    CAMERA: Method(
        "no privileged observations: joints, wrist and a partial cloud of the object's surface, no "
        "pose of it",
        task={"observation": "camera"},
    ),
}


def get_method(name: str) -> Method:
    """Returns the method of this name.

    Raises:
      CongraspError: there is no such method.
    """
    if name not in METHODS:
        raise CongraspError(
            f"There is no method '{name}'.", f"Choose one of: {', '.join(METHODS)}."
        )
    return METHODS[name]


def with_method(run: RunConfig, name: str) -> RunConfig:
    """Returns the run that trains a method.

    Raises:
      CongraspError: there is no such method, or it does not learn.
    """
    method = get_method(name)
    if not method.learns:
        raise CongraspError(
            f"The method '{name}' does not learn.",
            f"Evaluate it with 'congrasp evaluate --method {name}'.",
        )
    run = method.schedule(run)
    last = dataclasses.replace(run.curriculum.reward, **method.weights)
    curriculum = dataclasses.replace(run.curriculum, reward=last)
    return dataclasses.replace(run, task=_task(run.task, name), curriculum=curriculum)


def evaluated_as(task: TaskConfig, name: str, source: str) -> TaskConfig:
    """Returns the task under which a policy is evaluated as a method.

    Args:
      task: task of the policy.
      name: name of the method. One that does not learn accepts any policy, takes its hand and
        geometry, and ignores its actions.
      source: name of the policy in errors.

    Raises:
      CongraspError: there is no such method, or the policy has another method.
    """
    if not get_method(name).learns:
        return _task(task, name)
    if task.method != name:
        raise CongraspError(
            f"The policy {source} has the method '{task.method}', not '{name}'.",
            f"Train one with 'congrasp train --method {name}' and pass it with --policy.",
        )
    return task


def takes(name: str, row: str) -> bool:
    """True if a method supports the constraints of a row, which are joined by `+`."""
    needs = get_method(name).needs
    if not needs:
        return True
    return any(constraint in needs for constraint in row.split("+"))


def _task(task: TaskConfig, name: str) -> TaskConfig:
    """Returns the task with the changes of a method."""
    method = get_method(name)
    fields: dict[str, Any] = {
        **method.task,
        "method": name,
        "control": dataclasses.replace(task.control, **method.control),
        "reward": dataclasses.replace(task.reward, **method.weights),
    }
    return dataclasses.replace(task, **fields)
