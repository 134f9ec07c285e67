"""The self-check: good hands pass, and what is wrong with a hand is found by the line that is about
it.
"""

import dataclasses
import functools
import pathlib
import re

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.files import hand_faults, hand_text
from congrasp.common.hands.spec import Coupling
from congrasp.services.assets.hands import check, geometry_checks, physics_checks, trials
from congrasp.services.assets.hands.check import check_hand
from congrasp.services.assets.hands.model_files import propose
from congrasp.services.cli import main
from congrasp.services.train.presets import recipe
from congrasp.services.viz import hand_sheets

HANDS = ("claw", "human", "allegro", "sharpa")
SLOW = ("allegro", "sharpa")


@functools.cache
def claw():
    return propose(pathlib.Path(__file__).parents[3] / "hands" / "claw.urdf").hand


def hand_of(name):
    return claw() if name == "claw" else get_hand(name)


def with_joints(hand, change, only=""):
    """The hand with `change` of each joint, or of the one of this name."""

    def changed(joint):
        return change(joint) if only in ("", joint.name) else joint

    links = []
    for link in hand.links:
        links.append(dataclasses.replace(link, joints=tuple(map(changed, link.joints))))
    return dataclasses.replace(hand, links=tuple(links))


@functools.cache
def verdicts(hand):
    """The first finding of each check by its name, and all that was found."""
    assert not hand_faults(hand)
    report = check_hand(hand, recipe(hand).task, 2)
    lines = {}
    for finding in report.findings:
        assert bool(finding.remedy) == (finding.verdict != "passed")
        lines.setdefault(finding.check, finding)
    return lines, report


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=pytest.mark.slow) if x in SLOW else x for x in HANDS]
)
def test_good_hands_pass_every_check(name):
    lines, report = verdicts(hand_of(name))
    assert not report.failed
    assert {finding.verdict for finding in lines.values()} == {"passed"}
    assert [grip.obj.name for grip in report.grips] == ["ball", "cylinder", "box"]
    for grip in report.grips:
        assert grip.held
        assert grip.survived["push_survival_weight"]
        assert grip.touching.sum() >= 2


def test_a_reversed_axis_is_found_and_named():
    turned = with_joints(
        claw(),
        lambda j: dataclasses.replace(j, axis=tuple(-x for x in j.axis)),
        only="opposing_root",
    )
    lines, report = verdicts(turned)
    assert report.failed
    assert lines["joint"].verdict == "failed"
    assert "'opposing_root'" in lines["joint"].measured
    assert "axis" in lines["joint"].remedy
    assert "closed_pose" in lines["joint"].remedy


@pytest.mark.parametrize(("ratio", "verdict"), [(-1.0, "doubt"), (-0.5, "failed")])
def test_a_follower_that_opens_is_a_doubt_if_it_keeps_its_pad_parallel(ratio, verdict):
    pose = {name: angle for name, angle in claw().closed_pose.items() if name != "opposing_middle"}
    opened = {name: angle for name, angle in claw().open_pose.items() if name != "opposing_middle"}
    follows = (Coupling("opposing_middle", "opposing_root", ratio, 0.0),)
    hand = dataclasses.replace(claw(), couplings=follows, open_pose=opened, closed_pose=pose)
    (finding,) = (one for one in geometry_checks.joint_findings(hand) if one.check == "joint")
    assert finding.verdict == verdict
    assert "'opposing_middle'" in finding.measured
    assert ("parallel" in finding.remedy) == (verdict == "doubt")


def test_both_pads_of_a_gripper_of_one_motor_stay_parallel():
    hand = propose(pathlib.Path(__file__).parents[3] / "hands" / "pincher.urdf").hand
    angles = {
        one.measured.split("'")[1]: one.verdict
        for one in geometry_checks.joint_findings(hand)
        if one.check == "joint"
    }
    assert angles == {"left_parallel": "doubt", "right_parallel": "doubt"}


def moved(vector, by):
    return tuple(np.add(vector, by).tolist())


def shifted(link, by):
    """The link somewhere else, with its joints, capsules and tip."""
    return dataclasses.replace(
        link,
        joints=tuple(dataclasses.replace(j, anchor=moved(j.anchor, by)) for j in link.joints),
        capsules=tuple(
            dataclasses.replace(c, start=moved(c.start, by), end=moved(c.end, by))
            for c in link.capsules
        ),
        tip=link.tip and moved(link.tip, by),
    )


def test_a_palm_that_is_far_from_the_grasp_frame_is_found():
    palm = claw().links[0]
    away = tuple(
        dataclasses.replace(
            one, start=moved(one.start, (0, 0, -0.2)), end=moved(one.end, (0, 0, -0.2))
        )
        for one in palm.capsules
    )
    hand = dataclasses.replace(
        claw(), links=(dataclasses.replace(palm, capsules=away), *claw().links[1:])
    )
    finding = geometry_checks.palm_finding(hand)
    assert finding.verdict == "failed"
    assert "20.1 cm" in finding.measured
    assert "--palm" in finding.remedy
    # All of the hand at the end of a forearm of 40 cm, whose wrist does not move.
    by = np.array([0, 0, 0.4])
    links = tuple(shifted(link, by) for link in claw().links)
    finding = geometry_checks.palm_finding(dataclasses.replace(claw(), links=links))
    assert finding.verdict == "failed"
    assert re.search(r" 5\.\d fingers' lengths from the wrist", finding.measured)


def test_gains_that_shake_are_found_and_named():
    loose = with_joints(
        claw(),
        lambda j: dataclasses.replace(j, kp=20 * j.kp, kv=0.0, damping=0.0),
        only="left_middle",
    )
    findings = physics_checks.servo_findings(loose, trials.responses(loose, recipe(loose).task, 2))
    assert [finding.verdict for finding in findings] == ["failed"]
    assert "'left_middle'" in findings[0].measured
    assert "raise kv" in findings[0].remedy
    soft = with_joints(claw(), lambda j: dataclasses.replace(j, kp=0.05, kv=1.0))
    findings = physics_checks.servo_findings(soft, trials.responses(soft, recipe(soft).task, 2))
    assert len(findings) == 6
    assert all("raise kp" in finding.remedy for finding in findings)


def test_torques_that_are_too_weak_are_found_and_hold_nothing():
    weak = with_joints(claw(), lambda j: dataclasses.replace(j, torque_limit=0.01 * j.torque_limit))
    lines, _ = verdicts(weak)
    assert lines["strength"].verdict == "failed"
    assert "torque_limit" in lines["strength"].remedy
    assert lines["cylinder"].verdict == "failed"
    assert "repair the failures above first" in lines["cylinder"].remedy
    assert {lines[name].verdict for name in ("palm", "joints", "opening", "open", "closed")} == {
        "passed"
    }


def test_objects_that_are_too_large_and_fingers_in_one_another_are_found():
    finding = geometry_checks.opening_finding(dataclasses.replace(claw(), object_scale=3.0))
    assert finding.verdict == "failed"
    assert re.match(r"object_scale 1\.\d \(import", finding.remedy)
    wide = dataclasses.replace(claw(), open_pose={}, closed_pose={})  # never closes
    assert geometry_checks.joint_findings(wide)[0].verdict == "failed"
    assert "closed_pose" in geometry_checks.joint_findings(wide)[0].remedy
    by = np.array([0.0, 0.05, 0.0])
    links = tuple(
        shifted(link, by) if link.name.startswith("right") else link for link in claw().links
    )
    crossed = dataclasses.replace(claw(), links=links)
    assert geometry_checks.open_overlap_finding(crossed).verdict == "failed"
    assert "left_lower" in geometry_checks.open_overlap_finding(crossed).measured


def test_exit_codes_of_the_command(monkeypatch, tmp_path, capsys):
    _, report = verdicts(claw())
    monkeypatch.setattr(check, "check_hand", lambda hand, task, threads: report)
    file = tmp_path / "claw.json"
    file.write_text(hand_text(claw()))
    assert main.run(["hands", "check", str(file), "--png", str(tmp_path / "claw.png")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(report.findings) + 1
    assert lines[0].startswith("passed  palm")
    assert (tmp_path / "claw.png").stat().st_size > 20_000
    failed = report._replace(
        findings=[report.findings[0]._replace(verdict="failed", remedy="another palm")]
    )
    monkeypatch.setattr(check, "check_hand", lambda hand, task, threads: failed)
    # Drawn above
    monkeypatch.setattr(
        hand_sheets, "check_sheet", lambda hand, grips: np.zeros((4, 4, 3), np.uint8)
    )
    assert main.run(["hands", "check", str(file), "--png", str(tmp_path / "claw.png")]) == 1
    assert "-> another palm" in capsys.readouterr().out
    with pytest.raises(CongraspError, match="no hand 'paw'"):
        main.run(["hands", "check", "paw"])
