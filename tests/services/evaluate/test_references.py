"""References of a reference policy: where they come from, and how they are split."""

import dataclasses
import pathlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy import pretrained
from congrasp.common.policy.pretrained import policy_file, pretrained_hands, reference_file
from congrasp.common.task.sampling.closed_poses import Poses
from congrasp.common.task.sampling.object_headings import POSES
from congrasp.services.evaluate import references
from congrasp.services.evaluate.references import HELD_OUT
from tests import task

CLAW = pathlib.Path(__file__).parents[2] / "hands" / "claw.json"


@pytest.fixture(scope="module")
def bank():
    return task.bank()


@pytest.fixture(scope="module")
def policy():
    return bundles.load(reference_file("human"))


def policy_of(hand):
    """A policy of another hand."""
    spec = dataclasses.replace(task.policy().spec, hand=hand)
    return dataclasses.replace(task.policy(), spec=spec)


def test_reference_policies_never_had_poses_or_trajectories():
    for hand in pretrained_hands():
        bundle = bundles.load(reference_file(hand))
        assert bundle.spec.hand == hand
        assert set(bundle.task.constraints) == {
            "heading",
            "affordance",
        }
        policy, _ = references.reference_policy(bundles.load(policy_file(None, hand)))
        assert policy.task == bundle.task


@pytest.mark.parametrize("hand", ["human", "allegro", "sharpa"])
def test_a_missing_reference_policy_is_an_error(tmp_path, monkeypatch, hand):
    """Grasps of the policy under test do not replace it."""
    policy = policy_of(hand)
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    with pytest.raises(CongraspError, match=rf"{hand}-reference\.safetensors is missing"):
        references.reference_policy(policy)


def test_a_custom_hand_has_the_policy_itself_as_reference(tmp_path, monkeypatch):
    policy = policy_of(CLAW.read_text())
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    assert references.reference_policy(policy)[0] is policy


@pytest.mark.parametrize("count", range(1, POSES + 1))
def test_held_out_references_are_not_for_training(count):
    order = references.arrange(count)
    training = order[:-HELD_OUT]
    held_out = order[-HELD_OUT:]
    assert len(order) == POSES
    assert set(order) <= set(range(count))
    if count > 1:
        assert set(order) == set(range(count))
        assert not set(training) & set(held_out)
    if count == POSES:
        np.testing.assert_array_equal(order, np.arange(POSES))


def test_objects_that_the_policy_cannot_grasp_keep_geometric_references(bank, policy):
    bank = bank._replace(rest=np.repeat(np.asarray(bank.rest)[:, :1], bank.rest.shape[1], 1))
    valid = np.asarray(bank.pose_valid)
    good = int(np.flatnonzero(valid[0, 0, 0])[0])
    low = Poses(
        *(
            np.asarray(field)[0, 0, good]
            for field in (bank.pose_q, bank.pose_position, bank.pose_quaternion)
        )
    )
    down = [
        Rotation.from_quat(rest[3:], scalar_first=True).inv().apply([0, 0, -1.0])
        for rest in bank.rest[:, 0]
    ]
    of_policy, *below = (
        low._replace(position=low.position + way.astype(np.float32)) for way in (-down[0], *down)
    )
    with_grasps = references.with_references(
        policy,
        task.TASK,
        bank,
        [[[of_policy, below[0], of_policy], []], [[below[1]], []], *[[[], []]] * 2],
    )
    np.testing.assert_array_equal(with_grasps.grasps, [[2, 0], [0, 0], [0, 0], [0, 0]])
    np.testing.assert_array_equal(with_grasps.bank.pose_q[0, 0], np.tile(of_policy.q, (POSES, 1)))
    closed = np.asarray(bank.pose_q)[1, 0]
    for q in np.asarray(with_grasps.bank.pose_q)[1, 0]:
        assert any(np.array_equal(q, other) for other in closed)
    # Of those that the table leaves room for
    assert np.asarray(with_grasps.bank.pose_valid)[:, 0].any(1).all()
    for field in ("points", "heading_position", "rest"):
        np.testing.assert_array_equal(getattr(with_grasps.bank, field), getattr(bank, field))
