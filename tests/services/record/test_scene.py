"""An episode is drawn where the simulation had it; meshes keep their surface when painted; JSON
channels keep names.
"""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from congrasp.common.episode.constraints import active_blocks, active_constraints
from congrasp.common.episode.episode import Episode
from congrasp.common.episode.motion_file import load_motion, save_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.hands.skin import MATERIALS, Skin, skin_of
from congrasp.common.hands.spec import link_origin
from congrasp.common.objects.spec import Colours
from congrasp.common.wire.codec import Message, decode
from congrasp.services.appearance import palette
from congrasp.services.appearance.palette import JOINT, SKIN
from congrasp.services.appearance.palette import MATERIALS as COLOURS
from congrasp.services.appearance.subdivision import finer
from congrasp.services.appearance.surface_colours import colours_at, painted
from congrasp.services.export.formats import default_name
from congrasp.services.record import hand_parts
from congrasp.services.record.converter import Converter
from congrasp.services.record.hand_parts import surface_parts, surface_points
from congrasp.services.record.scene import SPACING_M
from congrasp.services.record.writer import Entry, JsonChannels, LogWriter, flatten, nest
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
        assert entity.frame_id == f"a0/{link.name}" and entity.frame_locked
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
    assert active_blocks(older(made).arrays) == active_blocks(made.arrays)
    assert active_constraints(older(made).arrays) == ("heading", "affordance", "pose", "trajectory")


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
    red, green = raw[:, offsets["red"]].astype(int), raw[:, offsets["green"]].astype(int)
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
        assert cloud.frame_id == f"a0/{link.name}" and entry.channel.latched
        raw = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_stride)
        points = raw[:, :12].copy().view("<f4")
        corners = np.concatenate([part.points[part.faces] for part in parts])
        assert max(above(corners, point) for point in points[::20].astype(float)) < 1e-6
        assert np.linalg.norm(np.ptp(points, axis=0)) > 0.01
        colours = {tuple(np.multiply(part.colour, 255).astype(int)) for part in parts}
        assert set(map(tuple, raw[:, 12:15])) == colours and (raw[:, 15] == 255).all()
        count += len(points)
    assert 2000 < count < 2100


def test_a_reader_that_knows_nothing_finds_the_skin_where_the_simulation_had_it(
    tmp_path: Path,
) -> None:
    """The messages' classes come from the file, and the turn is a quaternion's by the textbook."""
    step, k = 9, [link.name for link in HAND.links].index("thumb_distal")
    writer = LogWriter(tmp_path, "log")
    writer.write(*Converter()(KEY, episode_message(), START))
    writer.close()
    with writer.files[0].open("rb") as file:
        found = [
            (channel.topic, message)
            for _, channel, _, message in make_reader(
                file, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages(["/episode/a0/tf", "/episode/a0/scene"])
        ]
    (scene,) = [message for topic, message in found if topic.endswith("scene")]
    frame = [message for topic, message in found if topic.endswith("tf")][step].transforms[k + 1]
    (entity,) = [e for e in scene.entities if e.id == "hand/thumb_distal"]
    assert (
        frame.child_frame_id == entity.frame_id == "a0/thumb_distal"
        and frame.parent_frame_id == "a0"
    )
    mesh, nail = entity.triangles
    w, axis = frame.rotation.w, vector(frame.rotation)
    local = np.array([vector(point) for point in [*mesh.points, *nail.points]])
    world = (
        local
        + 2 * w * np.cross(axis, local)
        + 2 * np.cross(axis, np.cross(axis, local))
        + vector(frame.translation)
    )
    arrays, skin = episode_message().arrays, skin_of(HAND)
    turns = Rotation.from_quat(arrays["link_quaternion"][step], scalar_first=True).as_matrix()
    posed = skin.posed(arrays["link_position"][step], turns)[0]
    own = posed[skin.weights[:, k] > 0.999]  # what moves with this link alone
    assert len(own) > 3
    assert cKDTree(world).query(own)[0].max() < 1e-4
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
    assert not any(
        e.id.startswith("hand/")
        for x in of(entries, "contacts")
        for e in SceneUpdate.FromString(x.data).entities
    )


def test_table_and_forces_are_drawn_while_they_last(entries: list[Entry]) -> None:
    updates = [SceneUpdate.FromString(entry.data) for entry in of(entries, "contacts")]
    has_table = [any(e.id == "table" for e in update.entities) for update in updates]
    assert has_table == [True] * 8 + [False] * 4
    arrows = [
        len(next(e for e in update.entities if e.id == "forces").arrows) for update in updates
    ]
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
    assert last["force"]["thumb_distal"] == pytest.approx(FORCE) and last["force"]["palm"] == 0
    assert last["links_in_contact"] == 5 and last["table"] is False
    assert list(last["q"]) == [joint.name for joint in HAND.joints]
    index = [joint.name for joint in HAND.joints].index("index_pip")
    assert last["q"]["index_pip"] == pytest.approx(float(episode_message().arrays["q"][-1, index]))


def test_the_raw_episode_is_kept_whole(entries: list[Entry]) -> None:
    (entry,) = of(entries, "raw")
    kept, sent = decode(entry.data), episode_message()
    assert kept.meta == sent.meta
    assert all(np.array_equal(kept.arrays[name], sent.arrays[name]) for name in sent.arrays)


def test_episodes_of_one_actor_follow_each_other_and_actors_stand_side_by_side() -> None:
    convert = Converter()
    first, second = (
        convert(KEY, episode_message(), START),
        convert(KEY, episode_message(), START + 1),
    )
    assert min(e.time for e in second) > max(e.time for e in first)
    other = convert("congrasp/run/log/episode/actor/b", episode_message(), START)
    transforms = [
        FrameTransforms.FromString(next(e for e in es if e.channel.topic.endswith("/tf")).data)
        for es in (first, other)
    ]
    places = [
        next(t for t in tf.transforms if t.parent_frame_id == "world").translation.x
        for tf in transforms
    ]
    assert places == [0.0, pytest.approx(SPACING_M)]


def test_a_clock_that_is_set_back_drops_no_episode() -> None:
    convert, day = Converter(), 86_400_000_000_000
    first = convert(KEY, episode_message(), START)
    left = max(entry.time for entry in first) - START
    times = [entry.time for entry in convert(KEY, episode_message(), START - day)]
    assert left < min(times) - (START - day) < 2 * left


def _posed(name: str, share: float) -> tuple[np.ndarray, np.ndarray, Skin]:
    """Corners (E, 3, 3) of all parts, and of the skin, with fingers closed by a share."""
    hand = get_hand(name)
    skin = skin_of(hand)
    position, quaternion = mujoco_link_poses(
        hand, hand.q_open + share * (hand.q_closed - hand.q_open)
    )
    turns = Rotation.from_quat(quaternion, scalar_first=True)
    corners = [
        (turns[k].apply(part.points) + position[k])[part.faces]
        for k, own in enumerate(surface_parts(hand))
        for part in own
    ]
    return np.concatenate(corners), skin.posed(position, turns.as_matrix())[0][skin.faces], skin


@pytest.mark.parametrize("name", ["allegro", "sharpa"])
def test_a_robots_parts_are_its_surface_in_every_pose(name: str) -> None:
    parts, whole, _ = _posed(name, 0.7)
    assert cKDTree(parts.mean(1)).query(whole.mean(1))[0].max() < 1e-4
    assert cKDTree(whole.mean(1)).query(parts.mean(1))[0].max() < 1e-4
    assert {part.colour for own in surface_parts(get_hand(name)) for part in own} == {SKIN, JOINT}


def test_a_human_hands_parts_are_its_skin_at_zero_and_near_it_in_a_grasp() -> None:
    hand = get_hand("human")
    skin = skin_of(hand)
    still = np.concatenate(
        [
            (p.points + o)[p.faces]
            for own, o in zip(surface_parts(hand), skin.origins, strict=True)
            for p in own
        ]
    )
    assert cKDTree(still.mean(1)).query(skin.points[skin.faces].mean(1))[0].max() < 1e-4
    parts, whole, _ = _posed("human", 0.5)
    mesh = trimesh.Trimesh(
        parts.reshape(-1, 3), np.arange(3 * len(parts)).reshape(-1, 3), process=False
    )
    points = trimesh.sample.sample_surface(mesh, 60_000, seed=0)[0]
    distance = cKDTree(points).query(whole.mean(1))[0]
    assert np.percentile(distance, 95) < 0.004
    assert {part.colour for own in surface_parts(hand) for part in own} == {
        COLOURS[name] for name in ("flesh", "nail", "sleeve")
    }


def test_detailed_meshes_are_made_lighter_and_stay_where_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    hand = get_hand("allegro")
    balls = [trimesh.creation.icosphere(5, 0.02) for _ in hand.links]  # 20,480 triangles each
    count = len(balls[0].vertices)
    own = np.repeat(np.arange(len(balls)), count)
    skin = skin_of(hand)
    fine = skin._replace(
        points=np.concatenate(
            [b.vertices + o for b, o in zip(balls, skin.origins, strict=True)]
        ).astype(np.float32),
        faces=np.concatenate([b.faces + count * k for k, b in enumerate(balls)]).astype(np.int32),
        weights=np.eye(len(balls), dtype=np.float32)[own],
        material=np.full(len(own), MATERIALS.index("link")),
    )
    monkeypatch.setattr(hand_parts, "skin_of", lambda hand: fine)
    parts = surface_parts(dataclasses.replace(hand, name="fine"))
    assert sum(len(part.faces) for links in parts for part in links) <= 12_000
    for (part,) in parts:
        np.testing.assert_allclose(np.linalg.norm(part.points, axis=-1), 0.02, atol=1e-3)


def test_meshes_that_cannot_be_read_leave_the_capsules_surface(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def damaged(hand: object) -> Skin:
        raise CongraspError("The file is damaged.")

    hand = dataclasses.replace(get_hand("allegro"), name="torn")
    monkeypatch.setattr(hand_parts, "skin_of", damaged)
    assert (
        all(surface_parts(hand)) and sum(len(points) for points, _ in surface_points(hand)) > 2000
    )


def test_an_episode_with_half_of_its_colours_or_a_name_that_is_a_path_goes_nowhere(tmp_path):
    whole = episode_message()
    colours = {
        "colour_points": np.zeros((2, 3), np.float32),
        "colour_values": np.zeros((2, 3), np.uint8),
    }
    Episode.from_message(Message(whole.arrays | colours, whole.meta))
    for name in colours:
        with pytest.raises(
            CongraspError, match="colour_points without colour_values, or the reverse"
        ):
            Episode.from_message(Message(whole.arrays | {name: colours[name]}, whole.meta))
    far = {**colours, "colour_points": np.full((2, 3), 1e3, np.float32)}
    with pytest.raises(CongraspError, match="colour_points are more than 10 m"):
        Episode.from_message(Message(whole.arrays | far, whole.meta))
    evil = Episode.from_message(Message(whole.arrays, {**whole.meta, "object": "../evil"}))
    with pytest.raises(CongraspError, match="object of a motion"):
        save_motion(tmp_path / "motion.npz", evil)
    with pytest.raises(CongraspError, match="object of a motion"):
        default_name(evil, "glb")
    motion = dataclasses.replace(
        Episode.from_message(whole).normalised(),
        colours=Colours(np.zeros((1, 3)), np.full((1, 3), -5)),
    )
    save_motion(tmp_path / "motion.npz", motion)
    with pytest.raises(CongraspError, match="not from 0 to 255"):
        load_motion(tmp_path / "motion.npz")


# --- meshes cut finer for their paint ---


@pytest.mark.parametrize("sections", [8, 512, 2048])
def test_the_surface_stays_and_faces_are_bounded(sections):
    # Slivers, where there are many sections
    mesh = trimesh.creation.cylinder(0.03, 0.15, sections=sections)
    vertices, faces = finer(mesh.vertices, mesh.faces, 0.003, 9_000)
    fine = trimesh.Trimesh(vertices, faces, process=False)
    assert len(mesh.faces) < len(faces) <= 9_000
    assert fine.area == pytest.approx(mesh.area, rel=1e-4) and fine.volume == pytest.approx(
        mesh.volume, rel=1e-4
    )
    assert vertices.dtype == np.float32 and faces.dtype == np.int32


def test_edges_become_short():
    mesh = trimesh.creation.cylinder(0.03, 0.15, sections=8)
    vertices, faces = finer(mesh.vertices, mesh.faces, 0.004, 100_000)
    corners = vertices[faces]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max() <= 0.004 + 1e-6


def test_a_mesh_of_many_faces_is_left_as_it_is():
    mesh = trimesh.creation.icosphere(3)
    vertices, faces = finer(mesh.vertices, mesh.faces, 0.001, 1_000)
    np.testing.assert_array_equal(faces, mesh.faces)
    np.testing.assert_allclose(vertices, mesh.vertices, atol=1e-6)


RED, BLUE = (255, 0, 0), (0, 0, 255)


def test_a_colour_is_a_mean_of_similar_ones():
    """At distances of 1 and 2 m, 1.5 on average, weights are exp(-(1 / 1.5)^2) = .6412 and
    exp(-(2 / 1.5)^2) = .1690; colours 10 apart are similar to exp(-10^2 / (2 x 24^2)) = .9169.
    """
    points = np.array([[0, 0, -1], [0, 0, 2]], np.float32)
    here = np.zeros((1, 3))
    similar = Colours(points, np.array([(200, 0, 0), (190, 0, 0)], np.uint8))
    # (.6412 x 200 + .1690 x .9169 x 190) / (.6412 + .1690 x .9169) = 198.05
    np.testing.assert_array_equal(colours_at(here, similar), [[198, 0, 0]])
    different = Colours(points, np.array([RED, BLUE], np.uint8))
    np.testing.assert_array_equal(colours_at(here, different), [RED])


def test_an_edge_between_two_colours_is_sharp():
    """On the edge colours are pure, and two points' spacing away they are all that of their side."""
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(0, 0.1, (8000, 2)), np.zeros(8000)].astype(np.float32)
    colours = Colours(points, np.where(points[:, :1] < 0.05, RED, BLUE).astype(np.uint8))
    along = np.linspace(0.01, 0.09, 300)

    def red_at(x):
        return colours_at(np.c_[np.full(300, x), along, np.zeros(300)], colours)[:, 0]

    assert set(red_at(0.05).tolist()) == {0, 255}
    assert (red_at(0.048) == 255).all()
    assert (red_at(0.052) == 0).all()


def test_a_painted_mesh_is_cut_once_until_it_or_its_colours_change(monkeypatch):
    cuts = []

    def counted(*mesh):
        cuts.append(mesh)
        return finer(*mesh)

    monkeypatch.setattr(palette, "finer", counted)
    ball = trimesh.creation.icosphere(2, 0.0317)
    colours = Colours(
        np.array([[0, 0, -1], [0, 0, 1]], np.float32),
        np.array([[255, 0, 0], [0, 0, 255]], np.uint8),
    )
    first = painted(ball.vertices, ball.faces, colours)
    again = painted(
        np.array(ball.vertices), np.array(ball.faces, np.int32), Colours(*map(np.array, colours))
    )
    assert len(cuts) == 1 and all(a is b for a, b in zip(first, again, strict=True))
    with pytest.raises(ValueError, match="read-only"):
        first[2][0] = 0
    other = painted(ball.vertices, ball.faces, colours._replace(values=colours.values[::-1]))
    assert len(cuts) == 2 and not np.array_equal(other[2], first[2])
    painted(1.01 * ball.vertices, ball.faces, colours)
    assert len(cuts) == 3


# --- JSON channels ---


NAMES = st.lists(st.text("abc_", min_size=1, max_size=3), min_size=1, max_size=3).map("/".join)


@given(st.dictionaries(NAMES, st.floats(allow_nan=False), max_size=8))
def test_flatten_undoes_nest(values: dict[str, float]) -> None:
    assert flatten(nest(values)) == values


def test_a_name_may_also_be_a_group() -> None:
    assert nest({"loss": 1.0, "loss/value": 2.0}) == {"loss": {"": 1.0, "value": 2.0}}


def test_numbers_that_json_lacks_are_left_out() -> None:
    entry = JsonChannels().entry(
        "/m", 5, {"a": 1.0, "b": math.nan, "c": {"d": math.inf, "e": 2}, "f": True}
    )
    assert json.loads(entry.data) == {"a": 1.0, "c": {"e": 2}, "f": True}
    assert entry.time == 5


def test_schema_grows_with_new_fields_and_keeps_the_old() -> None:
    channels = JsonChannels()
    first = channels.entry("/metrics/learner/0", 0, {"update": 0, "values": {"kl": 0.1}}).channel
    again = channels.entry("/metrics/learner/0", 1, {"update": 1, "values": {"kl": 0.2}}).channel
    grown = channels.entry(
        "/metrics/learner/0", 2, {"values": {"success": 0.5}, "name": "x"}
    ).channel
    assert first is again
    assert json.loads(grown.schema) == {
        "type": "object",
        "properties": {
            "update": {"type": "number"},
            "values": {
                "type": "object",
                "properties": {"kl": {"type": "number"}, "success": {"type": "number"}},
            },
            "name": {"type": "string"},
        },
    }
    assert grown.topic == first.topic and grown.schema_name == first.schema_name


def test_topics_have_schemas_of_their_own() -> None:
    channels = JsonChannels()
    names = {
        channels.entry(topic, 0, {"a": 1}).channel.schema_name
        for topic in ("/metrics/actor/a", "/metrics/actor/b")
    }
    assert len(names) == 2
