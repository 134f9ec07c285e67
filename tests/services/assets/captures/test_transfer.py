"""Captured grasps for robot hands: what follows the human hand, and what does not."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common.hands import get_hand
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.kinematics import grasp_frame, keypoints, link_transforms
from congrasp.common.task.sampling.build import HEADINGS
from congrasp.common.task.sampling.sets import bank_of, describe
from congrasp.services.assets.captures.human import joint_positions
from tests.services.assets.captures import known
from tests.services.assets.captures.test_myohand import write


def axes(hand):
    frame = grasp_frame(hand)
    return np.stack([frame.heading, frame.cross])


@pytest.mark.parametrize("name", ["allegro", pytest.param("sharpa", marks=pytest.mark.slow)])
def test_the_hand_centre_and_grasp_axes_follow_the_human_ones(run_import, tmp_path, capsys, name):
    cases = [known.make(f"MyoHand_box_lift{seed}", "box", seed, tail=0.04) for seed in range(2)]
    for case in cases:
        write(case, tmp_path / "data" / f"{case.name}.npz")
    # Beyond what a human finger can do, which does not matter to another hand.
    far = np.load(tmp_path / "data" / f"{cases[1].name}.npz")["robot"]
    far[:, 9 + 19] = HUMAN.upper[19] + 0.5
    write(cases[1], tmp_path / "data" / f"{cases[1].name}.npz", robot=far)
    known.write_mesh(cases[0], tmp_path / "meshes" / "box.stl")
    options = ["--meshes", tmp_path / "meshes", "--headings", "demonstrated"]
    sets, report = run_import("myohand", tmp_path / "data", "--hand", name, *options)
    assert not report.dropped and "finger angles do not fit" in " ".join(capsys.readouterr().out.split())

    hand, scale = get_hand(name), get_hand(name).object_scale
    made = sets["box"]
    arrays = made.arrays
    assert made.meta["hand"] == name and made.meta["object_scale"] == scale
    assert len(describe(made)["captured"].split(", ")) == 2
    for m, case in enumerate(cases):
        q = arrays["pose/q"][0, m]
        assert q.shape == hand.lower.shape and (q >= hand.lower).all() and (q <= hand.upper).all()
        tips = np.asarray(keypoints(hand, link_transforms(hand, jnp.asarray(q))))[len(hand.links) :]
        center = (tips[0] + tips[1:].mean(0)) / 2
        human = np.clip(far[-1, 9:] if m else case.q, HUMAN.lower, HUMAN.upper)
        human_tips = joint_positions(human)[:, 3]
        position, turns = case.waypoints()
        wanted = scale * (position + turns.apply((human_tips[0] + human_tips[1:].mean(0)) / 2))
        found = Rotation.from_quat(arrays["trajectory/quaternion"][0, m], scalar_first=True)
        path = arrays["trajectory/position"][0, m]
        held = found[-1].inv().apply(wanted[-1] - path[-1])  # the hand centre of the closed hand, wrist frame
        np.testing.assert_allclose(path + found.apply(held), wanted, atol=1e-3)
        assert np.linalg.norm(held - center) < 0.03  # fingers that close again move it a little
        for own, theirs in zip(axes(hand), axes(HUMAN), strict=True):
            assert (np.linalg.norm(found.apply(own) - turns.apply(theirs), axis=-1) < 0.01).all()
        np.testing.assert_allclose(arrays["heading/position"][0, m], wanted[-1], atol=1e-3)
        np.testing.assert_array_equal(arrays["pose/position"][0, m], arrays["trajectory/position"][0, m, -1])
    assert arrays["heading/position"].shape[1] == HEADINGS
    assert bank_of([made]).pose_q.shape[-1] == len(hand.joints)
