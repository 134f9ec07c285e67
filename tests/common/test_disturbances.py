"""Disturbed references: nothing at no amount, within limits, of the stated size, and paths that keep their shape."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common.hands import get_hand
from congrasp.common.task.constraints.pose import (
    CLOSURE,
    JITTER,
    JOINTS,
    WRIST,
    disturbed_fingers,
    disturbed_wrist,
    fingers_numbers,
    wrist_numbers,
)

HAND = get_hand("human")
MANY = 4000
fingers_off, wrist_off = jax.jit(disturbed_fingers, static_argnums=0), jax.jit(disturbed_wrist)


def _uniform(batch, numbers):
    return np.random.default_rng(0).uniform(size=(batch, numbers)).astype(np.float32)


def test_no_amount_changes_nothing():
    q = jnp.tile(jnp.array(HAND.q_open) * 0.9, (2, 1))
    np.testing.assert_allclose(fingers_off(HAND, q, jnp.zeros(2), _uniform(2, 21)), q, atol=1e-6)
    path = jnp.arange(18.0).reshape(2, 3, 3)
    turns = jnp.tile(jnp.array([0.5, 0.5, -0.5, 0.5]), (2, 3, 1))
    for found, given in zip(wrist_off(path, turns, jnp.zeros(2), _uniform(2, 15)), (path, turns), strict=True):
        np.testing.assert_allclose(found, given, atol=1e-6)


def test_fingers_are_off_by_closure_and_joint():
    middle = 0.5 * (HAND.lower + HAND.upper)
    q = jnp.tile(jnp.array(middle), (MANY, 1))
    found = np.asarray(fingers_off(HAND, q, jnp.ones(MANY), _uniform(MANY, fingers_numbers(HAND))))
    assert np.all(found >= HAND.lower) and np.all(found <= HAND.upper)
    wide = np.argmax(HAND.upper - HAND.lower)  # 2.1 rad: clipping hardly matters
    way = middle[wide] - HAND.q_open[wide]
    np.testing.assert_allclose(found[:, wide].mean(), HAND.q_open[wide] + np.mean(CLOSURE) * way, atol=0.03)
    spread = np.sqrt(JOINTS**2 + (CLOSURE[1] - CLOSURE[0]) ** 2 / 12 * way**2)
    assert found[:, wide].std() == pytest.approx(spread, rel=0.1)


def test_a_path_moves_and_turns_as_a_whole_but_for_its_jitter():
    rng = np.random.default_rng(0)
    path = jnp.array(np.tile(rng.normal(size=(1, 4, 3)), (MANY, 1, 1)), jnp.float32)
    turns = jnp.array(np.tile(Rotation.random(4, 0).as_quat(scalar_first=True), (MANY, 1, 1)), jnp.float32)
    moved, turned = (np.asarray(x) for x in wrist_off(path, turns, jnp.ones(MANY), _uniform(MANY, wrist_numbers(4))))
    assert (moved[:, -1] - path[:, -1]).std() == pytest.approx(WRIST[0], rel=0.05)
    by = [
        Rotation.from_quat(turned[:, k], scalar_first=True) * Rotation.from_quat(turns[:, k], scalar_first=True).inv()
        for k in range(4)
    ]
    for k in range(3):
        np.testing.assert_allclose((by[k] * by[-1].inv()).magnitude(), 0.0, atol=1e-5)
        way = by[-1].apply(np.asarray(path[:, k] - path[:, -1]))
        rest = moved[:, k] - moved[:, -1] - way
        assert rest.std() == pytest.approx(JITTER, rel=0.05)
    assert by[-1].as_rotvec().std() == pytest.approx(WRIST[1], rel=0.05)
