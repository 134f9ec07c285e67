"""Fingers of imported hands: one for each tip, and the checks that find what belongs to none."""

import dataclasses
import pathlib

import pytest

from congrasp.common.hands.files import hand_faults, hand_from_text, hand_text
from congrasp.common.hands.spec import Hand
from congrasp.services.assets.hands.finger_checks import finger_findings
from congrasp.services.assets.hands.model_files import Proposal, propose

FINGER = """
  <body name="{name}" pos="{x} {y} 0.02"><joint name="{name}_root" axis="0 {sign} 0" range="-0.3 1.4"/>
    <geom type="capsule" size="0.008" fromto="0 0 0 0 0 0.04"/>
    <body name="{name}_end" pos="0 0 0.04"><joint name="{name}_bend" axis="0 {sign} 0" range="0 1.4"/>
      <geom type="capsule" size="0.008" fromto="0 0 0 0 0 0.03"/>{more}</body></body>"""
CARRIER = """
  <body name="carrier" pos="0.03 0 0"><joint name="arch" axis="0 0 1" range="-0.2 0.2"/>
    <geom type="box" size="0.01 0.03 0.01"/>{fingers}</body>"""
ROD = """
  <body name="{name}" pos="{x} 0 0.02"><joint name="{name}_turn" axis="0 1 0" range="-0.3 1.4"/>
    <geom type="capsule" size="0.004" fromto="0 0 0 0 0 0.03"/></body>"""
TIE = '<connect body1="{first}" body2="{second}" anchor="0 0 0.03"/>'


def finger(name: str, x: float, y: float = 0.0, more: str = "") -> str:
    """A finger of two links that closes towards x = 0."""
    sign = -1 if x > 0 else 1
    return FINGER.format(name=name, x=x, y=y, sign=sign, more=more)


THUMB = finger("thumb", -0.04)
INDEX = finger("index", 0.04, 0.02)


def imported(folder: pathlib.Path, bodies: str, equalities: str = "") -> Proposal:
    """The hand of a palm with these bodies."""
    text = f"""
    <mujoco><compiler angle="radian" autolimits="true"/><worldbody>
    <body name="palm"><geom type="box" size="0.04 0.04 0.02"/>{bodies}</body>
    </worldbody><equality>{equalities}</equality></mujoco>"""
    file = folder / "hand.xml"
    file.write_text(text)
    return propose(file)


def fingers_of(hand: Hand) -> dict[str, str]:
    """The first link of each finger by its last."""
    ends = [hand.links[i].name for i in hand.tip_links]
    return dict(zip(ends, hand.finger_roots, strict=True))


@pytest.fixture(scope="module")
def carried(tmp_path_factory) -> Hand:
    """A hand whose palm carries thumb and index finger, and a link that carries two more."""
    two = finger("ring", 0.01, -0.01) + finger("little", 0.01, -0.03)
    folder = tmp_path_factory.mktemp("carried")
    return imported(folder, THUMB + INDEX + CARRIER.format(fingers=two)).hand


def test_fingers_on_a_carrying_link_are_all_imported(carried):
    roots = {"thumb_end": "thumb", "index_end": "index", "ring_end": "ring", "little_end": "little"}
    assert fingers_of(carried) == roots
    fingers = dict(zip((link.name for link in carried.links), carried.link_fingers, strict=True))
    assert fingers["palm"] == fingers["carrier"] == -1
    assert fingers["ring"] == fingers["ring_end"] != fingers["little"] == fingers["little_end"]
    arch = [joint.name for joint in carried.joints].index("arch")
    moved = {carried.fingers[i] for i in carried.moved_tips[arch].nonzero()[0]}
    assert moved == {"ring", "little"}


def test_fingers_on_a_carrying_link_close(carried):
    assert not hand_faults(carried)
    for name in ("ring", "little"):
        assert carried.closed_pose[f"{name}_bend"] > carried.open_pose.get(f"{name}_bend", 0.0)
    assert [finding.verdict for finding in finger_findings(carried)] == ["passed"]
    assert hand_faults(hand_from_text(hand_text(carried))) == []


def test_finger_branch_that_is_short_is_no_finger(tmp_path):
    flap = '<body name="flap"><joint name="flap_turn" axis="0 1 0" range="0 1"/><geom size="0.004"/></body>'
    long = finger("index", 0.04, 0.02, more=finger("far", 0.001) + flap)
    proposal = imported(tmp_path, THUMB + long)
    assert fingers_of(proposal.hand) == {"thumb_end": "thumb", "far_end": "index"}
    assert any("flap" in note for note in proposal.notes)
    verdicts = {f.measured.split("'")[1]: f.verdict for f in finger_findings(proposal.hand)}
    assert verdicts["flap"] == "doubt"


def test_rods_of_a_linkage_are_no_fingers(tmp_path):
    rods = ROD.format(name="rod", x=0.03)
    tie = TIE.format(first="rod", second="index_end")
    proposal = imported(tmp_path, THUMB + INDEX + rods, tie)
    assert set(fingers_of(proposal.hand)) == {"thumb_end", "index_end"}
    failed = [f for f in finger_findings(proposal.hand) if f.verdict == "failed"]
    assert {f.measured.split("'")[1] for f in failed} == {"rod", "rod_turn"}


def test_check_of_a_lost_finger_fails(carried):
    """As imported by versions that knew one finger for each branch of the palm."""
    links = tuple(
        dataclasses.replace(link, tip=None) if link.name == "little_end" else link
        for link in carried.links
    )
    hand = dataclasses.replace(carried, links=links)
    assert not hand_faults(hand)
    failed = {f.measured.split("'")[1]: f.check for f in finger_findings(hand)}
    assert failed == {"little_end": "finger", "little_root": "motor", "little_bend": "motor"}
    assert {f.verdict for f in finger_findings(hand)} == {"failed"}


def test_check_of_a_tip_at_rest_fails(carried):
    closed = carried.closed_pose.copy()
    for joint in ("ring_root", "ring_bend"):
        closed[joint] = carried.open_pose.get(joint, 0.0)
    closed["arch"] = carried.open_pose.get("arch", 0.0)
    (finding,) = finger_findings(dataclasses.replace(carried, closed_pose=closed))
    assert finding.check == "finger"
    assert finding.verdict == "failed"
    assert "'ring'" in finding.measured


def test_check_of_a_bending_joint_at_rest_fails(carried):
    closed = carried.closed_pose | {"ring_bend": carried.open_pose.get("ring_bend", 0.0)}
    (finding,) = finger_findings(dataclasses.replace(carried, closed_pose=closed))
    assert finding.check == "joint"
    assert finding.verdict == "failed"
    assert "'ring_bend'" in finding.measured


def test_two_tips_on_one_finger_are_a_fault(carried):
    links = tuple(
        dataclasses.replace(link, tip=(0.0, 0.0, 0.1)) if link.name == "ring" else link
        for link in carried.links
    )
    (fault,) = hand_faults(dataclasses.replace(carried, links=links))
    assert "'ring'" in fault
    assert "'ring_end'" in fault
