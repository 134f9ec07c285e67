"""Methods that are compared: the paper's own, its baselines and its ablations, each as what it changes of a run.

`congrasp train --method NAME` trains those that learn, a policy's task says of which method it is, and
`congrasp evaluate --method NAME` takes no policy of another one.
"""

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from congrasp.common.config import CurriculumConfig, RunConfig, TaskConfig
from congrasp.common.errors import CongraspError

_NOTHING: Mapping[str, Any] = MappingProxyType({})
STUDENT = "student"
"""The method of policies that see what a robot has; `congrasp train --teacher` distils them."""
STATIONARY_SHARE = 0.6
"""Of the updates of two phases, those with stationary objects: the paper's 15 of 25 hours."""


class Method(NamedTuple):
    """What a method changes, and what it can do without."""

    meaning: str
    task: Mapping[str, Any] = _NOTHING
    """Fields of `TaskConfig`."""
    control: Mapping[str, Any] = _NOTHING
    """Fields of `ControlConfig`."""
    weights: Mapping[str, float] = _NOTHING
    """Fields of `RewardWeights`, those at the end of the curriculum's ramp too."""
    schedule: Callable[[RunConfig], RunConfig] = lambda run: run
    """What becomes of the order of training."""
    needs: tuple[str, ...] = ()
    """Constraints of which its episodes must have one; empty if the heading is enough."""
    learns: bool = True
    """Whether there is a policy to train; otherwise the actions count for nothing."""


def _two_phases(run: RunConfig) -> RunConfig:
    """Stationary objects first, then free ones; at the change the weights become those of the ramp's end."""
    free, curriculum = max(round(STATIONARY_SHARE * run.updates), 1), run.curriculum
    ramp = (free - 1, free) if curriculum.ramped else curriculum.ramp
    return dataclasses.replace(run, curriculum=dataclasses.replace(curriculum, stationary_updates=free, ramp=ramp))


def _single_stage(run: RunConfig) -> RunConfig:
    """Free objects and the weights of the ramp's end from the first update on."""
    last = run.curriculum.reward if run.curriculum.ramped else run.task.reward
    return dataclasses.replace(run, curriculum=CurriculumConfig(), task=dataclasses.replace(run.task, reward=last))


METHODS = {
    "ours": Method("one policy for every combination of constraints, objects free from the start, weights on a ramp"),
    "pd": Method(
        "no learning: the wrist follows its guidance, then the fingers go to the reference pose, or close without one",
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
        "heading and affordance alone, with the hand centre fixed at that of the first fingers",
        task={"constraints": ("heading", "affordance"), "dynamic_center": False},
    ),
    "dgrasp": Method(
        "a reference pose in every episode, and nothing else: no heading is rewarded beside it",
        task={"constraints": ("heading", "pose"), "p_pose": 1.0, "own_references": False},
        weights={"heading_direction": 0.0, "heading_position": 0.0},
        needs=("pose",),
    ),
    "no-dynamic-center": Method("the hand centre fixed at that of the first fingers", task={"dynamic_center": False}),
    "no-feedforward": Method("the guidance aims at the nearest waypoint, not the next", control={"lookahead": 0}),
    "two-phase": Method(
        "the paper's two phases: stationary objects, then free ones with larger constraint weights",
        schedule=_two_phases,
    ),
    "single-stage": Method(
        "free objects and the last weights from the start, no ramp",
        schedule=_single_stage,
    ),
    STUDENT: Method(
        "no privileges: joints, wrist and a tracker's object poses over some steps, no forces and no velocities",
        task={"observation": "tracked"},
    ),
}


def get_method(name: str) -> Method:
    """The method of this name.

    Raises:
      CongraspError: there is none.
    """
    if name not in METHODS:
        raise CongraspError(f"There is no method '{name}'.", f"Choose one of: {', '.join(METHODS)}.")
    return METHODS[name]


def with_method(run: RunConfig, name: str) -> RunConfig:
    """The run that trains a method.

    Raises:
      CongraspError: there is no such method, or it does not learn.
    """
    method = get_method(name)
    if not method.learns:
        raise CongraspError(
            f"The method '{name}' does not learn.", f"Evaluate it with 'congrasp evaluate --method {name}'."
        )
    run = method.schedule(run)
    last = dataclasses.replace(run.curriculum.reward, **method.weights)
    curriculum = dataclasses.replace(run.curriculum, reward=last)
    return dataclasses.replace(run, task=_task(run.task, name), curriculum=curriculum)


def evaluated_as(task: TaskConfig, name: str, source: str) -> TaskConfig:
    """The task under which a policy is evaluated as a method.

    Args:
      task: the policy's.
      name: of the method. One that does not learn takes hand and geometry from any policy, whose actions count for
        nothing.
      source: what to call the policy in errors.

    Raises:
      CongraspError: there is no such method, or the policy is of another.
    """
    if not get_method(name).learns:
        return _task(task, name)
    if task.method != name:
        raise CongraspError(
            f"The policy {source} is of the method '{task.method}', not '{name}'.",
            f"Train one with 'congrasp train --method {name}' and name it with --policy.",
        )
    return task


def takes(name: str, row: str) -> bool:
    """Whether a method can be asked for a row's constraints, which stand with `+` between them."""
    needs = get_method(name).needs
    return not needs or not set(needs).isdisjoint(row.split("+"))


def _task(task: TaskConfig, name: str) -> TaskConfig:
    """The task with what a method changes of it."""
    method = get_method(name)
    fields: dict[str, Any] = {
        **method.task,
        "method": name,
        "control": dataclasses.replace(task.control, **method.control),
        "reward": dataclasses.replace(task.reward, **method.weights),
    }
    return dataclasses.replace(task, **fields)
