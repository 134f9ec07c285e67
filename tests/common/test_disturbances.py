"""Disturbed references: nothing at no amount, within limits, of the stated size, and paths that keep their shape."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from common.hands import get_hand
from common.task.bank import Draw
from common.task.constraints.trajectory import Trajectory
from common.task.sampling.disturbances import (
    ASIDE,
    CLOSURE,
    JITTER,
    JOINTS,
    SHORTER,
    WRIST,
    disturbed_fingers,
    disturbed_way,
    disturbed_wrist,
)

HAND = get_hand("human")
MANY = 4000


def test_no_amount_changes_nothing():
    q = jnp.tile(jnp.array(HAND.q_open) * 0.9, (2, 1))
    np.testing.assert_allclose(disturbed_fingers(HAND, q, jnp.zeros(2), jax.random.key(0)), q, atol=1e-6)
    path = jnp.arange(18.0).reshape(2, 3, 3)
    turns = jnp.tile(jnp.array([0.5, 0.5, -0.5, 0.5]), (2, 3, 1))
    for found, given in zip(disturbed_wrist(path, turns, jnp.zeros(2), jax.random.key(0)), (path, turns), strict=True):
        np.testing.assert_allclose(found, given, atol=1e-6)


def test_fingers_are_off_by_closure_and_joint():
    middle = 0.5 * (HAND.lower + HAND.upper)
    q = jnp.tile(jnp.array(middle), (MANY, 1))
    found = np.asarray(disturbed_fingers(HAND, q, jnp.ones(MANY), jax.random.key(1)))
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
    moved, turned = (np.asarray(x) for x in disturbed_wrist(path, turns, jnp.ones(MANY), jax.random.key(2)))
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


UP = jnp.tile(jnp.array([[0.0, 0.6, 0.8]]), (MANY, 1))


def ways(start: list[float], amount: float) -> tuple[np.ndarray, np.ndarray]:
    """Two waypoints' ways (MANY, 2, 3) to an end at (1, 2, 3), before and after."""
    before = jnp.tile(jnp.array([start, [0.4 * x for x in start], [0.0, 0.0, 0.0]]), (MANY, 1, 1)) + jnp.array(
        [1.0, 2, 3]
    )
    after = disturbed_way(before, UP, jnp.full(MANY, amount), jax.random.key(4))
    np.testing.assert_allclose(after[:, -1], before[:, -1], atol=1e-6)
    return tuple(np.asarray(path[:, :-1] - path[:, -1:]) for path in (before, after))


def test_a_way_is_shorter_and_comes_from_aside_but_keeps_its_shape():
    """Straight up from the end, 20 cm: it is turned by up to half of the largest angle, and shortened by up to half."""
    before, after = ways([0.0, 0.12, 0.16], 0.5)
    length = np.linalg.norm(after, axis=-1)
    np.testing.assert_allclose(length[:, 1], 0.4 * length[:, 0], rtol=1e-4)
    share = length[:, 0] / 0.2
    assert share.min() >= 1 - 0.5 * (1 - SHORTER) - 1e-4 and share.max() <= 1 + 1e-4
    assert share.mean() == pytest.approx(1 - 0.5 * (1 - SHORTER) / 2, abs=0.005)
    angle = np.arccos(np.clip((before * after).sum(-1) / np.linalg.norm(before, axis=-1) / length, -1, 1))
    np.testing.assert_allclose(angle[:, 0], angle[:, 1], atol=2e-3)
    assert angle.max() <= 0.5 * ASIDE + 1e-3 and angle.mean() == pytest.approx(0.25 * ASIDE, rel=0.03)
    np.testing.assert_allclose(*ways([0.0, 0.12, 0.16], 0.0), atol=1e-6)


def test_a_way_that_is_turned_does_not_come_from_below():
    """A level way of 20 cm: half of all turns would have it begin lower than it ends."""
    _, after = ways([0.2, 0.0, 0.0], 1.0)
    height = after[:, 0] @ np.asarray(UP[0])
    assert height.min() > -1e-5 and height.max() > 0.15


def test_a_way_from_above_may_become_a_level_one():
    """From 45 degrees over the table, at the largest angle: never lower than the 3 cm that the other side exceeds."""
    _, after = ways([0.14, 0.08, 0.11], 1.0)
    height = after[:, 0] @ np.asarray(UP[0])
    assert height.min() < 0.04 and height.min() > 0.5 * 0.03 - 1e-4


def test_paths_of_an_episode_do_not_come_from_below_its_own_table():
    """An object in a resting pose that has its y axis up: level ways along x begin no lower than they end, but for
    what the wrist's own errors make of it."""
    count, level = 400, np.array([[0.2, 0, 0], [0.1, 0, 0], [0, 0, 0]], np.float32)
    turn = Rotation.from_euler("x", 90, degrees=True).as_quat(scalar_first=True)
    bank = types.SimpleNamespace(
        trajectory_position=jnp.asarray(level)[None, None, None],
        trajectory_quaternion=jnp.tile(jnp.array([1.0, 0, 0, 0]), (1, 1, 1, 3, 1)),
        rest=jnp.asarray([[[0, 0, 0, 1, 0, 0, 0], [0, 0, 0, *turn]]], jnp.float32),
    )
    zero = jnp.zeros(count, jnp.int32)
    draw = Draw(bank, zero, zero + 1, zero, {"trajectory": zero}, jnp.full(count, 0.9))
    path = np.asarray(Trajectory().sample(HAND, draw, jax.random.key(5)).position)
    rise, across = (path[:, 0] - path[:, -1])[:, 1], (path[:, 0] - path[:, -1])[:, 2]
    assert np.percentile(rise, 2) > -0.08 and rise.mean() > 0.03
    assert across.min() < -0.1 and abs(across.mean()) < 0.01
