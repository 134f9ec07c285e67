"""An engine that only this file knows: it is registered here, and episodes and tables are made on
it.
"""

import queue
import threading

import numpy as np
import pytest

from congrasp.actors.physics import ENGINES, Engine, make_physics, prepare_physics, resolve_physics
from congrasp.actors.physics.native import NativePhysics
from congrasp.common.config import RunConfig, run_config_from_json, to_json
from congrasp.common.errors import CongraspError
from congrasp.services.evaluate.experiment import Experiment, Variation
from tests import task as suite
from tests.children import python
from tests.task import BATCH, HAND, OBJECTS, TASK


class CountingPhysics(NativePhysics):
    """MuJoCo C that counts the steps of all environments."""

    name = "counting"
    steps = 0

    def step(self, state, target, table):
        CountingPhysics.steps += len(target)
        return super().step(state, target, table)


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(ENGINES, "counting", Engine(CountingPhysics, batch=BATCH))
    monkeypatch.setattr(CountingPhysics, "steps", 0)


def test_rollouts_are_made_on_it():
    physics = make_physics("counting", HAND, TASK, OBJECTS, threads=1)
    rollout = suite.worker(physics=physics).collect(suite.command(noise=0.3), 3)
    assert CountingPhysics.steps == 3 * BATCH
    assert np.all(np.isfinite(rollout.reward))
    physics.close()


def test_it_is_prepared_once_and_in_the_background(monkeypatch):
    begun = queue.SimpleQueue()
    done = threading.Event()

    def prepare(hand, task):
        begun.put((hand, task))
        assert done.wait(30.0)

    monkeypatch.setitem(ENGINES, "counting", ENGINES["counting"]._replace(prepare=prepare))
    prepare_physics.cache_clear()
    for _ in range(2):
        prepare_physics("counting", HAND, TASK)
    assert begun.get(timeout=30.0) == (HAND, TASK), "although it is not done"
    done.set()
    assert begun.empty()


@pytest.mark.slow
def test_an_evaluation_takes_its_batch_from_its_row():
    experiment = Experiment(
        suite.policy(), OBJECTS, physics="counting", episodes=2 * BATCH, hold=TASK.hold_steps
    )
    (result,) = experiment.run([Variation()])
    assert result.row.episodes == 2 * BATCH
    assert CountingPhysics.steps == 2 * BATCH * (TASK.approach_steps + TASK.hold_steps)


def test_a_run_and_errors_name_it():
    config = RunConfig(physics="counting")
    assert run_config_from_json(to_json(config)) == config
    assert resolve_physics("counting") == "counting"
    assert resolve_physics("auto", "cpu") == "native"
    with pytest.raises(
        CongraspError, match=r"no physics engine 'abacus'\. Choose from: auto, warp, .*, counting\."
    ):
        make_physics("abacus", HAND, TASK, OBJECTS, threads=1)


def test_command_lines_offer_it():
    program = (
        "from congrasp.actors.physics import ENGINES, Engine; from congrasp.services.cli.main "
        "import run; "
        "ENGINES['counting'] = Engine(None, batch=1); run(['train', '--help'])"
    )
    done = python("-c", program)
    assert "--physics {auto,warp,jax,native,physx,counting}" in done.stdout
    assert "(default: native)" in done.stdout.split("--physics")[1][:200]
