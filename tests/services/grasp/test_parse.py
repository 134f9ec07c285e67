"""Constraints from texts and files."""

import dataclasses
import json
import os

import numpy as np
import pytest
import trimesh

from congrasp.common.episode.motion_file import save_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.objects.procedural import generate
from congrasp.services.assets.objects.named import objects_of
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.grasp.parse import read_request
from tests.episodes import HEIGHT, episode
from tests.services.conftest import quick_imports

HAND = get_hand("human")
CENTER = np.array([0.1, -0.2, 0.3])
SIDES = (0.04, 0.05, 0.12)


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mesh")
    mesh = trimesh.creation.box(SIDES)
    mesh.apply_translation(CENTER)
    mesh.apply_scale(1000)
    mesh.export(folder / "block.stl")
    with quick_imports():
        return objects_of(
            folder / "block.stl", ImportOptions(unit="mm", cache_dir=str(folder / "cache"))
        )[0]


def asked(obj, **constraints):
    return read_request(obj, HAND, 15, **constraints)


def test_an_object_has_the_origin_and_scale_of_its_file(block):
    np.testing.assert_allclose(block.origin, -CENTER, atol=1e-6)
    assert block.file_scale == 0.001


def test_headings_are_numbers_or_a_word(block):
    request = asked(block, heading="0 0 -2", at="0.1, -0.2, 0.34")
    np.testing.assert_allclose(request.given("heading", "direction"), [0, 0, -1])
    np.testing.assert_allclose(request.given("heading", "position"), [0, 0, 0.04], atol=1e-6)
    for written in ((0, 0, -2), [0.0, 0.0, -1.0], np.array([0, 0, -1], np.float32)):
        request = asked(block, heading=written, at=None, force=np.float32(2))
        np.testing.assert_allclose(request.given("heading", "direction"), [0, 0, -1])
        assert request.above is False
        assert request.given("force", "limit") == 2
    above = asked(block, heading="above")
    assert above.above
    assert above.given("heading", "direction") is None
    with pytest.raises(CongraspError, match=r"--at is 39.* m away from 'block'"):
        asked(block, at="0 0 40")
    uneven = [np.zeros((2, 3)), np.zeros((2, 2))]
    bad = (
        ("down", "'down', not 3 numbers"),
        ("1 2", "'1 2', not 3"),
        ("0 0 0", "has no direction"),
        (uneven, "not 3"),
    )
    for text, complaint in bad:
        with pytest.raises(CongraspError, match=complaint):
            asked(block, heading=text)


def test_a_part_is_a_mesh_in_the_files_coordinates_or_a_name(block, tmp_path):
    upper = trimesh.creation.box((0.04, 0.05, 0.05))
    upper.apply_translation(CENTER + np.array([0, 0, 0.035]))
    upper.apply_scale(1000)
    upper.export(tmp_path / "upper.ply")
    high = block.points[:, 2] > 0.01
    clear = np.abs(block.points[:, 2] - 0.01) > 0.005
    np.testing.assert_array_equal(
        asked(block, affordance=str(tmp_path / "upper.ply")).avoid[clear], ~high[clear]
    )
    np.testing.assert_array_equal(
        asked(block, avoid=tmp_path / "upper.ply").avoid[clear], high[clear]
    )
    trimesh.PointCloud(np.asarray(upper.sample(4000))).export(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(
        asked(block, avoid=str(tmp_path / "cloud.ply")).avoid[clear], high[clear]
    )
    np.testing.assert_array_equal(asked(block, affordance="near half").avoid, block.labels == 1)
    with pytest.raises(
        CongraspError,
        match=r"--affordance 'near half' and --avoid 'near half' contradict each other",
    ):
        asked(block, affordance="near half", avoid="near half")
    with pytest.raises(
        CongraspError,
        match=r"no constraint option 'colour'\. Choose from: heading, at, affordance, avoid",
    ):
        asked(block, colour="red")
    with pytest.raises(
        CongraspError, match=r"has no part 'handle'\. Its parts are: near half, far half"
    ):
        asked(block, affordance="handle")
    with pytest.raises(CongraspError, match=r"there is no file .*none\.ply"):
        asked(block, affordance=str(tmp_path / "none.ply"))
    trimesh.creation.box(SIDES).export(tmp_path / "metres.ply")
    with pytest.raises(CongraspError, match=r"metres\.ply' does not touch the surface of 'block'"):
        asked(block, affordance=str(tmp_path / "metres.ply"))


def test_coordinates_of_a_file_with_y_up_are_rotated(block, tmp_path):
    """The quarter turn takes (x, y, z) to (x, -z, y)."""
    turned = dataclasses.replace(block, file_up="y")
    x, y, z = CENTER
    request = asked(turned, heading="0 -2 0", at=f"{x} {z + 0.04} {-y}")
    np.testing.assert_allclose(request.given("heading", "direction"), [0, 0, -1])
    np.testing.assert_allclose(request.given("heading", "position"), [0, 0, 0.04], atol=1e-6)
    upper = (
        trimesh.creation.box((0.04, 0.05, 0.05))
        .apply_translation(np.add(CENTER, [0, 0, 0.035]))
        .apply_scale(1000)
    )
    upper.vertices = upper.vertices[:, [0, 2, 1]] * [1, 1, -1]
    high = block.points[:, 2] > 0.01
    clear = np.abs(block.points[:, 2] - 0.01) > 0.005
    for suffix in ("ply", "glb", "stl"):
        upper.export(tmp_path / f"upper.{suffix}")
        avoid = asked(turned, avoid=tmp_path / f"upper.{suffix}").avoid
        np.testing.assert_array_equal(avoid[clear], high[clear])
    wrist = {"position": [x, z + 0.2, -y], "quaternion": [1, 0, 0, 0], "joints": {}}
    (tmp_path / "pose.json").write_text(json.dumps(wrist))
    pose = asked(turned, pose=str(tmp_path / "pose.json")).constraints["pose"]
    np.testing.assert_allclose(pose["position"], [0, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(pose["quaternion"], [np.sqrt(0.5), np.sqrt(0.5), 0, 0])


def test_references_come_from_motions_json_and_csv(block, tmp_path):
    motion = episode().normalised()
    save_motion(tmp_path / "grasp.npz", motion)
    request = asked(block, pose=str(tmp_path / "grasp.npz"), trajectory=str(tmp_path / "grasp.npz"))
    pose = request.constraints["pose"]
    last = 7  # the last moment with the table
    np.testing.assert_array_equal(pose["q"], motion.joint_position[last])
    np.testing.assert_allclose(
        pose["position"], motion.wrist_position[last] - [0, 0, HEIGHT / 2], atol=1e-6
    )
    path, turns = request.constraints["trajectory"].values()
    assert path.shape == (15, 3)
    assert turns.shape == (15, 4)
    np.testing.assert_allclose(
        path[[0, -1]], motion.wrist_position[[0, last]] - [0, 0, HEIGHT / 2], atol=1e-6
    )
    steps = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-4)

    wrist = {"position": [0.1, -0.2, 0.5], "quaternion": [2, 0, 0, 0]}
    (tmp_path / "pose.json").write_text(json.dumps({**wrist, "joints": {HAND.joints[3].name: 0.3}}))
    pose = asked(block, pose=str(tmp_path / "pose.json")).constraints["pose"]
    np.testing.assert_allclose(pose["position"], [0, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(pose["quaternion"], [1, 0, 0, 0])
    assert pose["q"][3] == pytest.approx(0.3)
    assert not pose["q"][:3].any()

    (tmp_path / "path.csv").write_text(
        "x,y,z,qw,qx,qy,qz\n0.1,-0.2,0.7,1,0,0,0\n0.1,-0.2,0.5,-1,0,0,0\n"
    )
    path, turns = (
        asked(block, trajectory=str(tmp_path / "path.csv")).constraints["trajectory"].values()
    )
    np.testing.assert_allclose(path[:, 2], np.linspace(0.4, 0.2, 15), atol=1e-6)
    np.testing.assert_allclose(np.abs(turns[:, 0]), 1)
    assert (turns[:, 0] > 0).all() or (turns[:, 0] < 0).all()
    for written in (";", "\t", " ", " , "):  # as spreadsheets write it, with a byte order mark
        text = "x,y,z,qw,qx,qy,qz\r\n0.1,-0.2,0.7,1,0,0,0\r\n0.1,-0.2,0.5,-1,0,0,0\r\n".replace(
            ",", written
        )
        (tmp_path / "sheet.csv").write_text(text, "utf-8-sig")
        again = asked(block, trajectory=str(tmp_path / "sheet.csv")).constraints["trajectory"]
        np.testing.assert_array_equal(again["position"], path)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("nothing", "is not JSON"),
        ("{}", "lacks 'joints'"),
        (
            '{"joints": {"elbow": 1}, "position": [0,0,0], "quaternion": [1,0,0,0]}',
            "has no joint 'elbow'",
        ),
        (
            '{"joints": {}, "position": [0,0], "quaternion": [1,0,0,0]}',
            "'position' of .* must be 3 finite",
        ),
        (
            '{"joints": {}, "position": [0,0,500], "quaternion": [1,0,0,0]}',
            "the wrist of .* is 5.* m away from 'block'",
        ),
        (
            '{"joints": {"index_pip": 45}, "position": [0,0,0], "quaternion": [1,0,0,0]}',
            "is 45. Write joint angles in rad",
        ),
        (
            '{"joints": {}, "position": [0,0,0], "quaternion": [0,0,0,0]}',
            "quaternion has no direction",
        ),
        (
            '{"joints": {}, "position": [0,0,1e999], "quaternion": [1,0,0,0]}',
            "'position' of .* must be 3 finite",
        ),
        (
            '{"joints": {}, "position": [0,0,1' + 400 * "0" + '], "quaternion": [1,0,0,0]}',
            "'position' of .* must be 3 finite",
        ),
    ],
)
def test_errors_name_the_fault_of_a_pose(block, tmp_path, text, complaint):
    path = tmp_path / "pose.json"
    path.write_text(text)
    with pytest.raises(CongraspError, match=complaint):
        asked(block, pose=str(path))


def test_errors_name_the_fault_of_a_trajectory(block, tmp_path):
    path = tmp_path / "path.csv"
    path.write_text("0,0,0,1,0,0,0\n0,0,0,1,0,0,0\n")
    with pytest.raises(CongraspError, match="wrist does not move"):
        asked(block, trajectory=str(path))
    path.write_text("0,0,300,1,0,0,0\n0,0,200,1,0,0,0\n")
    with pytest.raises(
        CongraspError, match=r"the end of .* is 2.* m away from 'block'. Pass metres"
    ):
        asked(block, trajectory=str(path))
    for text, line, fault in (
        ("0,0,0\n0,0,1\n", 1, "has 3 cells"),
        ("x,y,z,qw,qx,qy,qz\n\n0,0,0,1,0,0,0\n0,0,nan,1,0,0,0\n", 4, "'nan'"),
        ("0,0,0,1,0,0,0  # the start\n0,0,1,1,0,0,0,9\n", 2, "has 8 cells"),
        ("0,0,0,1,0,0,0\n0,0,one,1,0,0,0\n", 2, "'one'"),
        ("1e308,0,0,1,0,0,0\n0,0,0.1,1,0,0,0\n", 1, "'1e308'"),
        ("0,1;0;0,2;1;0;0\n", 1, "has 6 cells"),
    ):
        path.write_text(text)
        with pytest.raises(CongraspError, match=rf"line {line} of .*path\.csv .*{fault}"):
            asked(block, trajectory=str(path))
    for content, complaint in (
        (b"", "path.csv has no numbers"),
        (b"x,y,z,qw,qx,qy,qz\n", "path.csv has no numbers"),
        (bytes(range(256)), "path.csv is not text"),
    ):
        path.write_bytes(content)
        with pytest.raises(CongraspError, match=complaint):
            asked(block, trajectory=str(path))
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(CongraspError, match=r"pipe\.csv is not a regular file"):
        asked(block, trajectory=str(tmp_path / "pipe.csv"))
    with pytest.raises(CongraspError, match="cannot be read"):
        asked(block, trajectory=str(tmp_path / "none.csv"))


@pytest.mark.filterwarnings("error")
def test_huge_numbers_are_valid_directions_but_not_places(block):
    direction = asked(block, heading="1e308 -1e308 0").given("heading", "direction")
    np.testing.assert_allclose(direction, np.array([1, -1, 0]) / np.sqrt(2))
    with pytest.raises(CongraspError, match="--at is inf m away from 'block'"):
        asked(block, at="1e300 0 0")


def test_a_motion_takes_no_number(block):
    for name in ("pose", "trajectory"):
        with pytest.raises(
            CongraspError,
            match=r"grasp\.npz holds a single motion, without the number 3. Remove ':3'",
        ):
            asked(block, **{name: "grasp.npz:3"})


def test_the_path_of_a_skeleton_s_joint_ends_nearest_to_the_object():
    mug = dataclasses.replace(generate(7, "mug"), origin=(0.03, 0.0, -0.05))
    path = asked(mug, trajectory="examples/reach.bvh").constraints["trajectory"]
    distance = np.linalg.norm(path["position"], axis=-1)
    assert path["position"].shape == (15, 3)
    assert distance.argmin() == 14
    assert distance[0] - distance[-1] > 0.1  # it comes from at least a decimetre farther away
    with pytest.raises(CongraspError, match="LeftHand"):
        asked(mug, trajectory="examples/reach.bvh:LeftHand")
