"""A motion whose hand is on an arm: every file has the arm where MuJoCo has it, with its meshes,
colours and joints.
"""

import dataclasses
import json
import pathlib

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.common.episode.hand_arrays import hand_arrays
from congrasp.common.episode.motion_file import load_motion, save_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.common.wire.codec import Message, decode, encode
from congrasp.services.arm.description import load_arm
from congrasp.services.arm.moved_arm import moved_arm
from congrasp.services.arm.robot import Pose, build_robot, default_mount
from congrasp.services.export import formats, frames, urdf
from congrasp.services.export.film import camera_for, pictures
from congrasp.services.export.joint_trajectory import robot_joints
from congrasp.services.export.motions import at_rate
from congrasp.services.record.episode_entries import scene_entries
from congrasp.services.record.writer import JsonChannels
from tests.episodes import episode, episode_message
from tests.motion_readers import FROM_Y_UP, READERS, error_mm, forward_kinematics

T = 5
ORANGE = (1.0, 0.4, 0.0)
BLUE = (0.1, 0.2, 0.8)
ARM = """<mujoco><compiler angle="radian"/><asset><material name="orange" rgba="1 .4 0 1"/></asset><worldbody>
<geom type="box" size=".1 .1 .05" rgba=".1 .2 .8 1"/>
<body name="sledge" pos="0 0 .1" quat=".9 .1 .3 .2"><joint name="rail" type="slide" axis="0 1 0" range="-.3 .3"/>
  <geom type="box" size=".05 .05 .05" material="orange" contype="0" conaffinity="0"/>
  <geom type="box" size=".02 .02 .3" rgba=".1 .2 .8 1" contype="0" conaffinity="0"/>
  <geom type="capsule" size=".04 .2"/>
  <body name="palm" pos=".1 0 .3">
    <joint name="turn" axis="0 0 1" pos=".02 .01 0"/><joint name="bend" axis="0 1 0" pos="0 0 .05" range="-1 2"/>
    <geom type="sphere" size=".05"/>
    <body pos="0 0 .2" quat=".8 0 .6 0"><joint name="JOINT" axis="1 0 0" range="-1 1"/>
      <inertial mass="1" pos="0 0 0" diaginertia=".1 .1 .1"/>
      <site name="attachment_site" pos="0 .01 .05" quat=".7 .7 .1 0"/>
</body></body></body></worldbody></mujoco>"""
"""A slide, a link of two joints off its frame's origin, a link without name or shape, and names
that the hand has.
"""


@pytest.fixture(scope="module")
def motion(tmp_path_factory: pytest.TempPathFactory) -> Episode:
    """Any joints of arm and hand, on a base that stands askew; the wrist is where the arm takes
    it.
    """
    hand = get_hand("allegro")
    rng = np.random.default_rng(0)
    file = tmp_path_factory.mktemp("arm") / "odd.xml"
    file.write_text(ARM.replace("JOINT", hand.joints[0].name))
    arm = load_arm(file)
    mount = default_mount(hand)
    robot = build_robot(arm, hand, mount, procedural.generate(3))
    q = rng.uniform([-0.3, -3, -1, -1], [0.3, 3, 2, 1], (T, 4))
    fingers = rng.uniform(hand.lower, hand.upper, (T, len(hand.joints)))
    base = Pose(np.array([0.4, -0.2, 0.1]), Rotation.from_euler("z", 0.7))
    data = mujoco.MjData(robot.model)
    position = []
    turns = []
    bodies = [robot.model.body(f"hand/{link.name}").id for link in hand.links]
    for t in range(T):
        data.qpos[robot.joints] = q[t]
        data.qpos[robot.fingers] = fingers[t]
        mujoco.mj_kinematics(robot.model, data)
        position.append(base.rotation.apply(data.xpos[bodies]) + base.position)
        turn = base.rotation * Rotation.from_quat(data.xquat[bodies], scalar_first=True)
        turns.append(turn.as_quat(scalar_first=True))
    alone = dataclasses.replace(
        episode(T).normalised(),
        hand=hand.name,
        **hand_arrays(hand),
        joint_position=fingers,
        joint_target=fingers + 0.01,
        link_force=np.zeros((T, len(hand.links), 3)),
        goal={},
        link_position=np.array(position),
        link_quaternion=np.array(turns),
    )
    taken = [*alone.link_names.tolist(), *frames.NOT_LINKS]
    return dataclasses.replace(alone, arm=moved_arm(robot, q, base, mount, taken))


def test_links_have_the_names_parents_and_colours_of_the_file(motion: Episode) -> None:
    arm = motion.arm
    assert arm is not None
    assert arm.name == "odd"
    assert arm.link_names.tolist() == ["odd_base", "sledge", "arm_palm", "body_3"]
    assert arm.link_parent.tolist() == [-1, 0, 1, 2]
    assert arm.joint_link.tolist() == [1, 2, 2, 3]
    assert arm.joint_limits[1].tolist() == [-1000, 1000]
    assert arm.joint_slides.tolist() == [
        True,
        False,
        False,
        False,
    ]
    assert [(m.link, m.colour) for m in arm.meshes] == [
        (0, pytest.approx(BLUE, abs=1e-6)),
        (1, pytest.approx(ORANGE, abs=1e-6)),
        (1, pytest.approx(BLUE, abs=1e-6)),
        (2, pytest.approx((0.5, 0.5, 0.5), abs=1e-6)),
    ]
    np.testing.assert_allclose(
        [np.ptp(m.vertices, axis=0) for m in arm.meshes][1], [0.1] * 3, atol=1e-6
    )
    first = get_hand("allegro").joints[0].name
    assert robot_joints(motion)[:5] == ["rail", "turn", "bend", first, f"hand_{first}"]


WRITTEN = ("glb", "usd", "lerobot")
"""By other tests of this module, too."""


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=[pytest.mark.slow] * (kind in WRITTEN)) for kind in formats.FORMATS],
)
def test_every_reader_finds_the_arm_where_it_was(
    motion: Episode, kind: str, tmp_path: pathlib.Path
) -> None:
    path = tmp_path / f"motion{formats.FORMATS[kind]}"
    formats.export_motions([motion], kind, path)
    (track,) = READERS[kind](path)
    assert "arm_palm" in track.poses
    assert error_mm(motion, track) < 0.01


def test_a_glb_leaves_out_flat_triangles_of_an_arm(motion: Episode, tmp_path: pathlib.Path) -> None:
    arm = motion.arm
    assert arm is not None
    faces = arm.mesh_faces.copy()
    faces[0] = faces[0, 0]
    flat = dataclasses.replace(motion, arm=dataclasses.replace(arm, mesh_faces=faces))
    path = tmp_path / "flat.glb"
    formats.export_motions([flat], "glb", path)
    base = trimesh.load_scene(path).geometry["odd_base"]
    assert len(base.faces) == len(arm.meshes[0].faces) - 1


def test_the_described_robot_is_mujocos(motion: Episode) -> None:
    """Joints alone take every link, the palm too, to where the motion has it."""
    arm = motion.arm
    assert arm is not None
    q = np.concatenate([arm.joint_position, motion.joint_position], 1)
    turn = Rotation.from_quat(arm.link_quaternion[:, 0], scalar_first=True)
    base = frames.pose_matrices(arm.link_position[:, 0], turn)
    angles = dict(zip(robot_joints(motion), q.T, strict=True))
    poses = forward_kinematics(urdf.robot_urdf(motion), angles, base, "odd_base", base)
    np.testing.assert_allclose(poses["palm"][:, :3, 3], motion.wrist_position, atol=1e-7)
    turn = Rotation.from_quat(motion.wrist_quaternion, scalar_first=True)
    np.testing.assert_allclose(poses["palm"][:, :3, :3], turn.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(poses["body_3"][:, :3, 3], arm.link_position[:, 3], atol=1e-7)


def test_a_motions_file_keeps_its_arm(motion: Episode, tmp_path: pathlib.Path) -> None:
    save_motion(tmp_path / "motion.npz", motion)
    again = load_motion(tmp_path / "motion.npz").arm
    assert again is not None
    assert motion.arm is not None
    assert again.name == "odd"
    for name, values in motion.arm.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], values)
    slower = at_rate(motion, 50.0)
    assert slower.arm is not None
    assert len(slower.arm.joint_position) == len(slower.time) == 3
    np.testing.assert_array_equal(slower.arm.joint_position, motion.arm.joint_position[::2])
    for name, values, words in (
        ("mesh_faces", motion.arm.mesh_faces + 9999, "arm_mesh_faces has indices"),
        ("link_parent", np.array([-1, 3, 1, 2]), "arm_link_parent has links before"),
        ("joint_position", motion.arm.joint_position[:3], "arm_joint_position has shape"),
    ):
        save_motion(
            tmp_path / "bad.npz",
            dataclasses.replace(motion, arm=dataclasses.replace(motion.arm, **{name: values})),
        )
        with pytest.raises(CongraspError, match=words):
            load_motion(tmp_path / "bad.npz")


def test_a_dataset_has_the_arms_joints_before_the_hands(
    motion: Episode, tmp_path: pathlib.Path
) -> None:
    arm = motion.arm
    assert arm is not None
    farther = dataclasses.replace(arm, link_position=arm.link_position + 0.1)
    other = dataclasses.replace(
        motion,
        arm=farther,
        link_position=motion.link_position + 0.1,  # the whole robot elsewhere
    )
    path = tmp_path / "data"
    formats.export_motions([motion, other], "lerobot", path)
    for one, track in zip([motion, other], READERS["lerobot"](path), strict=True):
        assert error_mm(one, track) < 0.01
    info = json.loads((path / "meta" / "info.json").read_text())
    first = get_hand("allegro").joints[0].name
    state, action = (info["features"][name]["names"] for name in ("observation.state", "action"))
    assert state[:5] == ["rail", "turn", "bend", first, f"hand_{first}"]
    assert state[-7:-4] == [
        "wrist_x",
        "wrist_y",
        "wrist_z",
    ]
    assert action[:5] == [
        "rail_next",
        "turn_next",
        "bend_next",
        f"{first}_next",
        f"hand_{first}_target",
    ]
    assert info["robot_type"] == "congrasp_odd_allegro"
    rows = pq.read_table(path / "data").slice(0, T)
    np.testing.assert_allclose(
        np.array(rows["observation.state"].to_pylist())[:, :4], arm.joint_position, atol=1e-6
    )
    following = np.concatenate([arm.joint_position[1:], arm.joint_position[-1:]])
    np.testing.assert_allclose(np.array(rows["action"].to_pylist())[:, :4], following, atol=1e-6)
    assert [file.name for file in (path / "meta").glob("*.urdf")] == ["robot.urdf"]
    with pytest.raises(CongraspError, match="one robot"):
        formats.export_motions(
            [motion, dataclasses.replace(motion, arm=None)], "lerobot", tmp_path / "mixed"
        )


def test_other_readers_find_meshes_and_colours(motion: Episode, tmp_path: pathlib.Path) -> None:
    arm = motion.arm
    assert arm is not None
    for kind in ("glb", "usd"):
        formats.export_motions([motion], kind, tmp_path / f"motion{formats.FORMATS[kind]}")
    scene = trimesh.load_scene(tmp_path / "motion.glb")
    seen = {name: scene.graph.get(name)[0] for name in ("odd_base", "sledge", "arm_palm")}
    for i, pose in enumerate(seen.values()):
        np.testing.assert_allclose((FROM_Y_UP @ pose)[:3, 3], arm.link_position[0, i], atol=1e-6)
    colours = [
        mesh.visual.material.baseColorFactor[:3]
        for name, mesh in scene.geometry.items()
        if "sledge" in name
    ]
    linear = np.array([ORANGE, BLUE]) ** 2.2
    np.testing.assert_allclose(colours, 255 * linear, atol=1)
    stage = Usd.Stage.Open(str(tmp_path / "motion.usda"))
    sledge = stage.GetPrimAtPath("/grasp/odd_base/sledge")
    pose = np.array(UsdGeom.XformCache(3.0).GetLocalToWorldTransform(sledge)).T
    np.testing.assert_allclose(pose[:3, 3], arm.link_position[3, 1], atol=1e-6)
    drawn_colours = [
        UsdGeom.Mesh(sledge.GetChild(f"mesh_{i}")).GetDisplayColorAttr().Get()[0] for i in (0, 1)
    ]
    np.testing.assert_allclose(drawn_colours, linear, atol=1e-6)


def test_the_camera_sees_the_arm(motion: Episode) -> None:
    alone = dataclasses.replace(motion, arm=None)
    camera = camera_for([alone])
    with_arm, blank = (next(pictures(one, camera)).astype(int) for one in (motion, alone))
    assert (np.abs(with_arm - blank).sum(-1) > 60).mean() > 0.02


def test_a_recording_has_the_arm_and_a_damaged_one_is_refused(motion: Episode) -> None:
    arm = motion.arm
    assert arm is not None
    message = decode(encode(arm.add_to(episode_message(T))))
    recorded = Episode.from_message(message)
    again = recorded.arm
    assert "rail" in urdf.robot_urdf(recorded)
    assert again is not None
    assert again.name == "odd"
    assert again.joint_names.tolist() == arm.joint_names.tolist()
    for name, values in arm.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], values)
    entries = [*scene_entries("a0", recorded, 0, 0, JsonChannels())]
    (scene,) = [
        SceneUpdate.FromString(entry.data)
        for entry in entries
        if entry.channel.topic == "/episode/a0/scene"
    ]
    entities = {entity.id: entity for entity in scene.entities if entity.id.startswith("arm/")}
    assert [entity.frame_id for entity in entities.values()] == [
        f"a0/arm/{name}" for name in ("odd_base", "sledge", "sledge", "arm_palm")
    ]
    assert entities["arm/1"].triangles[0].color.r == pytest.approx(1.0)
    assert len(entities["arm/1"].triangles[0].indices) == 36
    frame = next(
        FrameTransforms.FromString(e.data) for e in entries if e.channel.topic == "/episode/a0/tf"
    )
    sledge = next(t.translation for t in frame.transforms if t.child_frame_id == "a0/arm/sledge")
    np.testing.assert_allclose([sledge.x, sledge.y, sledge.z], arm.link_position[0, 1], atol=1e-6)
    short = Message(
        {**message.arrays, "arm/arm_joint_position": arm.joint_position[:2]}, message.meta
    )
    with pytest.raises(
        CongraspError, match=r"The episode's arm is not valid \(arm_joint_position has shape"
    ):
        Episode.from_message(short)
