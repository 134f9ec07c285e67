"""Difference between an exported policy, in the runtimes that users have, and the Flax policy."""

import pathlib
import zipfile

import jax
import jax.export
import numpy as np
import onnxruntime

from congrasp.common.policy.bundle import PolicyBundle, mean_action
from congrasp.common.policy.network import gated


def difference(bundle: PolicyBundle, path: pathlib.Path) -> float:
    """Largest difference over the largest action, both rounded to float32, also far beyond the
    policy's range.
    """
    observations = sample_observations(bundle, 64)
    expected = np.asarray(
        mean_action(bundle.spec.layout, bundle.inference_parameters, observations)
    )
    assert np.abs(expected).max() > 1e-3
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            outputs = jax.export.deserialize(bytearray(archive.read("policy.jax"))).call(
                observations
            )
    else:
        (outputs,) = onnxruntime.InferenceSession(path.read_bytes()).run(
            None, {"observation": observations}
        )
    return float(np.abs(outputs - expected).max() / np.abs(expected).max())


def sample_observations(bundle: PolicyBundle, count: int) -> np.ndarray:
    """Observations (count, D) of 3 and, the second half, of 150 times the policy's spread, with
    random masks.
    """
    rng = np.random.default_rng(9)
    statistics = bundle.observation
    spread = np.sqrt(np.asarray(statistics.m2) / max(float(statistics.count), 1.0)) + 1e-3
    reach = np.repeat([3.0, 150.0], count // 2)[:, None]
    drawn = np.asarray(statistics.mean) + reach * spread * rng.normal(size=(count, len(spread)))
    names = gated(bundle.spec.layout)
    start = 0
    mask = rng.integers(0, 2, (count, len(names)))
    for name, size in bundle.spec.layout:
        block = slice(start, start + size)
        start += size
        if name in names:
            drawn[:, block] *= mask[:, names.index(name), None]
        elif name == "mask":
            drawn[:, block] = mask
    return drawn.astype(np.float32)
