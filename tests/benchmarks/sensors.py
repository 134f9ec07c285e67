"""Grasps of a policy with all measurements of the simulation, and without those that a robot may lack."""

from typing import Any

import numpy as np

import congrasp
from congrasp.common.hands import get_hand
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import named_policy
from tests.benchmarks.robot import SEED, example

LACKING = {
    "all measurements": (),
    "no contact forces": ("contact_force", "contact_position", "contact_found"),
    "no velocities either": (
        "contact_force",
        "contact_position",
        "contact_found",
        "q_velocity",
        "u_velocity",
        "object_velocity",
        "object_angular_velocity",
    ),
}
"""Sets of measurements that a state lacks."""


def bench_sensors(policies: tuple[str, ...], episodes: int) -> None:
    """Prints a table of grasps held for two seconds without the table, of several policies and sets of measurements.

    Args:
      policies: policy files, or names of pretrained policies.
      episodes: number of objects, one episode each.
    """
    loop = example("robot_loop")
    print(f"| policy | {' | '.join(LACKING)} |\n|---|{'---|' * len(LACKING)}")
    for name in policies:
        path = named_policy(name)
        task = bundles.load(path).task
        hand = get_hand(task.hand)
        limits = congrasp.JointLimits.of_hand(hand, task.control)
        held = dict.fromkeys(LACKING, 0)
        with congrasp.load_policy(path) as policy:
            for seed in range(SEED, SEED + episodes):
                robot = loop.MujocoRobot(hand, task, seed, limits)
                for label, lacking in LACKING.items():
                    held[label] += _held(robot, policy, lacking, task.approach_steps, loop.HOLD_STEPS, task.drop_height)
        print(f"| {name} | {' | '.join(f'{n} of {episodes}' for n in held.values())} |", flush=True)


def _held(robot: Any, policy: congrasp.Policy, lacking: tuple[str, ...], approach: int, hold: int, drop: float) -> bool:
    """Runs an episode in simulated time; returns whether the object is held at its end."""
    robot.reset()
    policy.reset(robot.request)
    targets = {"q_target": np.asarray(robot.request.q), "u_target": np.zeros(6)}
    height = np.inf
    for step in range(approach + hold):
        if step == approach:
            height = robot.height
            robot.remove_table()
        state = {name: value for name, value in robot.state().items() if name not in lacking}
        answer = policy.act({**state, **targets})
        targets = {"q_target": answer.q_target, "u_target": answer.u_target}
        robot.move(congrasp.Command(*targets.values(), *targets.values(), "follow", answer))
    return bool(robot.height > height - drop)
