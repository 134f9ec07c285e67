"""A hand of one's own is one JSON file and nothing else."""

import pathlib
import shutil

import mujoco
import numpy as np

from congrasp.actors.physics.scene import scene_spec
from congrasp.common.hands import HANDS, VARIABLE, get_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.task.config import TaskConfig


def test_a_hand_from_outside_needs_one_file(tmp_path, monkeypatch):
    file = pathlib.Path(shutil.copy(pathlib.Path(__file__).parents[3] / "hands" / "claw.json", tmp_path))
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    get_hand.cache_clear()
    assert "claw" not in HANDS
    for reference in ("claw", str(file)):
        task = TaskConfig(hand=reference, hand_self_collision=False)
        hand = get_hand(task.hand)
        assert hand.name == "claw" and len(hand.joints) == 6
        np.testing.assert_allclose(grasp_frame(hand).heading, [0, 0, 1], atol=0.1)
        model = scene_spec(hand, task).compile()
        data = mujoco.MjData(model)
        data.ctrl[6:] = hand.q_closed  # actuators are the wrist's six, then the fingers'
        for _ in range(500):
            mujoco.mj_step(model, data)
        q = [data.joint(joint.name).qpos[0] for joint in hand.joints]
        np.testing.assert_allclose(q, hand.q_closed, atol=0.05)
    get_hand.cache_clear()
