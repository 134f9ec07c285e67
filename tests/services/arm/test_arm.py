"""A hand on a made-up arm of seven joints: poses by forward kinematics come back, limits hold,
refusals have names.
"""

import contextlib
import csv
import dataclasses
import io
import json
import sys
import types

import imageio_ffmpeg
import mujoco
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from congrasp.common.episode.motion_file import load_motion
from congrasp.common.errors import CongraspError, MissingPackageError
from congrasp.common.hands import get_hand
from congrasp.services.arm import ArmOptions
from congrasp.services.arm.description import SPEED, arm_file, load_arm
from congrasp.services.arm.path_tracking import (
    ANGLE_TOLERANCE_RAD,
    POSITION_TOLERANCE_M,
    Path,
    follow,
)
from congrasp.services.arm.planner import ArmPlanner
from congrasp.services.arm.robot import Infeasible, build_robot, default_mount
from congrasp.services.assets.objects.named import one_object
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.cli.main import load
from congrasp.services.export.joint_trajectory import robot_joints
from congrasp.services.export.motions import pick_motion
from congrasp.services.grasp.arm_files import ARM_CSV, ARM_PICTURE, ARM_TRAJECTORY
from tests.services.conftest import quick_imports
from tests.short_grasps import short_grasps

LINKS = [
    ("0 0 1", 0.3, 170),
    ("0 1 0", 0.0, 120),
    ("0 0 1", 0.4, 170),
    (("0 1 0"), 0.0, 140),
    ("0 0 1", 0.4, 170),
    ("0 1 0", 0.0, 120),
    ("0 0 1", 0.1, 170),
]
"""Axis of each joint, length of its link (m) and range to either side (degrees)."""
GRIPPER = """<body name="gripper" pos="0 0 0.1">
  <geom type="box" size=".02 .05 .02"/>
  <body name="left" pos="0 .03 .05"><joint type="slide" axis="0 1 0" range="0 .03"/><geom size=".01"/></body>
  <body name="right" pos="0 -.03 .05"><joint type="slide" axis="0 1 0" range="0 .03"/><geom size=".01"/></body>
</body>"""


def mjcf(end: str = '<site name="attachment_site" pos="0 0 0.1"/>') -> str:
    """The arm; the compiler's angles are degrees, as MuJoCo's are by default."""
    body = end
    for i, (axis, length, degrees) in reversed([*enumerate(LINKS, 1)]):
        above = LINKS[i - 2][1] if i > 1 else 0.0
        shape = (
            f'<geom type="capsule" size=".04" fromto="0 0 0 0 0 {length}"/>'
            if length
            else '<geom size=".05"/>'
        )
        joint = f'<joint name="j{i}" axis="{axis}" range="-{degrees} {degrees}"/>'
        body = f'<body name="link{i}" pos="0 0 {above}">{joint}{shape}{body}</body>'
    motor = '<actuator><motor name="m1" joint="j1"/></actuator>'
    return f'<mujoco><compiler autolimits="true"/><worldbody>{body}</worldbody>{motor}</mujoco>'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    (folder / "seven.xml").write_text(mjcf())
    (folder / "gripping.xml").write_text(mjcf(GRIPPER))
    trimesh.creation.box((0.05, 0.06, 0.14)).export(folder / "block.stl")
    return folder


@pytest.fixture(scope="module")
def block(folder):
    with quick_imports():
        return one_object(folder / "block.stl", ImportOptions(cache_dir=str(folder / "quick")))


@pytest.fixture(scope="module")
def robot(folder, block):
    hand = get_hand("allegro")
    return build_robot(load_arm(folder / "seven.xml"), hand, default_mount(hand), block)


def path_of(robot, q: np.ndarray, at=(3.0, 0.0, 0.1), dt: float = 0.01) -> Path:
    """Where MuJoCo has the wrist at arm joints (T, 7), with an object somewhere and no table."""
    hand = get_hand("allegro")
    data = mujoco.MjData(robot.model)
    position = []
    turns = []
    for row in q:
        data.qpos[robot.joints] = row
        data.qpos[robot.fingers] = hand.q_open
        mujoco.mj_kinematics(robot.model, data)
        position.append(data.body(robot.palm).xpos.copy())
        turns.append(data.body(robot.palm).xquat.copy())
    count = len(q)
    still = np.tile([1.0, 0, 0, 0], (count, 1))
    rotation = Rotation.from_quat(turns, scalar_first=True)
    objects = np.tile(at, (count, 1))
    return Path(
        np.array(position),
        rotation,
        np.tile(hand.q_open, (count, 1)),
        objects,
        still,
        np.full(count, -9.0),
        dt,
    )


def swing(seconds: float = 1.5) -> np.ndarray:
    """(T, 7) joints of a smooth motion from rest to rest."""
    begin, end = np.radians([[0, 40, 0, 80, 0, 50, 0], [50, 55, 20, 60, -30, 60, 40]])
    x = np.linspace(0, 1, round(seconds / 0.01) + 1)[:, None]
    return begin + (10 * x**3 - 15 * x**4 + 6 * x**5) * (end - begin)


def test_poses_of_forward_kinematics_come_back_within_every_limit(robot):
    path = path_of(robot, swing())
    track = follow(robot, path, np.random.default_rng(0))
    again = path_of(robot, track.q)
    off = np.linalg.norm(again.position - path.position, axis=-1)
    turned = (again.rotation.inv() * path.rotation).magnitude()
    assert off.max() == pytest.approx(track.position_error, abs=1e-9)
    assert off.max() < 2e-3 < POSITION_TOLERANCE_M
    assert turned.max() == pytest.approx(track.rotation_error, abs=1e-6)
    assert turned.max() < np.radians(0.5) < ANGLE_TOLERANCE_RAD
    assert (track.q >= robot.arm.lower).all()
    assert (track.q <= robot.arm.upper).all()
    speed = np.abs(np.diff(track.q, axis=0)) / path.dt
    assert (speed <= SPEED * (1 + 1e-6)).all()
    np.testing.assert_allclose(track.speed, speed.max(0) / SPEED, rtol=1e-6)


def test_a_wrist_beyond_the_arm_names_the_reach(robot):
    path = path_of(robot, swing())
    path.position[:] += [0.0, 0.0, 5.0]
    with pytest.raises(Infeasible, match=r"the reach|the range of j"):
        follow(robot, path, np.random.default_rng(0))


def test_a_path_out_of_reach_is_refused_at_once(robot, monkeypatch):
    """Its first pose is within reach; no inverse kinematics is computed."""
    path = path_of(robot, swing())
    path.position[-1] *= (robot.wrist_reach + 0.01) / np.linalg.norm(path.position[-1])
    monkeypatch.setattr("mink.solve_ik", None)
    with pytest.raises(Infeasible, match=r"^the reach$"):
        follow(robot, path, np.random.default_rng(0))


def test_a_motion_that_is_too_fast_names_the_joint(robot):
    with pytest.raises(Infeasible, match=r"the (speed|acceleration) of (j\d|the wrist)"):
        follow(robot, path_of(robot, swing(0.15)), np.random.default_rng(0))


def test_a_wrist_that_turns_on_and_on_names_the_range(robot):
    """The last joint alone turns by 400 degrees: no other can do it in its place while the wrist
    stays upright.
    """
    q = np.tile(np.radians([0.0, 40, 0, 80, 0, 60, 0]), (401, 1))
    path = path_of(robot, q)
    turns = path.rotation * Rotation.from_rotvec(np.outer(np.radians(np.arange(401)), [0.0, 0, 1]))
    still = Path(
        path.position, turns, path.q, path.object_position, path.object_quaternion, path.table, 0.02
    )
    with pytest.raises(
        Infeasible, match=r"the (range|speed|acceleration) of j\d|the reach|collision"
    ):
        follow(robot, still, np.random.default_rng(0))


def test_collisions_of_the_arm_are_named(robot):
    path = path_of(robot, swing())
    data = mujoco.MjData(robot.model)
    data.qpos[robot.joints] = swing()[0]
    mujoco.mj_kinematics(robot.model, data)
    inside = path_of(
        robot, swing(), at=data.body("link3").xpos * [0.0, 0.0, 0.5] + [0.03, 0.02, 0.0]
    )
    with pytest.raises(Infeasible, match="collision of link1 with the object"):
        follow(robot, inside, np.random.default_rng(0))
    above = Path(
        *(getattr(path, name) for name in ("position", "rotation", "q", "object_position")),
        path.object_quaternion,
        np.full(len(path.q), 2.0),
        path.dt,
    )
    with pytest.raises(Infeasible, match="with the table"):
        follow(robot, above, np.random.default_rng(0))


def test_a_gripper_makes_room_for_the_hand_and_angles_keep_their_units(folder, block):
    hand = get_hand("allegro")
    plain = load_arm(folder / "seven.xml")
    gripping = load_arm(folder / "gripping.xml")
    assert gripping.joints == plain.joints == tuple(f"j{i}" for i in range(1, 8))
    assert gripping.flange == plain.flange == "link7"
    np.testing.assert_allclose(gripping.position, plain.position)
    np.testing.assert_allclose(plain.upper, np.radians([degrees for *_, degrees in LINKS]))
    model = build_robot(gripping, hand, default_mount(hand), block).model
    bodies = {model.body(i).name for i in range(model.nbody)}
    assert not {"gripper", "left", "right"} & bodies
    assert model.nq == 7 + len(hand.joints)
    fingers = [model.joint(f"hand/{joint.name}").id for joint in hand.joints]
    np.testing.assert_allclose(
        model.jnt_range[fingers], np.stack([hand.lower, hand.upper], -1), atol=1e-6
    )


def test_unnamed_sites_are_not_the_flange(tmp_path):
    tool = '<site pos="0 0 0.05"/><body name="tool" pos="0 0 0.1"><geom size=".01"/></body>'
    marked = mjcf(tool).replace("<worldbody>", '<worldbody><site pos="0 0 0.5"/>')
    (tmp_path / "marked.xml").write_text(marked)
    arm = load_arm(tmp_path / "marked.xml")
    assert arm.flange == "tool"
    assert arm.joints == tuple(f"j{i}" for i in range(1, 8))
    with pytest.raises(CongraspError, match=r"no chain of hinge and slide joints .* --flange"):
        load_arm(tmp_path / "marked.xml", flange="world")


def test_the_fingers_point_away_from_the_flange(robot):
    hand = get_hand("allegro")
    data = mujoco.MjData(robot.model)
    mujoco.mj_kinematics(robot.model, data)
    tips = [data.body(f"hand/{hand.links[i].name}").xpos[2] for i in hand.tip_links[1:]]
    flange = sum(length for _, length, _ in LINKS)
    assert min(tips) > flange
    assert data.body(robot.palm).xpos[2] > flange - 1e-6


def test_limits_of_a_urdf_and_of_the_user(folder):
    limit = '<limit lower="-1" upper="1" effort="9" velocity="1.5"/>'
    links = '<link name="a"/><link name="b"/><link name="c"/>'
    inertia = (
        '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" '
        'iyz="0"/></inertial>'
    )
    joints = "".join(
        f'<joint name="{child}j" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="0 0 1"/>{limit if child == "b" else limit.replace("1.5", "0")}</joint>'
        for parent, child in (("a", "b"), ("b", "c"))
    )
    path = folder / "two.urdf"
    path.write_text(
        f'<robot name="two">{links.replace("/>", f">{inertia}</link>")}{joints}</robot>'
    )
    arm = load_arm(path)
    assert arm.joints == ("bj", "cj")
    np.testing.assert_allclose(arm.speed, [1.5, SPEED])
    np.testing.assert_allclose(load_arm(path, speed="0.5 2").speed, [0.5, 2.0])
    with pytest.raises(CongraspError, match="one positive number, or 2"):
        load_arm(path, speed="1 2 3")
    with pytest.raises(CongraspError, match="no site or body 'wrist'"):
        load_arm(path, flange="wrist")


@pytest.mark.parametrize(
    "extension",
    [
        '<transmission name="t"><joint name="bj"/><actuator name="m"/></transmission>'
        '<ros2_control name="c" type="system"><joint name="bj"/></ros2_control>',
        '<gazebo><controller:camera name="x"/></gazebo>',
    ],
    ids=["joints of drives", "undeclared prefix"],
)
def test_speeds_of_a_urdf_with_extensions(folder, extension):
    inertia = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
    path = folder / "driven.urdf"
    path.write_text(
        f'<robot name="driven"><link name="a">{inertia}</link><link name="b">{inertia}</link>'
        '<joint name="bj" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="9" velocity="1.5"/></joint>'
        f"{extension}</robot>"
    )
    np.testing.assert_allclose(load_arm(path).speed, [1.5])


def test_a_name_needs_the_package_and_the_network(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'congrasp\[arm\]'"):
        arm_file("panda")

    class Unreachable(Exception):
        pass

    def xml(entry):
        raise Unreachable(entry)

    robot = types.SimpleNamespace(
        entry_names=("scene.xml", "panda.xml", "panda_nohand.xml"), xml=xml
    )
    descriptions = types.SimpleNamespace(
        names=lambda: ["franka_panda", "ur5e"], get=lambda name: robot, MenagerieError=Unreachable
    )
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", descriptions)
    with pytest.raises(
        CongraspError, match="'franka_panda' of MuJoCo Menagerie could not be downloaded"
    ):
        arm_file("panda")
    with pytest.raises(CongraspError, match="0 robots called 'puma'"):
        arm_file("puma")
    robot.xml = lambda entry: tmp_path / entry
    assert arm_file("ur5e") == tmp_path / "panda_nohand.xml"


@pytest.mark.parametrize("option", ["base", "mount"])
def test_numbers_that_are_none(folder, option):
    with pytest.raises(CongraspError, match=rf'--{option} is \'1 2\'. Write "X Y Z'):
        ArmPlanner(
            ArmOptions(arm=str(folder / "seven.xml"), **{option: "1 2"}), get_hand("allegro")
        )


def on_the_arm(folder, *options, attempts=8):
    """Runs `congrasp grasp` for the block on the seven-joint arm; returns its exit code."""
    common = ["--hand", "allegro", "--arm", str(folder / "seven.xml")]
    common += ["--attempts", str(attempts), "--cache-dir", str(folder)]
    return load("grasp")([str(folder / "block.stl"), *common, *options])()


@pytest.fixture(scope="module")
def arm_grasp(folder, tmp_path_factory):
    """Folder of a grasp on the arm, and what the command printed."""
    out = tmp_path_factory.mktemp("arm-grasp")
    film = ["--video", "--size", "320x240", "--fps", "2", "--approach", "0"]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = on_the_arm(folder, "--out", str(out), "--base", "-0.6 0 0 0", "--lift", "0.1", *film)
    assert code == 0
    return out / "block", printed.getvalue()


def arm_table(grasp):
    """Header and rows of the arm's CSV file of a grasp."""
    with (grasp / ARM_CSV).open() as file:
        header, *rows = csv.reader(file)
    return header, np.array(rows, float)


def arm_joint_names():
    return [f"j{i}" for i in range(1, 8)] + [joint.name for joint in get_hand("allegro").joints]


@pytest.mark.slow
def test_result_of_a_grasp_on_the_arm(arm_grasp):
    grasp, printed = arm_grasp
    facts = json.loads((grasp / "result.json").read_text())
    assert facts["arm"] == "seven"
    assert facts["arm_base"] == [-0.6, 0, 0, 0]
    assert facts["success"]
    assert "seven carries the hand within" in printed
    assert 0 < facts["arm_error_mm"] < 1e3 * POSITION_TOLERANCE_M
    assert 0 < facts["arm_speed_share"] <= 1 + 1e-6


@pytest.mark.slow
def test_motion_of_a_grasp_on_the_arm(arm_grasp):
    grasp, _ = arm_grasp
    header, table = arm_table(grasp)
    names = arm_joint_names()
    assert header == ["time", *names]
    motion = load_motion(grasp / "grasp.npz")
    assert motion.arm is not None
    assert robot_joints(motion) == names
    np.testing.assert_allclose(motion.arm.joint_position, table[:, 1:8], atol=1e-6)
    np.testing.assert_allclose(motion.time, table[:, 0], atol=1e-6)
    flange = motion.arm.link_names.tolist().index("link7")
    turn = Rotation.from_quat(motion.arm.link_quaternion[:, flange], scalar_first=True)
    carried = motion.arm.link_position[:, flange] + turn.apply(motion.arm.hand_position)
    off = 1e3 * np.linalg.norm(carried - motion.wrist_position, axis=-1)
    facts = json.loads((grasp / "result.json").read_text())
    assert off.max() == pytest.approx(facts["arm_error_mm"], rel=1e-3, abs=1e-3)
    recorded = pick_motion(grasp / "grasp.mcap").arm
    assert recorded is not None
    np.testing.assert_array_equal(recorded.link_position, motion.arm.link_position)
    assert recorded.link_names.tolist() == motion.arm.link_names.tolist()
    assert [m.colour for m in recorded.meshes] == [m.colour for m in motion.arm.meshes]


@pytest.mark.slow
def test_ros2_trajectory_of_a_grasp_on_the_arm(arm_grasp):
    grasp, _ = arm_grasp
    _, table = arm_table(grasp)
    names = arm_joint_names()
    message = json.loads((grasp / ARM_TRAJECTORY).read_text())
    assert message["joint_names"] == names
    assert len(message["points"]) == len(table)
    last = message["points"][-1]
    np.testing.assert_allclose(last["positions"], table[-1, 1:], atol=1e-6)
    since = last["time_from_start"]
    assert since["sec"] + 1e-9 * since["nanosec"] == pytest.approx(1.0 + table[-1, 0])
    speeds = np.array([point["velocities"] for point in message["points"]])
    assert speeds.shape == (len(table), len(names))
    assert np.abs(speeds).max() > 0.1
    assert not speeds[[0, -1]].any()  # controllers reject a goal that still moves


@pytest.mark.slow
def test_pictures_of_a_grasp_on_the_arm(arm_grasp):
    grasp, _ = arm_grasp
    assert np.asarray(Image.open(grasp / ARM_PICTURE)).std() > 10
    video = imageio_ffmpeg.read_frames(str(grasp / "grasp.mp4"))
    assert next(video)["size"] == (320, 240)
    frames = [np.frombuffer(frame, np.uint8).reshape(240, 320, 3).astype(int) for frame in video]
    first = frames[0]
    background = np.median(first, (0, 1))
    drawn = np.abs(first - background).sum(-1) > 60
    assert drawn[:, :160].any()  # the arm's base
    assert np.abs(first - frames[-1]).max() > 60


def test_no_point_of_arm_and_hand_is_beyond_the_reach(robot):
    model = robot.model
    data = mujoco.MjData(model)
    rng = np.random.default_rng(3)
    of_robot = [
        model.body(body).name not in ("grasp_table", "grasp_object") for body in model.geom_bodyid
    ]
    farthest = 0.0
    farthest_wrist = 0.0
    for _ in range(200):
        data.qpos[:] = rng.uniform(-np.pi, np.pi, model.nq)
        mujoco.mj_kinematics(model, data)
        distances = np.linalg.norm(data.geom_xpos, axis=1) + model.geom_rbound
        farthest = max(farthest, distances[of_robot].max())
        wrist = np.linalg.norm(data.body(robot.palm).xpos)
        farthest_wrist = max(farthest_wrist, wrist)
    assert 0.5 * robot.reach < farthest <= robot.reach
    assert 0.5 * robot.wrist_reach < farthest_wrist <= robot.wrist_reach


def test_a_base_beyond_the_reach_is_refused_before_the_simulation(block, folder):
    hand = get_hand("allegro")
    options = ArmOptions(arm=str(folder / "seven.xml"), base="3 0 0 180")
    planner = ArmPlanner(options, hand)
    with pytest.raises(CongraspError, match=r"base is 3\.00 m away from 'block'.*Set another"):
        planner.require_reach(block)
    ArmPlanner(dataclasses.replace(options, base="0.6 0 0 180"), hand).require_reach(block)


def test_a_base_that_allows_no_motion_is_refused(folder, tmp_path, capsys, quick_import):
    base = ["--base", "1.4 0 0 180", "--no-pictures", "--cache-dir", str(folder / "quick")]
    with short_grasps():
        assert on_the_arm(folder, "--out", str(tmp_path), *base, attempts=3) == 2
    message = capsys.readouterr().err
    assert "seven can execute none of the" in message
    assert "the reach" in message
    assert "Set another --base" in message
