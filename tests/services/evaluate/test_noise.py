"""Noise of references: its size and its direction, and the rows of the table."""

from unittest import mock

import numpy as np
import pytest
from PIL import Image

from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.task.sampling import sets as stored_sets
from congrasp.services.evaluate.evaluator import Evaluator
from congrasp.services.evaluate.noise import LEVELS, Noise, with_noise
from congrasp.services.evaluate.noise_sheet import draw_curves
from tests.task import HAND, OBJECTS, policy
from tests.task import bank as make_bank


@pytest.fixture(scope="module")
def bank():
    return make_bank()


def test_joint_noise_has_its_size_and_stays_within_the_limits(bank):
    noisy = with_noise(HAND, bank, Noise("pose", "joints", 0.1), 0)
    q = np.asarray(bank.pose_q)
    away = (noisy.pose_q - q)[(q > HAND.lower + 0.4) & (q < HAND.upper - 0.4)]
    assert 0.095 < away.std() < 0.105 and abs(away.mean()) < 0.005
    assert np.all(noisy.pose_q >= HAND.lower) and np.all(noisy.pose_q <= HAND.upper)
    np.testing.assert_array_equal(noisy.pose_position, bank.pose_position)


def test_poses_sink_along_the_heading(bank):
    noisy = with_noise(HAND, bank, Noise("pose", "depth", 0.01), 0)
    moved = np.asarray(noisy.pose_position) - np.asarray(bank.pose_position)
    w, *v = np.moveaxis(np.asarray(bank.pose_quaternion, float), -1, 0)
    axis = np.broadcast_to(grasp_frame(HAND).heading, moved.shape)
    v = np.stack(v, -1)
    heading = axis + 2 * np.cross(v, np.cross(v, axis) + w[..., None] * axis)
    depth = (moved * heading).sum(-1)
    assert depth.min() >= 0 and 0.0095 < depth.max() <= 0.01001
    np.testing.assert_allclose(moved, depth[..., None] * heading, atol=1e-6)


def test_jitter_moves_every_waypoint(bank):
    noisy = with_noise(HAND, bank, Noise("trajectory", "jitter", 0.01), 0)
    away = np.asarray(noisy.trajectory_position) - np.asarray(bank.trajectory_position)
    assert 0.0098 < away.std() < 0.0102 and np.all(np.abs(away).max((0, 1, 2, 4)) > 0)
    np.testing.assert_array_equal(noisy.trajectory_quaternion, bank.trajectory_quaternion)


def test_all_rows_have_the_same_references(bank, monkeypatch):
    evaluator, running = Evaluator(policy(), OBJECTS, bank=bank), mock.MagicMock()
    running.__enter__.return_value = running
    monkeypatch.setattr(evaluator, "_episodes", lambda episodes: running)
    told, runs = [], []

    def run(running, name, plan, noisy, progress):
        runs.append((plan, noisy))
        progress(plan.total)
        return plan.total

    monkeypatch.setattr(evaluator, "_run", run)
    row = lambda constraint, sample, group: mock.Mock(constraint=constraint, group=group, episodes=sample)  # noqa: E731
    monkeypatch.setattr(evaluator, "row", row)
    rows = evaluator.rows_under_noise(told.append, 5)
    assert [(row.constraint, row.group) for row in rows] == [(noise.constraint, noise.label) for noise in LEVELS]
    assert told == np.cumsum([plan.total for plan, _ in runs]).tolist()
    for noise, (plan, seen) in zip(LEVELS, runs, strict=True):
        expected = with_noise(HAND, bank, noise, 0)
        assert plan.constraint == noise.constraint and plan.total >= 5
        for name in ("pose_q", "pose_position", "trajectory_position"):
            np.testing.assert_array_equal(getattr(seen, name), getattr(expected, name))


def test_curves_show_every_kind_of_noise(tmp_path):
    errors = {"pose_rad": 0.1, "pose_m": 0.01, "traj_rad": 0.1, "traj_m": 0.01}
    row = mock.Mock(success=0.9, success_low=0.8, success_high=0.95, errors=errors)
    row.held_2s, row.held_2s_low, row.held_2s_high = 0.8, 0.7, 0.9
    draw_curves([row] * len(LEVELS), tmp_path / "noise.png", "made up")
    picture = np.asarray(Image.open(tmp_path / "noise.png").convert("RGB")).astype(int)
    for part in np.array_split(picture, 3, axis=1):  # the lines of success in each panel
        red, _, blue = part.reshape(-1, 3).T
        assert (blue - red > 100).sum() > 50


def test_a_constraint_bank_comes_back_from_its_files(bank, constraint_sets):
    sets = constraint_sets
    back = stored_sets.bank_of(sets)
    for name in ("points", "avoid", "heading_position", "pose_q", "trajectory_position", "pose_quaternion"):
        np.testing.assert_array_equal(getattr(back, name), getattr(bank, name))
    for n in range(len(OBJECTS)):
        rests = len(sets[n].arrays["rest"])
        np.testing.assert_array_equal(back.pose_valid[n, :, :rests], bank.pose_valid[n, :, :rests])
        for v, r in np.ndindex(2, rests):
            if v == 0 or bank.has_affordance[n, r]:
                asked, found = bank.heading_index[n, v, r], back.heading_index[n, v, r]
                assert set(np.asarray(asked)) == set(np.asarray(found))
                back_of = dict(zip(np.asarray(asked), np.asarray(bank.heading_back[n, v, r]), strict=True))
                np.testing.assert_allclose([back_of[i] for i in found], back.heading_back[n, v, r])
        np.testing.assert_array_equal(back.has_affordance[n, :rests], bank.has_affordance[n, :rests])
    held = stored_sets.bank_of(sets, "held-out")
    training = stored_sets.bank_of(sets, "training")
    assert not np.any(held.pose_valid[:, 0, 0] & training.pose_valid[:, 0, 0])
    assert 0 < held.pose_valid[:, 0].any(1).mean() < training.pose_valid[:, 0].any(1).mean()
