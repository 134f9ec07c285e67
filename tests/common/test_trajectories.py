"""Wrist trajectories made backwards from reference poses, by the paper's numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.task.sampling.build import AMPLITUDE, CONE, DISTANCE, ROTATION, make_trajectories
from tests.scenes import quaternions

HAND = get_hand("human")
COUNT, WAYPOINTS = 64, 15


def _make(position, quaternion):
    path, turns = make_trajectories(
        HAND, jnp.asarray(position), jnp.asarray(quaternion), jax.random.key(3), waypoints=WAYPOINTS
    )
    return np.asarray(path), np.asarray(turns)


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    return rng.normal(scale=0.1, size=(COUNT, 3)).astype(np.float32), quaternions(rng, COUNT)


@pytest.fixture(scope="module")
def made(poses):
    return _make(*poses)


def test_they_come_from_afar_and_end_at_their_poses(poses, made):
    (position, quaternion), (path, turns) = poses, made
    assert path.shape == (COUNT, WAYPOINTS, 3) and turns.shape == (COUNT, WAYPOINTS, 4)
    # The controller has a quarter of a second to settle, five of its time constants of 0.05 s: e^-5 of 25 cm is 2 mm.
    np.testing.assert_allclose(path[:, -1], position, atol=2e-3)
    end = Rotation.from_quat(quaternion, scalar_first=True)
    final = Rotation.from_quat(turns[:, -1], scalar_first=True)
    assert (end.inv() * final).magnitude().max() < np.exp(-5) * ROTATION + 1e-3

    away = path[:, 0] - position
    distance = np.linalg.norm(away, axis=-1)
    assert DISTANCE[0] - 1e-4 <= distance.min() and distance.max() <= DISTANCE[1] + 1e-4
    outward = -end.apply(grasp_frame(HAND).heading)
    assert np.arccos(np.sum(away * outward, -1) / distance).max() <= CONE + 1e-3
    first = Rotation.from_quat(turns[:, 0], scalar_first=True)
    assert (first * end.inv()).magnitude().max() <= ROTATION + 1e-3


def test_waypoints_are_evenly_spaced_and_leave_the_straight_line(poses, made):
    path, turns = made
    steps = np.linalg.norm(np.diff(path, axis=1), axis=-1)
    # Chords of equal arcs: shorter than the arc by no more than its bend.
    assert (steps.std(-1) / steps.mean(-1)).max() < 0.05
    chord = path[:, -1] - path[:, 0]
    chord /= np.linalg.norm(chord, axis=-1, keepdims=True)
    off = path - path[:, :1]
    aside = np.linalg.norm(off - np.sum(off * chord[:, None], -1, keepdims=True) * chord[:, None], axis=-1).max(-1)
    assert aside.max() <= AMPLITUDE[1] and np.median(aside) > AMPLITUDE[0] / 2
    np.testing.assert_allclose(np.linalg.norm(turns, axis=-1), 1.0, atol=1e-5)
    assert (np.sum(turns[:, 1:] * turns[:, :-1], -1) > 0.9).all()  # neighbours in one hemisphere
