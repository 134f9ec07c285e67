"""Updates of batches that are divided between two devices."""

import os

import pytest

from tests.children import python
from tests.learner.test_distill import save_teacher

PREAMBLE = """
import dataclasses, functools, sys
import jax, numpy as np
from jax.sharding import Mesh
from congrasp.common.config import RunConfig
from congrasp.learner.algorithms.ppo import PPO
from congrasp.learner.algorithms.protocol import NonFiniteUpdate
from congrasp.learner.algorithms.protocol import collate
from congrasp.learner.distributed.collectives import AXIS, shard
from tests.learner import toy
from tests.learner.test_ppo import fresh, rollout

mesh = Mesh(np.array(jax.devices()), (AXIS,))
assert mesh.size == 2
"""
PPO = """
# One minibatch: then both have the same samples in it, whatever order they draw.
ppo = PPO(toy.SPEC, dataclasses.replace(toy.SETTINGS, minibatches=1, entropy=0.01, importance_max=1.02))
one, two = fresh(), fresh()
for seed in range(3):
    batch = rollout(toy.bundle_of(one), seed)
    # The halves are unlike, so that a mean of each instead of all would show; and stale, so that weights are truncated.
    batch["reward"][:, :32] *= 3.0
    batch["log_probability"] += np.random.default_rng(seed).normal(0.0, 0.05, batch["reward"].shape).astype(np.float32)
    one, expected = ppo.update(one, batch)
    two, metrics = ppo.update(two, batch, mesh)
    assert (two.version, two.transitions) == (one.version, one.transitions)
    assert metrics.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(metrics[name], value, rtol=2e-3, atol=2e-5, err_msg=name)
    for a, b in zip(one.observation + one.value, two.observation + two.value, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=2e-3, atol=2e-4), two.params, one.params)
copies = jax.tree.leaves(shard(two.params, mesh))
assert all(len(leaf.addressable_shards) == 2 for leaf in copies)

batch["reward"][3, 40] = np.nan  # on the second device alone
try:
    ppo.update(two, batch, mesh)
except NonFiniteUpdate as error:
    assert "reward" in str(error)
    print("agreed")
"""
A2C = """
from tests.learner.a2c import A2C, SCHEMA
a2c = A2C(toy.SPEC, RunConfig())
one, two = a2c.init(0), a2c.init(0)
for seed in range(3):
    batch = collate([rollout(toy.bundle_of(one), seed)], SCHEMA)
    batch["reward"][:, :32] *= 3.0  # the halves are unlike
    one, expected = a2c.update(one, batch)
    two, metrics = a2c.update(two, batch, mesh)
    assert two.transitions == one.transitions
    for name, value in expected.items():
        np.testing.assert_allclose(metrics[name], value, rtol=2e-3, atol=2e-5, err_msg=name)
jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4), two.params, one.params)
"""
DISTILLATION = """
from tests.learner.test_distill import algorithm, batch, run_of
run = run_of(sys.argv[1], epochs=1)
student = algorithm(run)
one, two = student.init(0), student.init(0)
one, expected = student.update(one, batch(run, 0))
two, metrics = student.update(two, batch(run, 0), mesh)
assert two.transitions == one.transitions
np.testing.assert_allclose(metrics["imitation_kl"], expected["imitation_kl"], rtol=0.05)
np.testing.assert_allclose(two.observation.mean, one.observation.mean, atol=1e-5)
"""


def two_devices(program, *arguments):
    """What a program prints that sees two devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    done = python("-c", PREAMBLE + program, *arguments, env={"XLA_FLAGS": flags}, timeout=280)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_ppo_on_two_devices_equals_one():
    assert two_devices(PPO) == "agreed"


@pytest.mark.slow
def test_an_algorithm_from_outside_is_divided_between_two_devices():
    two_devices(A2C)


@pytest.mark.slow
def test_distillation_is_divided_between_two_devices(tmp_path):
    save_teacher(tmp_path / "teacher.safetensors")
    two_devices(DISTILLATION, tmp_path / "teacher.safetensors")
