"""Two devices with half of the batch each do what one does with all of it."""

import os
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
TWO_DEVICES = """
import dataclasses, functools
import jax, numpy as np
from jax.sharding import Mesh
from congrasp.learner.algorithms.ppo import PPO
from congrasp.learner.algorithms.protocol import NonFiniteUpdate
from congrasp.learner.distributed.collectives import AXIS, shard
from tests.learner import toy
from tests.learner.test_ppo import fresh, rollout

# One minibatch: then both have the same samples in it, whatever order they draw.
ppo = PPO(toy.SPEC, dataclasses.replace(toy.SETTINGS, minibatches=1, entropy=0.01, importance_max=1.02))
mesh = Mesh(np.array(jax.devices()), (AXIS,))
assert mesh.size == 2
one, two = fresh(), fresh()
for seed in range(4):
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


@pytest.mark.timeout(300)
def test_half_of_the_batch_on_each_of_two_devices_is_the_whole_batch():
    environment = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "true",
        "XLA_FLAGS": "--xla_force_host_platform_device_count=2",
    }
    command = [sys.executable, "-c", TWO_DEVICES]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=280.0)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "agreed"
