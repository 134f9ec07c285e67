"""The typed episode, and its message."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common import mirror
from congrasp.common.episode.arm import MovedArm
from congrasp.common.episode.episode import Episode
from congrasp.common.episode.hand_arrays import hand_arrays
from congrasp.common.episode.mirrored import mirrored_episode
from congrasp.common.episode.motion_file import load_motion, save_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.objects.spec import Colours
from congrasp.common.wire.codec import Message, decode, encode
from tests.episodes import CONTROL_DT, episode, episode_message, moved_arm, older

FRAME = {"object_file_scale": 0.5, "object_file_origin": [0.1, -0.0, 0.3]}


@st.composite
def messages(draw: st.DrawFn) -> Message:
    """Messages of any length, precision and facts, with and without colours and an arm."""
    steps = draw(st.integers(1, 6))
    mask = draw(st.tuples(*[st.integers(0, 1)] * 4))
    message = episode_message(steps, mask=mask, success=draw(st.booleans()))
    arrays = dict(message.arrays)
    for name in draw(st.sets(st.sampled_from(["link_position", "q", "u", "reward/contact"]))):
        arrays[name] = arrays[name].astype(np.float64)
    if draw(st.booleans()):
        arrays["colour_points"] = np.ones((2, 3), np.float32)
        arrays["colour_values"] = np.full((2, 3), 7, np.uint8)
    numbers = st.floats(allow_nan=False, allow_infinity=False)
    meta = {
        **message.meta,
        **FRAME,
        "metrics": draw(st.dictionaries(st.text(max_size=5), numbers, max_size=3)),
        "phases": {"grasp": draw(st.floats(0, 1))},
        "command": draw(st.text(max_size=5)),
    }
    if draw(st.booleans()):
        return moved_arm(steps).add_to(Message(arrays, meta))
    return Message(arrays, meta)


def assert_equal_messages(actual: Message, expected: Message) -> None:
    assert actual.meta == expected.meta
    assert actual.arrays.keys() == expected.arrays.keys()
    for name, values in expected.arrays.items():
        assert actual.arrays[name].dtype == values.dtype, name
        np.testing.assert_array_equal(actual.arrays[name], values, err_msg=name)


@settings(deadline=None, max_examples=15)
@given(messages())
def test_message_survives_the_type(message: Message) -> None:
    recorded = decode(encode(message))
    again = Episode.from_message(recorded).to_message()
    assert_equal_messages(again, message)
    assert_equal_messages(Episode.from_message(again).to_message(), message)


def test_message_without_frame_of_the_file_gets_defaults() -> None:
    read = Episode.from_message(episode_message())
    assert read.object_file_scale == 1.0
    assert read.object_file_origin.tolist() == [0.0, 0.0, 0.0]
    meta = read.to_message().meta
    assert meta["object_file_scale"] == 1.0
    assert meta["object_file_origin"] == [0.0, 0.0, 0.0]


def test_fields_are_arrays_of_the_message() -> None:
    message = episode_message(mask=(1, 0, 0, 1))
    read = Episode.from_message(message)
    recorded = read.require_recorded()
    arrays = message.arrays
    assert read.hand == "human"
    assert read.object == "cylinder-0"
    assert read.version == 3
    assert read.about == {"version": 3, "actor": "a0"}
    assert read.constraints == ("heading", "affordance", "trajectory")
    assert read.active == {
        "affordance": True,
        "pose_finger": False,
        "pose_wrist": False,
        "trajectory": True,
    }
    np.testing.assert_allclose(read.time, CONTROL_DT * np.arange(12))
    np.testing.assert_array_equal(read.wrist_position, arrays["link_position"][:, 0])
    np.testing.assert_array_equal(read.wrist_quaternion, arrays["link_quaternion"][:, 0])
    np.testing.assert_array_equal(read.joint_target, arrays["q_target"])
    np.testing.assert_array_equal(read.link_force, arrays["contact_force"])
    np.testing.assert_array_equal(recorded.rewards["contact"], arrays["reward/contact"])
    np.testing.assert_array_equal(recorded.errors["pose_m"], arrays["error/pose_m"])
    np.testing.assert_array_equal(read.goal["pose_q"], arrays["goal/pose_q"])


def test_older_recording_is_read() -> None:
    message = episode_message(mask=(1, 0, 1, 0))
    read = Episode.from_message(older(message))
    now = Episode.from_message(message)
    assert read.active == now.active
    assert read.constraints == now.constraints
    assert "mask" not in read.goal
    assert not read.require_recorded().errors
    for name, values in now.goal.items():
        np.testing.assert_array_equal(read.goal[name], values)
    drawn = [name for name, _ in read.markers()]
    assert drawn == [name for name, _ in now.markers()]


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_damaged_message_is_a_one_line_error(data: st.DataObject) -> None:
    """An array or an entry that is absent, or has another shape, type or value."""
    message = episode_message(4)
    arrays = dict(message.arrays)
    meta = dict(message.meta)
    required = sorted(name for name in arrays if "/" not in name)
    name = data.draw(st.sampled_from(required))
    kinds = ["absent", "rank", "type", "nan", "mask", "entry", "frame"]
    change = data.draw(st.sampled_from(kinds))
    if change == "absent":
        del arrays[name]
    elif change == "rank":
        arrays[name] = arrays[name][None]
    elif change == "type":
        arrays[name] = arrays[name].astype(np.int16)
    elif change == "nan":
        name = data.draw(st.sampled_from(["q", "goal/pose_q", "visual_vertices"]))
        arrays[name] = np.full_like(arrays[name], np.nan)
    elif change == "mask":
        arrays["goal/mask"] = np.ones(data.draw(st.sampled_from([(), (3,), (4, 1)])), np.float32)
    elif change == "entry":
        entry = data.draw(st.sampled_from(["hand", "object", "control_dt", "success", "metrics"]))
        meta[entry] = data.draw(st.sampled_from([None, [], {"held": "yes"}, 1e9]))
    else:
        entry = data.draw(st.sampled_from(["object_file_scale", "object_file_origin"]))
        meta[entry] = data.draw(st.sampled_from([None, "far", [1.0], [float("nan")] * 3, {}]))
    with pytest.raises(CongraspError) as caught:
        Episode.from_message(Message(arrays, meta))
    assert "\n" not in str(caught.value)


def test_damaged_arm_is_an_error() -> None:
    arm = moved_arm(12)
    message = arm.add_to(episode_message())
    for changes in (
        {"arm/arm_joint_position": arm.joint_position[:2]},
        {"arm/arm_link_parent": np.array([0, 0], np.int32)},
        {"arm/arm_hand_link": np.array(2, np.int32)},
    ):
        with pytest.raises(CongraspError, match="The episode's arm is not valid"):
            Episode.from_message(Message({**message.arrays, **changes}, message.meta))
    without_names = {**message.meta, "arm": {"name": "two"}}
    with pytest.raises(CongraspError, match="The episode's arm is not valid"):
        Episode.from_message(Message(message.arrays, without_names))


def test_meshes_of_an_arm_have_their_own_vertices() -> None:
    first, second = moved_arm(2).meshes
    assert first.link == 0
    assert second.link == 1
    np.testing.assert_array_equal(first.vertices[first.faces[0]], np.eye(3))
    np.testing.assert_array_equal(second.vertices[second.faces[0]], 2 * np.eye(3))


def make_episode(**about: Any) -> Episode:
    """Twelve steps of 10 ms, eight of them with the table."""
    return dataclasses.replace(episode(12, removal=8), about=about)


@pytest.mark.parametrize(
    ("phases", "span"),
    [
        (None, (0, 8)),
        ({"grasp": 0.02, "hold": 0.08}, (2, 8)),
        ({"grasp": 0.02, "lift": 0.05}, (2, 5)),
        ({"grasp": 9e3, "lift": 9e3}, (12, 12)),
        ({"grasp": 9e3}, (8, 8)),
        ({"grasp": -1.0, "lift": "soon"}, (0, 8)),
        ({"grasp": float("nan"), "lift": 1e300}, (0, 8)),
        ("soon", (0, 8)),
    ],
)
def test_grasp_span_ends_with_lift_or_table(phases: Any, span: tuple[int, int]) -> None:
    assert make_episode(phases=phases).grasp_span == span


def test_other_frames_are_those_of_every_array() -> None:
    original = dataclasses.replace(episode(6), arm=moved_arm(6))
    frames = np.array([0, 0, 5])
    other = original.at_frames(frames)
    recorded = original.require_recorded()
    assert other.steps == 3
    assert other.control_dt == original.control_dt
    np.testing.assert_array_equal(other.time, original.time[frames])
    np.testing.assert_array_equal(other.link_force, original.link_force[frames])
    np.testing.assert_array_equal(other.object_vertices, original.object_vertices)
    other_recorded = other.require_recorded()
    np.testing.assert_array_equal(other_recorded.action, recorded.action[frames])
    for name, values in recorded.rewards.items():
        np.testing.assert_array_equal(other_recorded.rewards[name], values[frames])
    assert original.arm
    assert other.arm
    np.testing.assert_array_equal(other.arm.joint_position, original.arm.joint_position[frames])


@given(st.integers(1, 5))
@settings(deadline=None, max_examples=5)
def test_parts_of_an_episode_join_to_the_whole(cut: int) -> None:
    original = episode(6)
    steps = np.arange(original.steps)
    joined = original.at_frames(steps[cut:]).preceded_by(original.at_frames(steps[:cut]))
    assert_equal_messages(joined.to_message(), original.to_message())
    np.testing.assert_array_equal(joined.time, original.time)


def test_mirror_image_is_that_of_the_message() -> None:
    """By the names of the message's arrays (`common.mirror.fields`); twice is the episode again."""
    original = dataclasses.replace(
        episode(4, mask=(1, 1, 1, 1)),
        colours=Colours(np.ones((2, 3), np.float32), np.full((2, 3), 7, np.uint8)),
        object_file_origin=np.array([0.1, 0.2, 0.3]),
    )
    left = get_hand("human:left")
    image = mirrored_episode(original, left)
    message = original.to_message()
    meta = {**message.meta, "hand": left.reference, "object_file_origin": [-0.1, 0.2, 0.3]}
    assert_equal_messages(image.to_message(), Message(mirror.fields(message.arrays), meta))
    np.testing.assert_array_equal(image.joint_anchor, hand_arrays(left)["joint_anchor"])
    again = mirrored_episode(image, get_hand("human"))
    assert_equal_messages(again.to_message(), message)


def test_normalised_has_unit_quaternions() -> None:
    original = episode()
    scales = np.array([1.0, 1.009, 0.991, 1.02])[:, None]
    tilted = np.array([[0.6, 0.8, 0.0, 0.0]]) * scales
    rounded = dataclasses.replace(original.at_frames(np.arange(4)), object_quaternion=tilted)
    quaternions = rounded.normalised().object_quaternion
    np.testing.assert_allclose(quaternions[:3], np.tile([0.6, 0.8, 0.0, 0.0], (3, 1)), atol=1e-12)
    np.testing.assert_array_equal(quaternions[3], tilted[3])  # not rounded but wrong
    with pytest.raises(CongraspError, match="The motion's object_quaternion"):
        rounded.normalised().check_quaternions("The motion")


def test_motion_file_has_no_message(tmp_path) -> None:
    save_motion(tmp_path / "a.npz", episode().normalised())
    motion = load_motion(tmp_path / "a.npz")
    for use in (motion.to_message, motion.known_hand):
        with pytest.raises(CongraspError, match="Pass a recording"):
            use()


@pytest.mark.parametrize("name", ["human", "allegro", "sharpa"])
def test_arrays_of_a_hand_are_those_of_its_links(name: str) -> None:
    hand = get_hand(name)
    arrays = hand_arrays(hand)
    links = arrays["link_names"].tolist()
    assert links == [link.name for link in hand.links]
    count = 0
    for index, link in enumerate(hand.links):
        parent = arrays["link_parent"][index]
        assert (links[parent] if parent >= 0 else None) == (link.parent or None)
        for capsule in link.capsules:
            assert arrays["capsule_link"][count] == index
            assert arrays["capsule_radius"][count] == capsule.radius
            count += 1
    assert count == len(arrays["capsule_ends"])
    assert (arrays["joint_limits"][:, 0] <= arrays["joint_limits"][:, 1]).all()


def test_arm_moves_with_the_frames() -> None:
    arm = moved_arm(3)
    assert isinstance(arm, MovedArm)
    last = arm.at_frames(np.array([2]))
    np.testing.assert_array_equal(last.link_position, arm.link_position[2:])
    np.testing.assert_array_equal(last.mesh_vertices, arm.mesh_vertices)
