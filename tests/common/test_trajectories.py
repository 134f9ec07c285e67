"""Wrist trajectories made backwards from reference poses, and disturbed references."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.task.constraints.disturbance import (
    CLOSURE,
    JITTER,
    JOINTS,
    WRIST,
    disturbed_fingers,
    disturbed_wrist,
    fingers_numbers,
    wrist_numbers,
)
from congrasp.common.task.sampling.trajectories import HUMAN, PAPER, make_trajectories
from tests.scenes import quaternions

HAND = get_hand("human")
COUNT = 64
WAYPOINTS = 15
MANY = 4000


def _make(position, quaternion, style):
    path, turns = make_trajectories(
        HAND,
        jnp.asarray(position),
        jnp.asarray(quaternion),
        jax.random.key(3),
        waypoints=WAYPOINTS,
        style=style,
    )
    return np.asarray(path), np.asarray(turns)


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    return rng.normal(scale=0.1, size=(COUNT, 3)).astype(np.float32), quaternions(rng, COUNT)


@pytest.fixture(scope="module")
def made(poses):
    return _make(*poses, PAPER)


@pytest.mark.parametrize("style", [PAPER, HUMAN])
def test_trajectories_keep_the_ranges_of_their_style(poses, style):
    position, quaternion = poses
    path, turns = _make(position, quaternion, style)
    assert path.shape == (COUNT, WAYPOINTS, 3)
    assert turns.shape == (COUNT, WAYPOINTS, 4)
    # The controller has a quarter of a second to settle, five of its time constants of 0.05 s: e^-5
    # of 25 cm is 2 mm.
    np.testing.assert_allclose(path[:, -1], position, atol=2e-3)
    end = Rotation.from_quat(quaternion, scalar_first=True)
    final = Rotation.from_quat(turns[:, -1], scalar_first=True)
    most_turned = style.rotation[1]
    assert (end.inv() * final).magnitude().max() < np.exp(-5) * most_turned + 1e-3

    away = path[:, 0] - position
    distance = np.linalg.norm(away, axis=-1)
    nearest, farthest = style.distance
    assert nearest - 1e-4 <= distance.min()
    assert distance.max() <= farthest + 1e-4
    outward = -end.apply(grasp_frame(HAND).heading)
    tilt = np.arccos(np.sum(away * outward, -1) / distance)
    assert 0.8 * style.tilt[1] < tilt.max() <= style.tilt[1] + 1e-3
    first = Rotation.from_quat(turns[:, 0], scalar_first=True)
    assert (first * end.inv()).magnitude().max() <= most_turned + 1e-3


def test_waypoints_are_evenly_spaced_and_leave_the_straight_line(poses, made):
    path, turns = made
    steps = np.linalg.norm(np.diff(path, axis=1), axis=-1)
    # Chords of equal arcs: shorter than the arc by no more than its bend.
    assert (steps.std(-1) / steps.mean(-1)).max() < 0.05
    chord = path[:, -1] - path[:, 0]
    chord /= np.linalg.norm(chord, axis=-1, keepdims=True)
    off = path - path[:, :1]
    aside = np.linalg.norm(
        off - np.sum(off * chord[:, None], -1, keepdims=True) * chord[:, None], axis=-1
    ).max(-1)
    least, most = PAPER.amplitude
    assert aside.max() <= most
    assert np.median(aside) > least / 2
    np.testing.assert_allclose(np.linalg.norm(turns, axis=-1), 1.0, atol=1e-5)
    assert (np.sum(turns[:, 1:] * turns[:, :-1], -1) > 0.9).all()  # neighbours in one hemisphere


# --- disturbances ---


fingers_off = jax.jit(disturbed_fingers, static_argnums=0)
wrist_off = jax.jit(disturbed_wrist)


def _uniform(batch, numbers):
    return np.random.default_rng(0).uniform(size=(batch, numbers)).astype(np.float32)


def test_zero_disturbance_changes_nothing():
    q = jnp.tile(jnp.array(HAND.q_open) * 0.9, (2, 1))
    np.testing.assert_allclose(fingers_off(HAND, q, jnp.zeros(2), _uniform(2, 21)), q, atol=1e-6)
    path = jnp.arange(18.0).reshape(2, 3, 3)
    turns = jnp.tile(jnp.array([0.5, 0.5, -0.5, 0.5]), (2, 3, 1))
    for disturbed, original in zip(
        wrist_off(path, turns, jnp.zeros(2), _uniform(2, 15)), (path, turns), strict=True
    ):
        np.testing.assert_allclose(disturbed, original, atol=1e-6)


def test_fingers_are_off_by_closure_and_joint():
    middle = 0.5 * (HAND.lower + HAND.upper)
    q = jnp.tile(jnp.array(middle), (MANY, 1))
    disturbed = np.asarray(
        fingers_off(HAND, q, jnp.ones(MANY), _uniform(MANY, fingers_numbers(HAND)))
    )
    assert np.all(disturbed >= HAND.lower)
    assert np.all(disturbed <= HAND.upper)
    wide = np.argmax(HAND.upper - HAND.lower)  # 2.1 rad: clipping hardly matters
    way = middle[wide] - HAND.q_open[wide]
    np.testing.assert_allclose(
        disturbed[:, wide].mean(), HAND.q_open[wide] + np.mean(CLOSURE) * way, atol=0.03
    )
    spread = np.sqrt(JOINTS**2 + (CLOSURE[1] - CLOSURE[0]) ** 2 / 12 * way**2)
    assert disturbed[:, wide].std() == pytest.approx(spread, rel=0.1)


def test_disturbed_path_moves_rigidly():
    rng = np.random.default_rng(0)
    path = jnp.array(np.tile(rng.normal(size=(1, 4, 3)), (MANY, 1, 1)), jnp.float32)
    turns = jnp.array(
        np.tile(Rotation.random(4, 0).as_quat(scalar_first=True), (MANY, 1, 1)), jnp.float32
    )
    moved, turned = (
        np.asarray(x)
        for x in wrist_off(path, turns, jnp.ones(MANY), _uniform(MANY, wrist_numbers(4)))
    )
    assert (moved[:, -1] - path[:, -1]).std() == pytest.approx(WRIST[0], rel=0.05)
    by = [
        Rotation.from_quat(turned[:, k], scalar_first=True)
        * Rotation.from_quat(turns[:, k], scalar_first=True).inv()
        for k in range(4)
    ]
    for k in range(3):
        np.testing.assert_allclose((by[k] * by[-1].inv()).magnitude(), 0.0, atol=1e-5)
        way = by[-1].apply(np.asarray(path[:, k] - path[:, -1]))
        rest = moved[:, k] - moved[:, -1] - way
        assert rest.std() == pytest.approx(JITTER, rel=0.05)
    assert by[-1].as_rotvec().std() == pytest.approx(WRIST[1], rel=0.05)
