"""An algorithm from outside: registered by name, it trains in the real learner, and nothing else
knows of it.
"""

import threading

import jax
import numpy as np
import pytest

from congrasp.common.config import PPOConfig, RunConfig, run_config_from_json, to_json
from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.learner.algorithms import ALGORITHMS, make_algorithm
from congrasp.learner.algorithms.protocol import collate, partition_specs
from congrasp.learner.hub.task_ranges import Ranges
from congrasp.learner.process import Outputs, run_learner
from congrasp.learner.run_directory import create_run
from tests.learner import toy
from tests.learner.a2c import A2C, SCHEMA
from tests.learner.made_up_actor import MadeUpActor

WORLDS = 64
UPDATES = 150
CONFIG = RunConfig(
    name="t",
    environments=WORLDS,
    rollout_steps=toy.STEPS,
    updates=UPDATES,
    half_observations=False,
    network=toy.SPEC.network,
    algorithm="a2c",
    rollouts_per_update=1,
    max_staleness=0,
    ppo=PPOConfig(gamma=0.9),
)


class ToyActor(MadeUpActor):
    """Sends rollouts of the toy task with the arrays that the learner takes; the first has one
    more.
    """

    def rollout(self, bundle, key):
        recorded = toy.sampled(bundle, key, WORLDS, self.rng)
        return recorded if not self.outcomes else {name: recorded[name] for name in self.names}


def test_an_algorithm_from_outside_learns_in_the_real_learner(tmp_path, monkeypatch):
    """Wire check, warm-up, updates, checkpoint, resume and publication follow from its four members
    alone.
    """
    monkeypatch.setitem(ALGORITHMS, "a2c", A2C)
    monkeypatch.setattr(bundles, "policy_spec", lambda task, sizes: toy.SPEC)
    ranges = Ranges(np.full(sum(size for _, size in toy.LAYOUT), 1e6), 1e6, 1e6, {})
    monkeypatch.setattr("congrasp.learner.process.task_ranges", lambda task, curriculum: ranges)
    create_run(tmp_path, CONFIG)
    hub = MemoryHub()
    events = []
    stop = threading.Event()
    actor = ToyActor(MemoryTransport(hub))

    def learn(resume):
        with MemoryTransport(hub) as transport:
            return run_learner(
                tmp_path,
                CONFIG,
                transport,
                stop_event=stop,
                resume=resume,
                outputs=Outputs(
                    on_update=lambda values: (
                        values["update"] == UPDATES // 2 and not resume and stop.set()
                    ),
                    on_event=lambda level, text: events.append(text),
                ),
            )

    half = learn(resume=False)
    stop.clear()
    last = learn(resume=True)
    actor.join(10.0)
    assert actor.names == tuple(SCHEMA)
    assert [outcome.result(0) for outcome in actor.outcomes[:3]] == [
        "refused",
        "accepted",
        "accepted",
    ]
    assert any("unknown array 'log_probability'" in text for text in events)
    assert half.version == UPDATES // 2
    assert last.transitions == UPDATES * WORLDS * toy.STEPS
    assert toy.mean_return(last) > toy.mean_return(half) > toy.STANDING_STILL / 2
    assert toy.mean_return(last) > toy.HALVING
    shipped = bundles.load(tmp_path / "policy.safetensors")
    jax.tree.map(np.testing.assert_array_equal, shipped.params, jax.device_get(last.params))


def test_a_batch_is_joined_and_divided_along_the_axis_of_worlds():
    def still(observation):
        return np.zeros((len(observation), 1)), np.zeros(len(observation))

    rollouts = [toy.episode(still, 3, np.random.default_rng(seed)) for seed in (0, 1)]
    batch = collate(rollouts, SCHEMA)
    assert batch.keys() == SCHEMA.keys()
    assert batch["reward"].shape == (toy.STEPS, 6)
    assert batch["last_observation"].shape == (6, 11)
    np.testing.assert_array_equal(batch["observation"][:, 3:], rollouts[1]["observation"])
    specs = {name: tuple(spec) for name, spec in partition_specs(SCHEMA).items()}
    assert specs["action"] == (None, "rank", None)
    assert specs["last_observation"] == ("rank", None)


def test_an_unknown_algorithm_is_one_line_and_an_old_configuration_means_ppo():
    with pytest.raises(
        CongraspError, match=r"There is no algorithm 'a2c'\. Choose from: ppo, distill\."
    ) as caught:
        make_algorithm(toy.SPEC, CONFIG)
    assert "\n" not in str(caught.value)
    old = to_json(RunConfig()).replace('  "algorithm": "ppo",\n', "")
    assert "algorithm" not in old
    assert run_config_from_json(old) == RunConfig()
