"""Hands of one's own: from URDF and MJCF to a file, and from the file to everywhere."""

import itertools
import pathlib
import re
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest
import trimesh

from congrasp.common.hands import VARIABLE, get_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.meshes import MAX_FACES
from congrasp.common.hands.mjcf import add_hand
from congrasp.services.assets.hands.actuators import Drive
from congrasp.services.assets.hands.compile import robot_spec
from congrasp.services.assets.hands.model_files import Choices, propose
from congrasp.services.assets.hands.reading import FaultyFile
from congrasp.services.assets.hands.servos import servos
from congrasp.services.assets.hands.summary import describe
from congrasp.services.assets.hands.urdf_joints import check_joints
from congrasp.services.cli import main

HANDS = pathlib.Path(__file__).parents[3] / "hands"
PINCH = HANDS.parent / "cases" / "_hand"
ENDS = {"left_root": -0.96, "left_middle": -1.28, "opposing_root": 0.96, "opposing_middle": 1.28}


@pytest.fixture(scope="module")
def claw():
    return propose(HANDS / "claw.urdf")


@pytest.fixture(autouse=True)
def _no_own_hands(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "own"))
    get_hand.cache_clear()
    yield
    get_hand.cache_clear()


def test_a_urdf_is_understood(claw):
    hand = claw.hand
    assert [link.name for link in hand.links] == [
        "palm",
        *(
            f"{finger}_{part}"
            for finger, part in itertools.product(("left", "right", "opposing"), ("lower", "upper"))
        ),
    ]
    joints = {joint.name: joint for joint in hand.joints}
    assert len(joints) == 6
    root = joints["left_root"]
    assert root.lower == (-1.2)
    assert root.upper == 0.5
    assert root.torque_limit == 1.5
    np.testing.assert_allclose(root.anchor, (0.04, 0.025, 0.04), atol=1e-9)
    np.testing.assert_allclose(root.axis, (0.0, 1.0, 0.0), atol=1e-9)
    lean = 0.06 * np.array([np.sin(0.4), 0.0, np.cos(0.4)])
    np.testing.assert_allclose(joints["left_middle"].anchor, np.add(root.anchor, lean), atol=1e-9)
    masses = {link.name: link.mass for link in hand.links}
    assert masses["left_upper"] == pytest.approx(0.035)  # with the pad, which a fixed joint holds
    assert sum(masses.values()) == pytest.approx(0.545)


def test_thumb_tips_poses_and_frame_are_proposed(claw):
    hand = claw.hand
    assert hand.thumb == "opposing_upper"
    assert len(hand.tip_links) == 3
    assert {name: hand.closed_pose[name] for name in ENDS} == pytest.approx(ENDS)
    assert all(abs(hand.open_pose[name]) < 0.5 for name in ENDS)
    frame = grasp_frame(hand)
    np.testing.assert_allclose(frame.heading, (0.0, 0.0, 1.0), atol=0.1)
    np.testing.assert_allclose(frame.cross, (1.0, 0.0, 0.0), atol=0.1)
    words = "\n".join(describe(claw))
    assert "opposing_lower - opposing_upper" in words
    assert "no torque limit" not in words
    assert "'opposing_upper' is assumed to be the thumb" in words
    assert "(--thumb)" in words


def test_the_same_hand_as_mjcf_on_an_arm_is_the_same(claw):
    other = propose(HANDS / "claw.xml", Choices(name="claw")).hand
    hand = claw.hand
    # The wrist joint is left out
    assert [link.name for link in other.links] == [link.name for link in hand.links]
    for a, b in zip(hand.joints, other.joints, strict=True):
        assert a.name == b.name
        np.testing.assert_allclose(
            [*a.anchor, *a.axis, a.lower, a.upper],
            [*b.anchor, *b.axis, b.lower, b.upper],
            atol=1e-9,
        )
        assert b.kp == 5.0
        assert b.torque_limit == 1.2  # of the file's motors
    np.testing.assert_allclose(hand.q_closed, other.q_closed)
    for a, b in zip(hand.links, other.links, strict=True):
        assert a.mass == pytest.approx(b.mass)


@pytest.mark.parametrize("name", ["allegro", "sharpa"])
def test_a_dexterous_hand_comes_back_from_mjcf(name, tmp_path):
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    add_hand(spec, get_hand(name))
    spec.compile()
    (tmp_path / "hand.xml").write_text(spec.to_xml())
    original = get_hand(name)
    hand = propose(tmp_path / "hand.xml").hand
    assert hand.thumb == original.thumb
    for a, b in zip(original.joints, hand.joints, strict=True):
        np.testing.assert_allclose(
            [*a.anchor, *a.axis, a.lower, a.upper, a.kp, a.torque_limit],
            [*b.anchor, *b.axis, b.lower, b.upper, b.kp, b.torque_limit],
            atol=1e-4,
        )
    # What is proposed is near to what was chosen by hand: the frame, and the thumb turned against
    # the fingers.
    ours = grasp_frame(original)
    theirs = grasp_frame(hand)
    assert np.degrees(np.arccos(ours.heading @ theirs.heading)) < 20
    assert np.degrees(np.arccos(ours.cross @ theirs.cross)) < 20
    assert hand.object_scale == pytest.approx(original.object_scale, abs=0.15)


def test_the_commands_import_list_and_draw(tmp_path, capsys):
    assert main.run(["hands", "import", str(HANDS / "claw.urdf"), "--name", "gripper"]) == 0
    printed = capsys.readouterr().out
    assert "6 joints, 6 motors, 7 links" in printed
    assert "congrasp train --hand gripper" in printed
    assert (tmp_path / "own" / "gripper.json").exists()
    assert (tmp_path / "own" / "gripper.png").stat().st_size > 10_000
    assert main.run(["hands", "list"]) == 0
    printed = capsys.readouterr().out
    assert all(
        name in printed for name in ("human", "allegro", "sharpa", "gripper", "CONGRASP_MANO")
    )


def test_long_numbers_are_searched_in_linear_time():
    origin = f'<origin rpy="{"1" * 1_000_000}x"/>'
    robot = ET.fromstring(f'<robot><joint type="fixed">{origin}</joint></robot>')
    with pytest.raises(FaultyFile, match="parent"):  # the frame is accepted
        check_joints(robot, [])


def test_a_zero_axis_of_inertia_gets_the_least_and_keeps_the_others(tmp_path):
    inertia = '<inertia ixx="2e-5" iyy="0" izz="3e-5"/>'
    text = re.sub("<inertia [^>]*>", inertia, (PINCH / "pinch.urdf").read_text(), count=1)
    (tmp_path / "hand.urdf").write_text(text)
    notes = []
    _, model = robot_spec(tmp_path / "hand.urdf", notes)
    np.testing.assert_allclose(model.body("palm").inertia, [3e-5, 2e-5, 1.01e-5])
    assert notes == [
        "links with inertia about two axes get the least possible about the third: palm"
    ]


def test_a_third_moment_respects_products_of_inertia(tmp_path):
    """The missing axis becomes a principal axis; the others keep their product."""
    inertia = '<inertia ixx="3e-5" iyy="3e-5" izz="0" ixy="1e-5" ixz="1e-5"/>'
    text = re.sub("<inertia [^>]*>", inertia, (PINCH / "pinch.urdf").read_text(), count=1)
    (tmp_path / "hand.urdf").write_text(text)
    _, model = robot_spec(tmp_path / "hand.urdf", [])
    np.testing.assert_allclose(model.body("palm").inertia, [4e-5, 2.01e-5, 2e-5])


def test_an_obj_of_points_is_a_hull(tmp_path):
    text = (PINCH / "pinch.urdf").read_text()
    (tmp_path / "hand.urdf").write_text(
        text.replace('<box size="0.06 0.1 0.03"/>', '<mesh filename="points.obj"/>')
    )
    corners = itertools.product((-0.03, 0.03), (-0.05, 0.05), (0.0, 0.03))
    (tmp_path / "points.obj").write_text("".join(f"v {x} {y} {z}\n" for x, y, z in corners))
    notes = []
    _, model = robot_spec(tmp_path / "hand.urdf", notes)
    assert not notes
    assert model.nmesh == 1
    assert model.nmeshvert == 8


def test_a_link_of_many_parts_is_drawn_by_a_coarse_hull(tmp_path):
    """1,000 tetrahedra around a ball, which cannot be reduced to the triangles that a link may
    have.
    """
    turn = np.arange(1000) * np.pi * (3 - np.sqrt(5))
    height = np.linspace(-1, 1, 1000)
    axes = np.sqrt(1 - height**2) * [np.cos(turn), np.sin(turn)]
    corners = (
        0.0005 * np.random.default_rng(0).normal(size=(1000, 4, 3))
        + 0.03 * np.column_stack([*axes, height])[:, None]
    )
    faces = (
        np.arange(4000)
        .reshape(-1, 1, 4)[..., [[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]]
        .reshape(-1, 3)
    )
    trimesh.Trimesh(corners.reshape(-1, 3), faces, process=False).export(tmp_path / "ball.obj")
    box = '<geom type="box" size=".03 .05 .015" pos="0 0 .015"/>'
    text = (pathlib.Path(__file__).parents[3] / "cases/_hand/pinch.xml").read_text()
    assert box in text
    assert "<asset/>" in text
    text = text.replace(
        "<asset/>", '<asset><mesh name="ball" file="ball.obj" inertia="shell"/></asset>'
    )
    (tmp_path / "hand.xml").write_text(text.replace(box, '<geom type="mesh" mesh="ball"/>'))
    vertices, drawn = propose(tmp_path / "hand.xml").meshes["palm"]
    assert 1000 < len(drawn) <= MAX_FACES
    np.testing.assert_allclose(np.abs(vertices).max(), 0.03, atol=0.003)


@pytest.mark.parametrize("names", [("th_", "index_"), ("index_", "th_")])
def test_links_named_th_are_the_thumb(names, tmp_path):
    """The two fingers are mirror images, so that only their names decide."""
    text = (pathlib.Path(__file__).parents[3] / "cases/_hand/pinch.xml").read_text()
    for word, name in zip(("thumb_", "finger_"), names, strict=True):
        text = text.replace(word, name)
    (tmp_path / "hand.xml").write_text(text)
    assert propose(tmp_path / "hand.xml").hand.thumb == "th_high"


@pytest.mark.parametrize(
    ("material", "reach"),
    [('material="rubber"', 0.06), ('material="invisible"', 0.04), ("", 0.04)],
)
def test_a_colliding_mesh_of_an_opaque_material_is_drawn(material, reach, tmp_path):
    """A fingertip of rubber, next to a visual shape that ends 2 cm before it."""
    trimesh.creation.icosphere(2, 0.01).export(tmp_path / "tip.stl")
    text = (pathlib.Path(__file__).parents[3] / "cases/_hand/pinch.xml").read_text()
    box = '<geom type="box" size=".01 .006 .02" pos="0 0 .02"/>'
    visual = '<geom type="box" size=".01 .006 .02" pos="0 0 .02" contype="0" conaffinity="0"/>'
    tip = f'<geom type="mesh" mesh="tip" pos="0 0 .05" {material}/>'
    assert text.count(box) == 2
    text = text.replace(box, visual + tip)
    materials = '<material name="rubber"/><material name="invisible" rgba="1 1 1 0"/>'
    assets = f'<asset>{materials}<mesh name="tip" file="tip.stl"/></asset>'
    (tmp_path / "hand.xml").write_text(text.replace("<asset/>", assets))
    proposal = propose(tmp_path / "hand.xml")
    vertices, _ = proposal.meshes["finger_high"]
    links = {link.name: link for link in proposal.hand.links}
    (knee,) = links["finger_high"].joints
    assert (vertices - np.array(knee.anchor))[:, 2].max() == pytest.approx(reach, abs=1e-4)


def test_any_number_of_meshes_may_be_missing(tmp_path):
    meshes = "".join(f'<mesh file="{i}.stl"/>' for i in range(301))
    text = (PINCH / "pinch.xml").read_text()
    (tmp_path / "hand.xml").write_text(text.replace("<asset/>", f"<asset>{meshes}</asset>"))
    robot_spec(tmp_path / "hand.xml", notes := [])
    assert len(notes) == 1
    assert notes[0].endswith(" and 296 more")


# --- tendons through space, whose levers are known where they run around a pulley ---


_FINGER = (pathlib.Path(__file__).parents[3] / "hands" / "tendons.xml").read_text()


def _drive(actuators: str) -> Drive:
    model = mujoco.MjModel.from_xml_string(_FINGER.format(actuators))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return Drive(model, data, {0: "root", 1: "end"}, {0: 0.1, 1: 0.04})


def test_a_motor_of_a_tendon_through_space_has_the_tendons_mean_levers():
    """The sites of the far joint are (.012, .03) and (.006 cos q + .02 sin q, .06 + .02 cos q -
    .006 sin q).
    """
    model = mujoco.MjModel.from_xml_string(_FINGER.format(""))
    (servo,) = servos(model, notes := [])
    assert set(servo.joints) == {0, 1}
    assert servo.kp == 20000
    assert servo.reach is None
    lengths = [
        np.hypot(
            0.006 * np.cos(q) + 0.02 * np.sin(q) - 0.012,
            0.03 + 0.02 * np.cos(q) - 0.006 * np.sin(q),
        )
        for q in (0.0, 0.8)
    ]
    assert servo.joints[1] == pytest.approx((lengths[1] - lengths[0]) / 0.8, rel=1e-6)
    below = np.hypot(0.012, 0.05)
    above = np.hypot(0.012, 0.03)
    radius = 0.01
    # Rad around the axis at 0, on the tendon's side
    between = np.arctan2(0.05, 0.012) + np.arctan2(0.03, 0.012)
    straight = np.sqrt(below**2 + above**2 - 2 * below * above * np.cos(between - 0.4))
    around = between + 0.4 - np.arccos(radius / below) - np.arccos(radius / above)
    wrapped = np.sqrt(below**2 - radius**2) + np.sqrt(above**2 - radius**2) + radius * around
    assert around > 0
    assert servo.joints[0] == pytest.approx((straight - wrapped) / 0.8, rel=1e-6)
    assert len(notes) == 1
    assert notes[0].startswith("1 motors pull spatial tendons")


def test_a_joint_hangs_on_the_tendon_that_pulls_it_most():
    """Of a flexor of two joints and an extensor of one, the one that pulls a joint alone keeps
    it.
    """
    drive = _drive('<position name="push" tendon="extensor" kp="10000"/>')
    assert drive.tendons() == ()
    both = _drive('<position name="again" tendon="flexor" kp="10000"/>')
    (tendon,) = both.tendons()
    assert set(tendon.joints) == {"root", "end"}
    assert any(
        "1 motors that only pull joints of others are dropped" in note for note in both.remarks()
    )
