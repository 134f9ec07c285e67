"""Grasp motions as NPZ files."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.wire.codec import Message
from congrasp.services.export.episode_motion import motion_of_episode
from congrasp.services.export.motion_file import load_motion, save_motion
from tests.episodes import CONTROL_DT, episode


def test_a_motion_survives_its_file_and_the_file_says_what_every_array_means(tmp_path):
    motion = motion_of_episode(episode(mask=(1, 0, 0, 1)))
    assert motion.constraints == ("heading", "affordance", "trajectory") and motion.about == {
        "version": 3,
        "actor": "a0",
    }
    path = tmp_path / "deep" / "grasp.npz"
    save_motion(path, motion)
    again = load_motion(path)
    for name, value in vars(motion).items():
        np.testing.assert_equal(getattr(again, name), value, err_msg=name)
    assert again.time[3] == pytest.approx(3 * CONTROL_DT)
    with np.load(path) as file:  # which refuses pickles by default
        meta = json.loads(str(file["meta"]))
        assert set(meta["arrays"]) == set(file.files) - {"meta"}
        sizes = {"T": 12, "F": 20, "L": 16, "K": 5}
        for name, meaning in meta["arrays"].items():
            axes = [
                axis.strip() for axis in meaning[1 : meaning.index(")")].split(",") if axis.strip()
            ]
            assert file[name].ndim == len(axes), name
            wanted = [int(axis) if axis.isdigit() else sizes.get(axis) for axis in axes]
            assert all(
                n in (None, size) for n, size in zip(wanted, file[name].shape, strict=True)
            ), name


def test_rounded_quaternions_of_an_episode_are_normalised(tmp_path):
    whole = episode()
    rounded = {
        name: 1.002 * np.asarray(whole.arrays[name])
        for name in ("link_quaternion", "object_quaternion")
    }
    save_motion(
        tmp_path / "a.npz", motion_of_episode(Message({**whole.arrays, **rounded}, whole.meta))
    )
    again, motion = load_motion(tmp_path / "a.npz"), motion_of_episode(whole)
    for name in ("wrist_quaternion", "link_quaternion", "object_quaternion"):
        np.testing.assert_allclose(getattr(again, name), getattr(motion, name), atol=1e-6)


def test_a_file_of_the_first_format_is_read(tmp_path):
    motion = motion_of_episode(episode(mask=(0, 1, 1, 1)))
    arrays = {name: value for name, value in vars(motion).items() if isinstance(value, np.ndarray)}
    for name in ("heading_position", "heading_direction", "pose_position", "pose_quaternion"):
        arrays[name] = motion.goal[name]
    arrays["pose_joints"] = motion.goal["pose_q"]
    arrays["trajectory_position"] = motion.goal["trajectory_position"]
    arrays["trajectory_quaternion"] = motion.goal["trajectory_quaternion"]
    meta = {"format": 1, "hand": "human", "object": "mug", "success": True, "control_dt": 0.01}
    meta |= {
        "constraints": ["heading", "pose", "trajectory"],
        "metrics": {"held": 1.0},
        "about": {"version": 3},
    }
    np.savez_compressed(path := tmp_path / "older.npz", **arrays, meta=np.array(json.dumps(meta)))
    read = load_motion(path)
    assert (read.hand, read.object, read.success, read.metrics) == (
        "human",
        "mug",
        True,
        {"held": 1.0},
    )
    assert read.constraints == ("heading", "pose", "trajectory") and "pose_joints" not in read.goal
    wanted = {name: value for name, value in motion.goal.items() if name != "heading_cross"}
    np.testing.assert_equal(read.goal, wanted)
    np.testing.assert_array_equal(read.link_position, motion.link_position)
    save_motion(again := tmp_path / "again.npz", read)
    np.testing.assert_equal(load_motion(again).goal, wanted)
    arrays["pose_joints"] = arrays["pose_joints"][:3]
    np.savez_compressed(path, **arrays, meta=np.array(json.dumps(meta)))
    with pytest.raises(
        CongraspError, match=r"pose_q has shape \(3,\), but \(F,\) requires \(20,\)"
    ):
        load_motion(path)


def test_arrays_that_are_not_known_are_left_alone(tmp_path):
    save_motion(path := tmp_path / "a.npz", motion := motion_of_episode(episode()))
    with np.load(path) as file:
        np.savez_compressed(path, **file, flight_height=np.zeros(3))
    assert load_motion(path).goal.keys() == motion.goal.keys()


def test_the_file_alone_suffices_for_the_kinematics():
    motion = motion_of_episode(episode())
    q = motion.joint_position[-1]
    # Of every link: x = turn x0 + place, for x0 of the wrist frame with all joints at zero
    turns, places = (
        [],
        [],
    )
    for link, parent in enumerate(motion.link_parent):
        turn, place = (
            (Rotation.identity(), np.zeros(3)) if parent < 0 else (turns[parent], places[parent])
        )
        for j in np.flatnonzero(motion.joint_link == link):
            own = Rotation.from_rotvec(q[j] * motion.joint_axis[j])
            place = place + turn.apply(motion.joint_anchor[j] - own.apply(motion.joint_anchor[j]))
            turn = turn * own
        turns.append(turn)
        places.append(place)
    position, quaternion = mujoco_link_poses(get_hand("human"), q)
    for link in range(len(motion.link_names)):
        joints = np.flatnonzero(motion.joint_link == link)
        origin = motion.joint_anchor[joints[0]] if len(joints) else np.zeros(3)
        np.testing.assert_allclose(
            turns[link].apply(origin) + places[link], position[link], atol=1e-6
        )
        expected = Rotation.from_quat(quaternion[link], scalar_first=True)
        assert (turns[link] * expected.inv()).magnitude() < 1e-5
