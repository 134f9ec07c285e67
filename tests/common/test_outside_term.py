"""A term of the grasp reward that only this file knows.

Weights and options are made of the terms when their modules are imported. So the test runs this file as a program,
which adds the term before it imports anything else.
"""

import contextlib
import dataclasses
import io
import os
import pathlib
import subprocess
import sys

import jax.numpy as jnp
import numpy as np

ROOT = pathlib.Path(__file__).parents[2]


def height(scene, earning):
    rise = scene.state.object_position[:, 2] - scene.state.object_position_initial[:, 2]
    return jnp.clip(rise, 0.0, 0.2)


def test_nothing_else_must_be_changed():
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "tests.common.test_outside_term"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines() == ["reward", "configuration", "command line"]


def reward():
    """It is paid with its weight, beside the others."""
    from congrasp.common.task.config import RewardWeights, TaskConfig
    from congrasp.common.task.reward import reward_terms, terms
    from tests.scenes import evaluated, scene, scene_of

    task, (state, surface, goal) = TaskConfig(), scene(0, batch=3)
    start = state.object_position_initial * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.1]
    risen = start + np.array([[0.0, 0.0, 0.05], [0.0, 0.0, -0.05], [0.0, 0.0, 0.8]])
    state = state._replace(object_position=risen, object_position_initial=start)
    weights = dataclasses.replace(RewardWeights(), height=3.0)
    paid = evaluated(reward_terms, scene_of(task, state, surface, goal), weights)
    np.testing.assert_allclose(paid["height"], [3.0 * 0.05, 0.0, 3.0 * 0.2], rtol=1e-5)
    assert set(paid) == set(terms(task)) and "height" in terms(task)


def configuration():
    """A run keeps its weight."""
    from congrasp.common.config import RunConfig, run_config_from_json, to_json
    from congrasp.common.task.config import RewardWeights, TaskConfig

    assert RewardWeights().height == 2.0
    config = RunConfig(task=TaskConfig(reward=RewardWeights(height=0.5)))
    assert run_config_from_json(to_json(config)) == config


def command_line():
    """Its option and the help."""
    from congrasp.services.cli import main

    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        main.load("train")(["--help"])
    assert "--task.reward.height" in said.getvalue() and "Per metre of rise." in said.getvalue()


if __name__ == "__main__":
    from congrasp.common.task import reward as module

    module.GRASP = (*module.GRASP, module.Term("height", 2.0, "Per metre of rise.", height))
    for check in (reward, configuration, command_line):
        check()
        print(check.__name__.replace("_", " "))
