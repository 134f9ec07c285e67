"""A hand of one's own: one JSON file, written here by hand, and nothing else."""

import json

import mujoco
import numpy as np
import pytest

from congrasp.actors.physics.scene import scene_spec
from congrasp.common.hands import HANDS, VARIABLE, get_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.task.config import TaskConfig


def link(name, parent, joints, start, end, tip=None):
    capsule = {"start": start, "end": end, "radius": 0.01}
    return {
        "name": name,
        "parent": parent,
        "joints": joints,
        "capsules": [capsule],
        "mass": 0.05,
        "contact_weight": 1.0,
        "tip": tip,
    }


def finger(name, x, way):
    """A finger of one joint at x (m), which closes the other way round y for the thumb."""
    joint = {
        "name": f"{name}_flexion",
        "axis": [0.0, way, 0.0],
        "anchor": [x, 0.0, 0.05],
        "lower": 0.0,
        "upper": 1.2,
        "kp": 2.0,
        "kv": 0.05,
        "torque_limit": 1.0,
    }
    end = [x, 0.0, 0.13]
    return link(name, "palm", [joint], [x, 0.0, 0.05], end, end)


PINCERS = {
    "format": 1,
    "name": "pincers",
    "links": [
        link("palm", "", [], [-0.04, 0.0, 0.03], [0.04, 0.0, 0.03]),
        finger("thumb", -0.05, 1.0),
        finger("index", 0.05, -1.0),
    ],
    "thumb": "thumb",
    "open_pose": {},
    "closed_pose": {"thumb_flexion": 0.5, "index_flexion": 0.5},
    "wrist": dict(
        slide_kp=1000.0,
        slide_kv=50.0,
        slide_limit=150.0,
        slide_armature=0.2,
        hinge_kp=50.0,
        hinge_kv=3.0,
        hinge_limit=20.0,
        hinge_armature=0.01,
    ),
}


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    get_hand.cache_clear()
    path = tmp_path / "pincers.json"
    path.write_text(json.dumps(PINCERS))
    yield path
    get_hand.cache_clear()


def test_a_hand_from_outside_needs_one_file(file):
    assert "pincers" not in HANDS
    for reference in ("pincers", str(file)):
        task = TaskConfig(hand=reference)
        hand = get_hand(task.hand)
        assert hand.name == "pincers" and len(hand.joints) == 2
        frame = grasp_frame(hand)
        np.testing.assert_allclose(frame.cross, [1, 0, 0], atol=1e-6)
        np.testing.assert_allclose(frame.center, [0, 0, 0.13], atol=1e-6)
        model = scene_spec(hand, task).compile()
        data = mujoco.MjData(model)
        data.ctrl[6:] = hand.q_closed  # actuators are the wrist's six, then the fingers'
        for _ in range(500):
            mujoco.mj_step(model, data)
        q = [data.joint(joint.name).qpos[0] for joint in hand.joints]
        np.testing.assert_allclose(q, hand.q_closed, atol=0.05)
