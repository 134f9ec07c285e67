"""Motion files: episodes as NPZ files."""

import dataclasses
import io
import json
import pathlib
import string
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from congrasp.common.episode.arm import ARM_ARRAYS, MovedArm
from congrasp.common.episode.episode import ARRAYS, Episode
from congrasp.common.episode.motion_file import MOTION_ARRAYS, load_motion, save_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.objects.spec import Colours
from congrasp.common.wire.codec import Message
from tests.episodes import CONTROL_DT, episode, episode_message, moved_arm

SIZES = {"T": 12, "F": 20, "L": 16, "K": 5}
TEXTS = st.text(string.ascii_letters, min_size=1, max_size=8)


def make_motion(**changes: Any) -> Episode:
    return dataclasses.replace(episode().normalised(), **changes)


def assert_equal_motions(actual: Episode, expected: Episode) -> None:
    """All that a file holds is equal, to the bit."""
    for name in ("hand", "object", "success", "control_dt", "constraints", "metrics", "about"):
        assert getattr(actual, name) == getattr(expected, name), name
    for name in MOTION_ARRAYS:
        values = getattr(expected, name)
        assert getattr(actual, name).dtype == values.dtype, name
        np.testing.assert_array_equal(getattr(actual, name), values, err_msg=name)
    np.testing.assert_equal(actual.goal, expected.goal)
    np.testing.assert_equal(actual.colours, expected.colours)
    assert (actual.arm is None) == (expected.arm is None)
    if actual.arm and expected.arm:
        np.testing.assert_equal(actual.arm.arrays(), expected.arm.arrays())


@st.composite
def motions(draw: st.DrawFn) -> Episode:
    """Motions of any length with any facts, with and without colours and an arm."""
    steps = draw(st.integers(1, 5))
    mask = draw(st.tuples(*[st.integers(0, 1)] * 4))
    numbers = st.floats(allow_nan=False, allow_infinity=False)
    colours = None
    if draw(st.booleans()):
        colours = Colours(np.ones((2, 3), np.float32), np.full((2, 3), 7, np.uint8))
    arm: MovedArm | None = None
    if draw(st.booleans()):
        arm = moved_arm(steps)
    return dataclasses.replace(
        episode(steps, mask=mask).normalised(),
        object=draw(TEXTS),
        success=draw(st.booleans()),
        control_dt=draw(st.floats(1e-3, 1.0)),
        metrics=draw(st.dictionaries(TEXTS, numbers, max_size=3)),
        about=draw(st.dictionaries(TEXTS, st.integers() | st.text() | st.booleans(), max_size=3)),
        colours=colours,
        arm=arm,
    )


@settings(deadline=None, max_examples=15)
@given(motions())
def test_any_motion_survives_its_file(tmp_path_factory, motion: Episode) -> None:
    path = tmp_path_factory.mktemp("motion") / "deep" / "grasp.npz"
    save_motion(path, motion)
    again = load_motion(path)
    assert_equal_motions(again, motion)
    assert again.recorded is None
    first = path.read_bytes()
    save_motion(path, again)
    assert path.read_bytes() == first


def test_file_explains_every_array(tmp_path: pathlib.Path) -> None:
    save_motion(tmp_path / "grasp.npz", make_motion(arm=moved_arm(12)))
    with np.load(tmp_path / "grasp.npz") as file:  # which refuses pickles by default
        meta = json.loads(str(file["meta"]))
        assert set(meta["arrays"]) == set(file.files) - {"meta"}
        assert {*MOTION_ARRAYS, *ARM_ARRAYS, "heading_direction"} <= set(meta["arrays"])
        for name, meaning in meta["arrays"].items():
            shape = meaning[1 : meaning.index(")")].replace(",", " ").split()
            assert file[name].ndim == len(shape), name
            for axis, size in zip(shape, file[name].shape, strict=True):
                expected = int(axis) if axis.isdigit() else SIZES.get(axis, size)
                assert size == expected or name.startswith("arm_"), name


def test_file_begins_with_the_names_of_readers(tmp_path: pathlib.Path) -> None:
    """The wrist's arrays are in the file, although they are properties of the episode."""
    save_motion(tmp_path / "grasp.npz", make_motion())
    with np.load(tmp_path / "grasp.npz") as file:
        assert file.files[:4] == ["time", "table", "wrist_position", "wrist_quaternion"]
        np.testing.assert_array_equal(file["wrist_position"], file["link_position"][:, 0])
        np.testing.assert_array_equal(file["wrist_quaternion"], file["link_quaternion"][:, 0])
        assert file["time"][3] == pytest.approx(3 * CONTROL_DT)


def test_blocks_of_a_motion_are_those_of_its_constraints(tmp_path: pathlib.Path) -> None:
    motion = episode(mask=(1, 1, 0, 0)).normalised()
    assert motion.constraints == ("heading", "affordance", "pose")
    save_motion(tmp_path / "a.npz", motion)
    active = load_motion(tmp_path / "a.npz").active
    assert active["affordance"]
    assert active["pose_finger"]
    assert active["pose_wrist"]
    assert not active["trajectory"]


def test_rounded_quaternions_need_normalising(tmp_path: pathlib.Path) -> None:
    message = episode_message()
    rounded = {
        name: 1.002 * np.asarray(message.arrays[name])
        for name in ("link_quaternion", "object_quaternion")
    }
    recorded = Episode.from_message(Message({**message.arrays, **rounded}, message.meta))
    save_motion(tmp_path / "a.npz", recorded)
    with pytest.raises(CongraspError, match=r"a\.npz's wrist_quaternion .* not normalised"):
        load_motion(tmp_path / "a.npz")
    save_motion(tmp_path / "a.npz", recorded.normalised())
    again = load_motion(tmp_path / "a.npz")
    expected = episode()
    for name in ("wrist_quaternion", "link_quaternion", "object_quaternion"):
        np.testing.assert_allclose(getattr(again, name), getattr(expected, name), atol=1e-6)


def older_file(path: pathlib.Path, motion: Episode) -> dict[str, np.ndarray]:
    """Writes a file of format 1, which had other names and no heading_cross."""
    arrays = {name: getattr(motion, name) for name in MOTION_ARRAYS}
    for name, values in motion.goal.items():
        if name != "heading_cross":
            arrays["pose_joints" if name == "pose_q" else name] = values
    meta = {
        "format": 1,
        "hand": "human",
        "object": "mug",
        "success": True,
        "control_dt": 0.01,
        "constraints": ["heading", "pose", "trajectory"],
        "metrics": {"held": 1.0},
        "about": {"version": 3},
    }
    np.savez_compressed(path, **arrays, meta=np.array(json.dumps(meta)))
    return arrays


def test_file_of_the_first_format_is_read(tmp_path: pathlib.Path) -> None:
    motion = episode(mask=(0, 1, 1, 1)).normalised()
    older_file(tmp_path / "older.npz", motion)
    read = load_motion(tmp_path / "older.npz")
    assert (read.hand, read.object, read.success) == ("human", "mug", True)
    assert read.metrics == {"held": 1.0}
    assert read.version == 3
    assert read.constraints == ("heading", "pose", "trajectory")
    expected = {name: value for name, value in motion.goal.items() if name != "heading_cross"}
    np.testing.assert_equal(read.goal, expected)
    np.testing.assert_array_equal(read.link_position, motion.link_position)
    save_motion(tmp_path / "again.npz", read)
    np.testing.assert_equal(load_motion(tmp_path / "again.npz").goal, expected)


def test_goal_of_the_first_format_is_checked(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "older.npz"
    arrays = older_file(path, episode().normalised())
    with np.load(path) as file:
        meta = file["meta"]
    arrays["pose_joints"] = arrays["pose_joints"][:3]
    np.savez_compressed(path, **arrays, meta=meta)
    with pytest.raises(CongraspError, match=r"pose_q has shape \(3,\), but \(F,\) requires"):
        load_motion(path)


def test_unknown_arrays_are_ignored(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "a.npz"
    motion = make_motion()
    save_motion(path, motion)
    with np.load(path) as file:
        np.savez_compressed(path, **file, flight_height=np.zeros(3))
    assert load_motion(path).goal.keys() == motion.goal.keys()


@settings(deadline=None, max_examples=40)
@given(st.data())
def test_damaged_file_is_a_one_line_error(tmp_path_factory, data: st.DataObject) -> None:
    """A cut file, one with a changed byte, or one without an array."""
    path = tmp_path_factory.mktemp("damaged") / "a.npz"
    save_motion(path, make_motion())
    content = bytearray(path.read_bytes())
    kind = data.draw(st.sampled_from(["cut", "changed", "lacks"]))
    if kind == "cut":
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    elif kind == "changed":
        index = data.draw(st.integers(0, len(content) - 1))
        content[index] ^= data.draw(st.integers(1, 255))
    else:
        with np.load(path) as file:
            arrays = dict(file)
        name = data.draw(st.sampled_from(sorted([*ARRAYS, "meta"])))
        del arrays[name]
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        content = bytearray(buffer.getvalue())
    path.write_bytes(content)
    try:
        load_motion(path)
    except CongraspError as error:
        assert str(path) in str(error)
        assert "\n" not in str(error)
    else:
        assert kind == "changed"  # a byte of the archive that no reader uses


def test_motion_alone_suffices_for_kinematics() -> None:
    motion = make_motion()
    q = motion.joint_position[-1]
    # Of every link: x = turn x0 + place, for x0 of the wrist frame with all joints at zero
    turns: list[Rotation] = []
    places: list[np.ndarray] = []
    for link, parent in enumerate(motion.link_parent):
        turn = Rotation.identity()
        place = np.zeros(3)
        if parent >= 0:
            turn = turns[parent]
            place = places[parent]
        for j in np.flatnonzero(motion.joint_link == link):
            joint_turn = Rotation.from_rotvec(q[j] * motion.joint_axis[j])
            anchor = motion.joint_anchor[j]
            place = place + turn.apply(anchor - joint_turn.apply(anchor))
            turn = turn * joint_turn
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
