"""An episode is drawn where the simulation had it."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.common.episode.motion_file import load_motion, save_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.skin import skin_of
from congrasp.common.hands.spec import link_origin
from congrasp.common.objects.spec import Colours
from congrasp.common.wire.codec import Message, decode
from congrasp.services.export.formats import default_name
from congrasp.services.record.converter import Converter
from congrasp.services.record.hand_parts import surface_parts
from congrasp.services.record.scene import SPACING_M
from congrasp.services.record.writer import Entry, LogWriter
from tests.episodes import CONTROL_DT, FORCE, episode_message, older

HAND = get_hand("human")
START = 1_000_000_000_000
KEY = "congrasp/run/log/episode/actor/a0"


@pytest.fixture(scope="module")
def entries() -> list[Entry]:
    return Converter()(KEY, episode_message(), START)


def of(entries: list[Entry], name: str) -> list[Entry]:
    return [entry for entry in entries if entry.channel.topic == f"/episode/a0/{name}"]


def vector(v: object) -> np.ndarray:
    return np.array([v.x, v.y, v.z])  # type: ignore[attr-defined]


def quaternion(q: object) -> np.ndarray:
    return np.array([q.w, q.x, q.y, q.z])  # type: ignore[attr-defined]


def test_every_link_and_the_object_has_its_frame_at_every_step(entries: list[Entry]) -> None:
    arrays = episode_message().arrays
    messages = of(entries, "tf")
    assert [e.time for e in messages] == [START + round(1e9 * CONTROL_DT) * i for i in range(12)]
    for i, entry in enumerate(messages):
        frames = {t.child_frame_id: t for t in FrameTransforms.FromString(entry.data).transforms}
        assert set(frames) == {"a0", "a0/object", *(f"a0/{link.name}" for link in HAND.links)}
        assert frames["a0"].parent_frame_id == "world"
        for k, link in enumerate(HAND.links):
            frame = frames[f"a0/{link.name}"]
            assert frame.parent_frame_id == "a0"
            np.testing.assert_allclose(
                vector(frame.translation), arrays["link_position"][i, k], atol=1e-7
            )
            np.testing.assert_allclose(
                quaternion(frame.rotation), arrays["link_quaternion"][i, k], atol=1e-7
            )


def test_capsules_lie_in_their_links_frames(entries: list[Entry]) -> None:
    (entry,) = of(entries, "scene")
    entities = {e.id: e for e in SceneUpdate.FromString(entry.data).entities}
    for link in HAND.links:
        entity = entities[f"hand/{link.name}"]
        assert entity.frame_id == f"a0/{link.name}"
        assert entity.frame_locked
        assert len(entity.cylinders) == len(link.capsules)
        for cylinder, capsule in zip(entity.cylinders, link.capsules, strict=True):
            along = Rotation.from_quat(
                quaternion(cylinder.pose.orientation), scalar_first=True
            ).apply([0, 0, 1])
            ends = vector(cylinder.pose.position) + np.outer([-0.5, 0.5], along * cylinder.size.z)
            np.testing.assert_allclose(
                ends, np.subtract([capsule.start, capsule.end], link_origin(link)), atol=1e-7
            )
            assert cylinder.size.x == pytest.approx(2 * capsule.radius)


def test_approach_arrow_points_at_the_heading_position(entries: list[Entry]) -> None:
    (entry,) = of(entries, "scene")
    entities = {e.id: e for e in SceneUpdate.FromString(entry.data).entities}
    (arrow,) = entities["constraint/heading"].arrows
    direction = Rotation.from_quat(quaternion(arrow.pose.orientation), scalar_first=True).apply(
        [1, 0, 0]
    )
    tip = vector(arrow.pose.position) + (arrow.shaft_length + arrow.head_length) * direction
    arrays = episode_message().arrays
    np.testing.assert_allclose(tip, arrays["goal/heading_position"], atol=1e-6)
    np.testing.assert_allclose(direction, arrays["goal/heading_direction"], atol=1e-6)
    assert entities["constraint/heading"].frame_id == "a0/object"


@pytest.mark.parametrize(
    ("mask", "shown"),
    [
        ((0, 0, 0, 0), {"heading"}),
        ((1, 0, 0, 1), {"heading", "trajectory"}),
        ((0, 1, 1, 0), {"heading", "pose"}),
        ((0, 1, 0, 1), {"heading", "pose", "trajectory"}),
    ],
)
def test_only_active_constraints_are_drawn(mask: tuple[int, ...], shown: set[str]) -> None:
    (entry,) = of(Converter()(KEY, episode_message(mask=mask), START), "scene")
    ids = {e.id for e in SceneUpdate.FromString(entry.data).entities}
    assert {
        name.removeprefix("constraint/") for name in ids if name.startswith("constraint/")
    } == shown


def test_an_older_recording_is_drawn_as_it_is_now() -> None:
    made = episode_message(mask=(1, 1, 0, 1))
    (now,), (before,) = (
        of(Converter()(KEY, message, START), "scene") for message in (made, older(made))
    )
    assert before.data == now.data


def test_a_new_episode_removes_what_the_last_one_left(entries: list[Entry]) -> None:
    (entry,) = of(entries, "scene")
    assert [d.type for d in SceneUpdate.FromString(entry.data).deletions] == [
        SceneEntityDeletion.ALL
    ]
    assert entry.channel.latched


def test_surface_points_are_coloured_by_region(entries: list[Entry]) -> None:
    (entry,) = of(entries, "surface")
    cloud = PointCloud.FromString(entry.data)
    offsets = {field.name: field.offset for field in cloud.fields}
    raw = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_stride)
    arrays = episode_message().arrays
    points = np.stack(
        [raw[:, offsets[a] : offsets[a] + 4].copy().view("<f4")[:, 0] for a in "xyz"], -1
    )
    np.testing.assert_array_equal(points, arrays["surface_points"])
    red = raw[:, offsets["red"]].astype(int)
    green = raw[:, offsets["green"]].astype(int)
    np.testing.assert_array_equal(red > green, arrays["surface_avoid"])


def above(corners: np.ndarray, point: np.ndarray) -> float:
    """Least distance of a point to the planes of those triangles (F, 3, 3) over which it lies;
    trimesh's is wrong for some slivers."""
    a, b, c = corners.swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    sides = [
        np.einsum("fi,fi->f", np.cross(y - x, point - x), normal)
        for x, y in ((a, b), (b, c), (c, a))
    ]
    over = np.min(sides, 0) >= -1e-9
    return float(np.abs(np.einsum("fi,fi->f", point - a, normal))[over].min())


def test_points_of_every_link_lie_on_its_surface_in_its_frame(entries: list[Entry]) -> None:
    count = 0
    for link, parts in zip(HAND.links, surface_parts(HAND), strict=True):
        (entry,) = of(entries, f"hand/{link.name}")
        cloud = PointCloud.FromString(entry.data)
        assert cloud.frame_id == f"a0/{link.name}"
        assert entry.channel.latched
        raw = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_stride)
        points = raw[:, :12].copy().view("<f4")
        corners = np.concatenate([part.points[part.faces] for part in parts])
        assert max(above(corners, point) for point in points[::20].astype(float)) < 1e-6
        assert np.linalg.norm(np.ptp(points, axis=0)) > 0.01
        colours = {tuple(np.multiply(part.colour, 255).astype(int)) for part in parts}
        assert set(map(tuple, raw[:, 12:15])) == colours
        assert (raw[:, 15] == 255).all()
        count += len(points)
    assert 2000 < count < 2100


def test_an_independent_reader_finds_the_skin_in_place(
    tmp_path: Path,
) -> None:
    """The messages' classes come from the file, and the turn is a quaternion's by the textbook."""
    step = 9
    k = [link.name for link in HAND.links].index("thumb_distal")
    writer = LogWriter(tmp_path, "log")
    writer.write(*Converter()(KEY, episode_message(), START))
    writer.close()
    with writer.files[0].open("rb") as file:
        drawn = [
            (channel.topic, message)
            for _, channel, _, message in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages(["/episode/a0/tf", "/episode/a0/scene"])
        ]
    (scene,) = [message for topic, message in drawn if topic.endswith("scene")]
    frame = [message for topic, message in drawn if topic.endswith("tf")][step].transforms[k + 1]
    (entity,) = [e for e in scene.entities if e.id == "hand/thumb_distal"]
    assert frame.child_frame_id == entity.frame_id == "a0/thumb_distal"
    assert frame.parent_frame_id == "a0"
    mesh, nail = entity.triangles
    w = frame.rotation.w
    axis = vector(frame.rotation)
    local = np.array([vector(point) for point in [*mesh.points, *nail.points]])
    world = (
        local
        + 2 * w * np.cross(axis, local)
        + 2 * np.cross(axis, np.cross(axis, local))
        + vector(frame.translation)
    )
    arrays = episode_message().arrays
    skin = skin_of(HAND)
    turns = Rotation.from_quat(arrays["link_quaternion"][step], scalar_first=True).as_matrix()
    posed = skin.posed(arrays["link_position"][step], turns)[0]
    of_link = posed[skin.weights[:, k] > 0.999]  # what moves with this link alone
    assert len(of_link) > 3
    assert cKDTree(world).query(of_link)[0].max() < 1e-4
    corners = world[np.array(mesh.indices).reshape(-1, 3)]
    middle = world.mean(0)
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.sum(outwards * (corners.mean(1) - middle), -1) > 0).mean() > 0.9


def test_a_recording_holds_the_hand_once_and_small(entries: list[Entry]) -> None:
    (entry,) = of(entries, "scene")
    scene = SceneUpdate.FromString(entry.data)
    hand = sum(entity.ByteSize() for entity in scene.entities if entity.id.startswith("hand/"))
    one_frame = len(skin_of(HAND).points) * 3 * 9  # three doubles and their tags
    assert hand < 3 * one_frame
    for entry in of(entries, "contacts"):
        update = SceneUpdate.FromString(entry.data)
        assert not any(entity.id.startswith("hand/") for entity in update.entities)


def entities_of(update):
    """Entities of an update of the scene, by their names."""
    return {entity.id: entity for entity in update.entities}


def test_table_and_forces_are_drawn_while_they_last(entries: list[Entry]) -> None:
    updates = [SceneUpdate.FromString(entry.data) for entry in of(entries, "contacts")]
    has_table = ["table" in entities_of(update) for update in updates]
    assert has_table == [True] * 8 + [False] * 4
    arrows = [len(entities_of(update)["forces"].arrows) for update in updates]
    assert arrows == [0] * 6 + [5] * 6
    for update in updates:
        assert all(
            0 < e.lifetime.ToNanoseconds() <= 2 * round(1e9 * CONTROL_DT) for e in update.entities
        )


def test_signals_of_a_step(entries: list[Entry]) -> None:
    signals = [json.loads(entry.data) for entry in of(entries, "signals")]
    last = signals[-1]
    assert last["seconds"] == pytest.approx(11 * CONTROL_DT)
    assert last["reward"] == pytest.approx(
        {"contact": 0.5, "distance": -0.1, "total": 0.4}, abs=1e-6
    )
    assert last["force"]["thumb_distal"] == pytest.approx(FORCE)
    assert last["force"]["palm"] == 0
    assert last["links_in_contact"] == 5
    assert last["table"] is False
    assert list(last["q"]) == [joint.name for joint in HAND.joints]
    index = [joint.name for joint in HAND.joints].index("index_pip")
    assert last["q"]["index_pip"] == pytest.approx(float(episode_message().arrays["q"][-1, index]))


def test_the_raw_episode_is_kept_whole(entries: list[Entry]) -> None:
    (entry,) = of(entries, "raw")
    recorded = decode(entry.data)
    sent = episode_message()
    assert recorded.meta == sent.meta
    assert all(np.array_equal(recorded.arrays[name], sent.arrays[name]) for name in sent.arrays)


def test_episodes_of_one_actor_follow_each_other_and_actors_stand_side_by_side() -> None:
    convert = Converter()
    first = convert(KEY, episode_message(), START)
    second = convert(KEY, episode_message(), START + 1)
    assert min(e.time for e in second) > max(e.time for e in first)
    other = convert("congrasp/run/log/episode/actor/b", episode_message(), START)

    def place(entries):
        entry = next(entry for entry in entries if entry.channel.topic.endswith("/tf"))
        transforms = FrameTransforms.FromString(entry.data).transforms
        in_world = next(frame for frame in transforms if frame.parent_frame_id == "world")
        return in_world.translation.x

    places = [place(first), place(other)]
    assert places == [0.0, pytest.approx(SPACING_M)]


def test_a_clock_that_is_set_back_drops_no_episode() -> None:
    convert = Converter()
    day = 86_400_000_000_000
    first = convert(KEY, episode_message(), START)
    left = max(entry.time for entry in first) - START
    times = [entry.time for entry in convert(KEY, episode_message(), START - day)]
    assert left < min(times) - (START - day) < 2 * left


def test_invalid_colours_and_paths_as_names_are_refused(tmp_path):
    message = episode_message()
    colours = {
        "colour_points": np.zeros((2, 3), np.float32),
        "colour_values": np.zeros((2, 3), np.uint8),
    }
    Episode.from_message(Message(message.arrays | colours, message.meta))
    for name in colours:
        with pytest.raises(
            CongraspError, match="colour_points without colour_values, or the reverse"
        ):
            Episode.from_message(Message(message.arrays | {name: colours[name]}, message.meta))
    far = {**colours, "colour_points": np.full((2, 3), 1e3, np.float32)}
    with pytest.raises(CongraspError, match="colour_points are more than 10 m"):
        Episode.from_message(Message(message.arrays | far, message.meta))
    evil = Episode.from_message(Message(message.arrays, {**message.meta, "object": "../evil"}))
    with pytest.raises(CongraspError, match="object of a motion"):
        save_motion(tmp_path / "motion.npz", evil)
    with pytest.raises(CongraspError, match="object of a motion"):
        default_name(evil, "glb")
    motion = dataclasses.replace(
        Episode.from_message(message).normalised(),
        colours=Colours(np.zeros((1, 3)), np.full((1, 3), -5)),
    )
    save_motion(tmp_path / "motion.npz", motion)
    with pytest.raises(CongraspError, match="not from 0 to 255"):
        load_motion(tmp_path / "motion.npz")
