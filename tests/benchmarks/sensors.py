"""Grasps of a policy with all measurements of the simulation, without some of them, and with late
servos.
"""

import collections
from typing import Any, NamedTuple

import numpy as np

import congrasp
from congrasp.common.hands import get_hand
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import named_policy
from congrasp.common.task.config import TaskConfig
from tests.benchmarks.robot import SEED
from tests.examples import example

_FORCES = ("contact_force", "contact_position", "contact_found")
_VELOCITIES = ("q_velocity", "u_velocity", "object_velocity", "object_angular_velocity")


class Condition(NamedTuple):
    """What a robot lacks."""

    lacking: tuple[str, ...] = ()
    """Fields of the state."""
    late: int = 0
    """Control steps until the servos follow a target."""


CONDITIONS = {
    "all measurements": Condition(),
    "no contact forces": Condition(_FORCES),
    "no velocities either": Condition(_FORCES + _VELOCITIES),
    "and 20 ms late": Condition(_FORCES + _VELOCITIES, 2),
    "and 40 ms late": Condition(_FORCES + _VELOCITIES, 4),
}


def sensors(policies: tuple[str, ...] = ("allegro", "allegro-student"), episodes: int = 24) -> int:
    """Grasps with all measurements, without contact forces, and without velocities either, in
    simulated time.

    Counts the objects that are held for two seconds without the table.

    Args:
      policies: Policy files, or names of pretrained policies.
      episodes: Number of procedural objects, one episode each.

    Examples:
      python -m tests.benchmarks sensors
      python -m tests.benchmarks sensors --policies allegro-student --episodes 4
    """
    loop = example("robot_loop")
    print(f"| policy | {' | '.join(CONDITIONS)} |\n|---|{'---|' * len(CONDITIONS)}")
    for name in policies:
        path = named_policy(name)
        task = bundles.load(path).task
        hand = get_hand(task.hand)
        limits = congrasp.JointLimits.of_hand(hand, task.control)
        held = dict.fromkeys(CONDITIONS, 0)
        with congrasp.load_policy(path) as policy:
            for seed in range(SEED, SEED + episodes):
                robot = loop.MujocoRobot(hand, task, seed, limits)
                for label, condition in CONDITIONS.items():
                    held[label] += _held(robot, policy, condition, task, loop.HOLD_STEPS)
        print(f"| {name} | {' | '.join(f'{n} of {episodes}' for n in held.values())} |", flush=True)
    return 0


def _held(
    robot: Any, policy: congrasp.Policy, condition: Condition, task: TaskConfig, hold: int
) -> bool:
    """Runs an episode in simulated time; returns whether the object is held at its end.

    The table is removed later than in training by half, because late targets slow the wrist down.
    """
    robot.reset()
    policy.reset(robot.request)
    targets = {"q_target": np.asarray(robot.request.q), "u_target": np.zeros(6)}
    waiting = collections.deque([targets] * condition.late)
    approach = task.approach_steps * 3 // 2
    height = np.inf
    for step in range(approach + hold):
        if step == approach:
            height = robot.height
            robot.remove_table()
        state = {
            name: value for name, value in robot.state().items() if name not in condition.lacking
        }
        clock = np.asarray(step / 1.5 if step < approach else step - approach + task.approach_steps)
        answer = policy.act({**state, **targets, "time": clock})
        targets = {"q_target": answer.q_target, "u_target": answer.u_target}
        waiting.append(targets)
        robot.move(
            congrasp.Command(
                *(followed := waiting.popleft()).values(), *followed.values(), "follow", answer
            )
        )
    return bool(robot.height > height - task.drop_height)
