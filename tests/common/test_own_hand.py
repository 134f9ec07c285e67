"""A hand of one's own is one JSON file and nothing else, by path, by name and by its text."""

import pathlib
import shutil

import mujoco
import numpy as np

from congrasp.actors.physics.scene import scene_spec
from congrasp.common.config import run_config_from_json, to_json
from congrasp.common.hands import HANDS, VARIABLE, get_hand
from congrasp.common.hands.files import hand_text, read_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.policy.bundle import policy_spec
from congrasp.common.task.config import TaskConfig
from congrasp.services.train.presets import get_preset, with_hand

FILE = pathlib.Path(__file__).parents[1] / "hands" / "claw.json"


def test_a_hand_from_outside_needs_one_file(tmp_path, monkeypatch):
    file = pathlib.Path(shutil.copy(FILE, tmp_path))
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    get_hand.cache_clear()
    assert "claw" not in HANDS
    for reference in ("claw", str(file)):
        task = TaskConfig(hand=reference, hand_self_collision=False)
        hand = get_hand(task.hand)
        assert hand.name == "claw"
        assert len(hand.joints) == 6
        np.testing.assert_allclose(grasp_frame(hand).heading, [0, 0, 1], atol=0.1)
        model = scene_spec(hand, task).compile()
        data = mujoco.MjData(model)
        data.ctrl[6:] = hand.q_closed  # actuators are the wrist's six, then the fingers'
        for _ in range(500):
            mujoco.mj_step(model, data)
        q = [data.joint(joint.name).qpos[0] for joint in hand.joints]
        np.testing.assert_allclose(q, hand.q_closed, atol=0.05)
    get_hand.cache_clear()


def test_a_hand_file_is_a_hand_by_path_by_name_and_by_its_text(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    get_hand.cache_clear()
    claw = read_hand(FILE)
    path = pathlib.Path(shutil.copy(FILE, tmp_path))
    assert get_hand(str(path)) is get_hand("claw") is get_hand(claw.reference) is claw
    config = with_hand(get_preset("quickstart"), "claw")
    path.unlink()  # actors elsewhere do not have the file
    travelled = run_config_from_json(to_json(config))
    assert get_hand(travelled.task.hand) is claw
    spec = policy_spec(travelled.task, travelled.network)
    assert spec.hand_name == "claw"
    assert spec.action_size == 12
    assert spec.schema != policy_spec(TaskConfig(), travelled.network).schema


def test_a_hand_file_from_before_links_had_solids_stays_as_it_is():
    """Its text names the hand in policies, and says whether a training that was interrupted was of
    this hand.
    """
    assert hand_text(read_hand(FILE)) == FILE.read_text()
