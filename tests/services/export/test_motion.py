"""An exported motion is, for its reader, where the simulation had it."""

import dataclasses
import json
import pathlib
from collections.abc import Callable, Sequence

import imageio_ffmpeg
import numpy as np
import pyarrow.parquet as pq
import pygltflib
import pytest
import trimesh
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from pxr import Usd, UsdGeom, UsdSkel
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.common.episode.hand_arrays import hand_arrays
from congrasp.common.episode.motion_file import load_motion, save_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.hands.skin import skin_of
from congrasp.common.objects.spec import Colours
from congrasp.common.rotations import continuous
from congrasp.services.cli.main import main
from congrasp.services.export import formats, frames
from congrasp.services.export.film import camera_for, pictures
from congrasp.services.export.motions import at_rate, pick_motion
from congrasp.services.export.surfaces import COLOURS, skin_of_motion
from congrasp.services.export.texture_coordinates import unwrapped
from congrasp.services.record.converter import Converter
from congrasp.services.record.writer import Entry, LogWriter
from tests.episodes import episode, episode_message
from tests.motion_readers import FROM_Y_UP, READERS, error_mm, read_glb
from tests.printed import errors

T = 7
MESHES = ("glb", "usd", "ros2")
"""Formats with meshes."""
ANGLES = ("ros2", "lerobot")
"""Formats with joint angles."""


def posed(
    motion: Episode, link: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], seed: int
) -> Episode:
    """A wild motion of the same hand: any wrist, any fingers within their limits, any object
    pose.
    """
    rng = np.random.default_rng(seed)
    count = len(motion.time)
    q = rng.uniform(*motion.joint_limits.T, (count, len(motion.joint_names)))
    wrist = Rotation.random(count, rng=rng)
    place = rng.normal(scale=0.3, size=(count, 3))
    local = [link(angles) for angles in q]
    position = np.stack([wrist[t].apply(local[t][0]) + place[t] for t in range(count)])
    rotations = [Rotation.from_quat(quaternion, scalar_first=True) for _, quaternion in local]
    turns = [(wrist[t] * rotations[t]).as_quat(scalar_first=True) for t in range(count)]
    return dataclasses.replace(
        motion,
        time=motion.control_dt * np.arange(count),
        joint_position=q,
        joint_target=q + 0.01,
        link_position=position,
        link_quaternion=np.stack(turns),
        object_position=rng.normal(scale=0.2, size=(count, 3)),
        object_quaternion=Rotation.random(count, rng=rng).as_quat(scalar_first=True),
    )


@pytest.fixture(scope="module")
def human() -> Episode:
    hand = get_hand("human")
    return posed(episode(T).normalised(), lambda q: mujoco_link_poses(hand, q), 0)


@pytest.fixture(scope="module")
def robot(human: Episode) -> Episode:
    hand = get_hand("sharpa")
    arrays = dataclasses.replace(human, hand=hand.name, **hand_arrays(hand))
    return posed(arrays, lambda q: mujoco_link_poses(hand, q), 1)


@pytest.fixture(scope="module")
def odd_hand(human: Episode) -> Episode:
    """A hand with what URDF has no single joint for: two joints of one link at two places, a link
    without joints, and names that other formats do not take."""
    axes = Rotation.random(3, rng=np.random.default_rng(3)).as_matrix()[:, 0]
    anchors = np.array([[0.02, 0.0, 0.03], [0.03, 0.01, 0.05], [0.05, 0.0, 0.09]])
    names = ["palm", "1st phalanx", "plate", "tip/1"]
    parents = [-1, 0, 1, 1]
    joint_link = [1, 1, 3]

    def link(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        # X = turn x0 + place for points of the zero pose
        turns = [Rotation.identity()]
        places = [np.zeros(3)]
        for i in range(1, 4):
            turn = turns[parents[i]]
            place = places[parents[i]]
            for j in np.flatnonzero(np.array(joint_link) == i):
                joint_turn = Rotation.from_rotvec(q[j] * axes[j])
                place = place + turn.apply(anchors[j] - joint_turn.apply(anchors[j]))
                turn = turn * joint_turn
            turns.append(turn)
            places.append(place)
        origins = [np.zeros(3), anchors[0], np.zeros(3), anchors[2]]
        position = [
            turn.apply(o) + place for turn, o, place in zip(turns, origins, places, strict=True)
        ]
        return np.array(position), np.array([turn.as_quat(scalar_first=True) for turn in turns])

    hand = dataclasses.replace(
        human,
        joint_names=np.array(["a b", "b", "c"]),
        joint_link=np.array(joint_link),
        joint_axis=axes,
        joint_anchor=anchors,
        joint_limits=np.array([[-1.5, 1.5]] * 3),
        link_names=np.array(names),
        link_parent=np.array(parents),
        capsule_link=np.array([1, 2]),
        capsule_ends=np.array([[[0, 0, 0], [0.01, 0.0, 0.02]], [[0, 0, 0], [0, 0, 0]]]),
        capsule_radius=np.array([0.01, 0.02]),
    )
    return posed(hand, link, 5)


def export(motions: Sequence[Episode], kind: str, folder: pathlib.Path) -> pathlib.Path:
    path = folder / f"motion{formats.FORMATS[kind]}"
    formats.export_motions(motions, kind, path)
    return path


@pytest.mark.parametrize("kind", formats.FORMATS)
@pytest.mark.parametrize(
    "which",
    ["odd_hand", *(pytest.param(one, marks=pytest.mark.slow) for one in ("human", "robot"))],
)
def test_every_reader_finds_hand_and_object_where_they_were(which, kind, tmp_path, request):
    motion = request.getfixturevalue(which)
    path = export([motion], kind, tmp_path)
    (track,) = READERS[kind](path)
    assert error_mm(motion, track) < 0.01
    assert bool(track.triangles) == (kind in MESHES)
    beside = [".json"] if kind == "bvh" else []
    assert {p.name for p in path.parent.iterdir()} == {
        path.name,
        *(path.name + suffix for suffix in beside),
    }
    # The measure sees what is off: a shift, and a rotation the other way round.
    shifted = dataclasses.replace(motion, object_position=motion.object_position + 2e-4)
    inverse = motion.object_quaternion * np.array([1, -1, -1, -1])
    assert error_mm(shifted, track) == pytest.approx(0.2 * np.sqrt(3), rel=0.05)
    assert error_mm(dataclasses.replace(motion, object_quaternion=inverse), track) > 1


@pytest.mark.parametrize("kind", ANGLES)
def test_links_are_where_the_joint_angles_take_them(odd_hand, kind, tmp_path):
    """Angles in another order take them elsewhere, so that the test above compares angles, too."""
    wrong = dataclasses.replace(odd_hand, joint_position=odd_hand.joint_position[:, ::-1])
    path = export([wrong], kind, tmp_path)
    if kind == "ros2":  # whose angles are compared with TF
        with pytest.raises(AssertionError):
            READERS[kind](path)
    else:
        assert error_mm(odd_hand, READERS[kind](path)[0]) > 1


def beginning(motion: Episode, count: int) -> Episode:
    """The first frames of a motion."""
    moving = (
        "link_pos",
        "link_q",
        "wrist_",
        "object_pos",
        "object_q",
        "joint_pos",
        "joint_t",
        "time",
    )
    cut = {name: getattr(motion, name)[:count] for name in vars(motion) if name.startswith(moving)}
    return dataclasses.replace(motion, table=motion.table[:count], **cut)


@pytest.mark.parametrize("kind", formats.FORMATS)
def test_a_single_frame_is_a_motion(odd_hand: Episode, kind: str, tmp_path: pathlib.Path) -> None:
    motion = beginning(odd_hand, 1)
    (track,) = READERS[kind](export([motion], kind, tmp_path))
    assert error_mm(motion, track) < 0.01


def test_a_controller_can_take_the_trajectory_of_a_bag(
    robot: Episode, tmp_path: pathlib.Path
) -> None:
    """It begins after time zero, and is at rest at both ends."""
    path = export([robot], "ros2", tmp_path)
    (file,) = path.glob("*.mcap")
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        ((*_, message),) = reader.iter_decoded_messages(topics=["/joint_trajectory"])
    speeds = np.array([point.velocities for point in message.points])
    inside = np.gradient(robot.joint_position, robot.control_dt, axis=0)[1:-1]
    np.testing.assert_allclose(speeds, np.pad(inside, ((1, 1), (0, 0))), rtol=1e-6)
    since = [
        point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec for point in message.points
    ]
    np.testing.assert_allclose(since, 1.0 + robot.time, atol=1e-9)


def test_a_usd_has_the_requested_rate(odd_hand: Episode, tmp_path: pathlib.Path) -> None:
    slower = at_rate(odd_hand, 24.0)
    assert len(slower.time) == int((T - 1) * 24 / 100) + 1
    formats.export_motions([slower], "usd", tmp_path / "m.usda")
    stage = Usd.Stage.Open(str(tmp_path / "m.usda"))
    assert stage.GetTimeCodesPerSecond() == pytest.approx(24)
    assert stage.GetEndTimeCode() == len(slower.time) - 1
    # 1/24 s is 4.2 steps
    np.testing.assert_array_equal(slower.object_position[1], odd_hand.object_position[4])
    with pytest.raises(CongraspError, match="--fps is 200"):
        at_rate(odd_hand, 200.0)


def test_quaternions_that_are_no_rotations_are_refused(
    human: Episode, tmp_path: pathlib.Path
) -> None:
    wrong = dataclasses.replace(human, object_quaternion=np.zeros_like(human.object_quaternion))
    with pytest.raises(
        CongraspError, match="object_quaternion has quaternions that are not normalised"
    ):
        export([wrong], "glb", tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_file_that_fails_midway_leaves_nothing_behind(human, tmp_path, monkeypatch):
    def full(path, motions):
        path.write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("congrasp.services.export.bvh.write", full)
    with pytest.raises(CongraspError, match="cannot be written: No space left on device"):
        export([human], "bvh", tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_glb_is_y_up_for_others_and_names_its_units(
    human: Episode, tmp_path: pathlib.Path
) -> None:
    path = export([human], "glb", tmp_path)
    content = path.read_bytes()
    assert content[:8] == b"glTF\x02\0\0\0"
    assert int.from_bytes(content[8:12], "little") == len(content)
    file = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    root, skinned = [file["nodes"][i] for i in file["scenes"][0]["nodes"]]
    # It stands at the origin, and its joints move it
    assert set(skinned) == {
        "name",
        "mesh",
        "skin",
    }
    np.testing.assert_allclose(
        Rotation.from_quat(root["rotation"]).apply([0, 0, 1]), [0, 1, 0], atol=1e-12
    )
    assert root["extras"]["unit"] == "m"
    assert root["extras"]["quaternion"] == "x, y, z, w"
    assert root["extras"]["joints"] == human.joint_names.tolist()
    assert all("matrix" not in node for node in file["nodes"])
    assert [m["pbrMetallicRoughness"]["metallicFactor"] for m in file["materials"]] == [0.0] * 4


def test_trimesh_finds_the_first_frame_of_a_glb(human: Episode, tmp_path: pathlib.Path) -> None:
    path = export([human], "glb", tmp_path)
    scene = trimesh.load_scene(path, process=False)
    for i, name in enumerate(human.link_names):
        pose = FROM_Y_UP @ scene.graph.get(str(name))[0]
        np.testing.assert_allclose(pose[:3, 3], human.link_position[0, i], atol=1e-6)
        turn = Rotation.from_quat(human.link_quaternion[0, i], scalar_first=True)
        np.testing.assert_allclose(pose[:3, :3], turn.as_matrix(), atol=1e-6)
    skin = skin_of(get_hand("human"))
    flat = unwrapped(skin.points, skin.faces)
    np.testing.assert_allclose(
        scene.geometry[frames.SKIN].vertices, skin.points[flat.source], atol=1e-6
    )
    np.testing.assert_allclose(scene.geometry[frames.SKIN].visual.uv, flat.uv, atol=1e-6)
    flat = unwrapped(human.object_vertices, human.object_faces)
    shape = scene.geometry[frames.OBJECT]
    np.testing.assert_allclose(shape.vertices, human.object_vertices[flat.source], atol=1e-6)
    np.testing.assert_allclose(shape.visual.uv, flat.uv, atol=1e-6)


def expected_surface(motion: Episode, t: int) -> np.ndarray:
    """(V, 3) where the hand's surface is at a frame."""
    turns = Rotation.from_quat(motion.link_quaternion[t], scalar_first=True)
    return skin_of(get_hand(motion.hand)).posed(motion.link_position[t], turns.as_matrix())[0]


@pytest.mark.parametrize("which", ["human", "robot"])
def test_the_skin_of_a_glb_follows_its_joints(which, request, tmp_path):
    """By the standard's formula (glTF 2.0, 3.7.3.2), from what pygltflib reads."""
    motion = request.getfixturevalue(which)
    path = export([motion], "glb", tmp_path)
    file = pygltflib.GLTF2().load(str(path))
    blob = file.binary_blob()

    def values(index: int) -> np.ndarray:
        accessor = file.accessors[index]
        width = {"VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
        kind = {pygltflib.FLOAT: "<f4", pygltflib.UNSIGNED_SHORT: "<u2"}[accessor.componentType]
        start = file.bufferViews[accessor.bufferView].byteOffset
        return np.frombuffer(blob, kind, accessor.count * width, start).reshape(-1, width)

    (skin,) = file.skins
    mesh = file.meshes[file.nodes[-1].mesh]
    attributes = mesh.primitives[0].attributes
    joints = values(attributes.JOINTS_0)
    weights = values(attributes.WEIGHTS_0)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-5)
    inverse = values(skin.inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
    points = np.pad(values(attributes.POSITION), ((0, 0), (0, 1)), constant_values=1)
    (track,) = read_glb(path)
    source = unwrapped((surface := skin_of_motion(motion)).points, surface.faces).source
    names = [file.nodes[joint].name for joint in skin.joints]
    assert names == motion.link_names.tolist()
    for t in (0, T - 1):
        matrices = np.stack([track.poses[name][t] for name in names]) @ inverse
        mixed = np.einsum("vk,vkij->vij", weights, matrices[joints])
        skinned = np.einsum("vij,vj->vi", mixed, points)[:, :3]
        np.testing.assert_allclose(skinned, expected_surface(motion, t)[source], atol=2e-6)


@pytest.mark.parametrize("which", ["human", "robot"])
def test_pixars_library_moves_the_skin_of_a_usd(which, request, tmp_path):
    motion = request.getfixturevalue(which)
    path = export([motion], "usd", tmp_path)
    stage = Usd.Stage.Open(str(path))
    root = UsdSkel.Root(stage.GetPrimAtPath("/grasp/skin"))
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    (binding,) = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
    skeleton = cache.GetSkelQuery(binding.GetSkeleton())
    (target,) = binding.GetSkinningTargets()
    mesh = UsdGeom.Mesh(target.GetPrim())
    surface = skin_of_motion(motion)
    # One a corner, v upwards
    st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened())
    flat = unwrapped(surface.points, surface.faces)
    np.testing.assert_allclose(st, flat.uv[flat.faces.ravel()], atol=1e-6)
    for t in (0, T - 1):
        points = mesh.GetPointsAttr().Get()
        assert target.ComputeSkinnedPoints(
            skeleton.ComputeSkinningTransforms(float(t)), points, float(t)
        )
        np.testing.assert_allclose(np.array(points), expected_surface(motion, t), atol=2e-6)


def test_glb_and_usd_have_the_colours_of_the_object(
    human: Episode, odd_hand: Episode, tmp_path: pathlib.Path
) -> None:
    corners = odd_hand.object_vertices
    red = np.where(corners[:, 2:] > corners[:, 2].mean(), (255, 0, 0), (0, 0, 255)).astype(np.uint8)
    colours = Colours(corners, red)
    motion = dataclasses.replace(odd_hand, colours=colours)
    save_motion(tmp_path / "motion.npz", dataclasses.replace(human, colours=colours))
    again = load_motion(tmp_path / "motion.npz").colours
    assert again is not None
    assert (again.values == red).all()
    assert (again.points == corners).all()

    def red_above_blue(points: np.ndarray, colours: np.ndarray) -> bool:
        z = points[:, 2]
        middle = corners[:, 2].mean()
        top = colours[z > middle + 0.01]
        bottom = colours[z < middle - 0.01]
        return len(top) > 0 < len(bottom) and bool(
            (top[:, 0] > top[:, 2]).all() and (bottom[:, 2] > bottom[:, 0]).all()
        )

    path = export([motion], "glb", tmp_path)
    mesh = trimesh.load_scene(path, process=False).geometry["object"]
    assert red_above_blue(mesh.vertices, mesh.visual.vertex_attributes["color"])
    path = export([motion], "usd", tmp_path)
    stage = Usd.Stage.Open(str(path))
    (shape,) = (
        UsdGeom.Mesh(prim)
        for prim in stage.Traverse()
        if prim.GetName() == "mesh" and "skin" not in str(prim.GetPath())
    )
    primvar = shape.GetDisplayColorPrimvar()
    assert primvar.GetInterpolation() == UsdGeom.Tokens.vertex
    assert red_above_blue(np.array(shape.GetPointsAttr().Get()), np.array(primvar.Get()))


def test_colours_of_a_hand_are_linear_in_glb_and_usd(
    human: Episode, tmp_path: pathlib.Path
) -> None:
    flesh = np.array(COLOURS["flesh"]) ** 2.2
    file = pygltflib.GLTF2().load(str(export([human], "glb", tmp_path)))
    (material,) = (material for material in file.materials if material.name == "flesh")
    np.testing.assert_allclose(
        material.pbrMetallicRoughness.baseColorFactor, [*flesh, 1.0], atol=1e-6
    )
    stage = Usd.Stage.Open(str(export([human], "usd", tmp_path)))
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    colours = np.concatenate([np.array(mesh.GetDisplayColorPrimvar().Get()) for mesh in meshes])
    assert (np.abs(colours - flesh).max(1) < 1e-5).any()


def test_a_bvh_has_the_skeleton_of_the_skin(human: Episode, tmp_path: pathlib.Path) -> None:
    path = export([human], "bvh", tmp_path)
    lines = [line.split() for line in path.read_text().splitlines()]
    offsets = {
        line[1]: np.array(lines[i + 2][1:], float)
        for i, line in enumerate(lines)
        if line and line[0] == "JOINT"
    }
    assert list(offsets) == [*human.link_names, "object"]
    origins = skin_of(get_hand("human")).origins
    for i, parent in enumerate(human.link_parent[1:], 1):
        # Cm; a link's frame is turned as its parent's at zero
        expected = 100 * (origins[i] - origins[parent])
        np.testing.assert_allclose(offsets[human.link_names[i]], expected, atol=1e-4)


def test_neighbouring_quaternions_do_not_jump() -> None:
    flipped = Rotation.from_rotvec(np.outer(np.linspace(0, 12, 50), [0, 0, 1]))
    q = continuous(flipped.as_quat(scalar_first=False))
    assert (np.sum(q[1:] * q[:-1], -1) > 0).all()


def test_pixars_library_finds_the_shapes_in_a_usd(human: Episode, tmp_path: pathlib.Path) -> None:
    path = export([human], "usd", tmp_path)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetTimeCodesPerSecond() == pytest.approx(1 / human.control_dt)
    assert (
        "w, x, y, z" in json.loads(stage.GetRootLayer().customLayerData["congrasp"])["quaternion"]
    )
    prims = {prim.GetName(): prim for prim in stage.Traverse()}
    k = 9
    link = int(human.capsule_link[k])
    prim = prims[f"capsule_{k}"]
    half = UsdGeom.Capsule(prim).GetHeightAttr().Get() / 2
    matrix = np.array(UsdGeom.XformCache(3.0).GetLocalToWorldTransform(prim)).T
    ends = (matrix @ [[0, 0], [0, 0], [-half, half], [1, 1]])[:3].T
    turn = Rotation.from_quat(human.link_quaternion[3, link], scalar_first=True)
    np.testing.assert_allclose(
        ends, turn.apply(human.capsule_ends[k]) + human.link_position[3, link], atol=1e-6
    )


def test_a_dataset_of_several_motions(human: Episode, tmp_path: pathlib.Path) -> None:
    hand = get_hand("human")
    other = dataclasses.replace(
        posed(human, lambda q: mujoco_link_poses(hand, q), 9),
        object="mug",
        constraints=("heading",),
    )
    motions = [human, other, human]
    path = export(motions, "lerobot", tmp_path)
    for motion, track in zip(motions, READERS["lerobot"](path), strict=True):
        assert error_mm(motion, track) < 0.01
    info = json.loads((path / "meta" / "info.json").read_text())
    assert info["total_episodes"] == 3
    assert info["total_frames"] == 3 * T
    assert info["total_tasks"] == 2
    assert info["fps"] == 100
    table = pq.read_table(path / "data")
    assert table["index"].to_pylist() == list(range(3 * T))
    assert table["task_index"].to_pylist() == [0] * T + [1] * T + [0] * T
    action = np.array(table["action"].to_pylist())[T : 2 * T]
    np.testing.assert_allclose(action[:-1, -7:-4], other.wrist_position[1:], atol=1e-6)
    names = info["features"]["action"]["names"]
    assert names[:2] == ["thumb_cmc_abduction_target", "thumb_cmc_flexion_target"]
    assert len(names) == action.shape[1]
    pose = names.index("index_pip_target")
    joint = human.joint_names.tolist().index("index_pip")
    np.testing.assert_allclose(action[:, pose], other.joint_target[:, joint], atol=1e-6)
    stats = json.loads((path / "meta" / "stats.json").read_text())
    np.testing.assert_allclose(
        stats["action"]["mean"], np.array(table["action"].to_pylist()).mean(0), atol=1e-6
    )
    # pandas finds the tasks as its index
    schema = json.loads(pq.read_schema(path / "meta" / "tasks.parquet").metadata[b"pandas"])
    assert schema["index_columns"] == ["task"]


def test_a_dataset_with_a_camera_has_a_frame_for_every_row(
    human: Episode, tmp_path: pathlib.Path
) -> None:
    count = 2
    near = beginning(dataclasses.replace(human, object_position=human.wrist_position + 0.1), 2)
    path = tmp_path / "filmed"
    formats.export_motions([near, near], "lerobot", path, camera=True)
    info = json.loads((path / "meta" / "info.json").read_text())
    feature = info["features"]["observation.images.front"]
    assert feature["dtype"] == "video"
    assert feature["shape"] == [240, 320, 3]
    video = path / info["video_path"].format(
        video_key="observation.images.front", chunk_index=0, file_index=0
    )
    frames = list(imageio_ffmpeg.read_frames(str(video)))
    assert frames[0]["size"] == (320, 240)
    assert frames[0]["fps"] == 100
    assert len(frames[1:]) == 2 * count
    first, second = (
        np.frombuffer(frames[1 + i], np.uint8).reshape(240, 320, 3).astype(int) for i in (0, count)
    )
    assert np.abs(first - second).mean() < 2  # the same motion twice
    rows = pq.read_table(path / "meta" / "episodes").to_pylist()
    video = "videos/observation.images.front"
    spans = [[row[f"{video}/from_timestamp"], row[f"{video}/to_timestamp"]] for row in rows]
    np.testing.assert_allclose(spans, [[0, count / 100], [count / 100, 2 * count / 100]])
    stats = json.loads((path / "meta" / "stats.json").read_text())["observation.images.front"]
    np.testing.assert_allclose(
        np.ravel(stats["mean"]), np.mean([first, second], (0, 1, 2)) / 255, atol=0.03
    )
    assert np.shape(stats["mean"]) == (3, 1, 1)
    assert stats["count"] == [2 * count]
    # The object is seen where the calibration says.
    calibration = json.loads((path / "meta" / "camera.json").read_text())
    to_world = np.array(calibration["camera_to_world"])
    intrinsics = np.array(calibration["intrinsics"])
    turn = Rotation.from_quat(near.object_quaternion[0], scalar_first=True)
    corners = turn.apply(near.object_vertices) + near.object_position[0]
    seen = ((corners - to_world[:3, 3]) @ to_world[:3, :3]) @ intrinsics.T
    seen = seen[:, 1::-1] / seen[:, 2:]  # rows and columns
    alone = dataclasses.replace(
        near, link_position=near.link_position + np.array([0, 0, 50.0]), table=np.zeros(count, bool)
    )
    nothing = dataclasses.replace(alone, object_position=near.object_position + 50.0)
    drawn, blank = (
        next(pictures(motion, camera_for([near]))).astype(int) for motion in (alone, nothing)
    )
    changed = np.argwhere(np.abs(drawn - blank).sum(-1) > 20)
    np.testing.assert_allclose(
        [changed.min(0), changed.max(0)], [seen.min(0), seen.max(0)], atol=1.5
    )
    with pytest.raises(CongraspError, match="A glb file cannot contain a video"):
        formats.export_motions([near], "glb", tmp_path / "motion.glb", camera=True)


def test_lerobots_own_reader_gives_the_frame_of_each_row(
    human: Episode, tmp_path: pathlib.Path
) -> None:
    reader = pytest.importorskip(
        "lerobot.datasets.lerobot_dataset", reason="LeRobot is not installed"
    )
    formats.export_motions([human, human], "lerobot", tmp_path / "filmed", camera=True)
    data = reader.LeRobotDataset("congrasp/test", root=tmp_path / "filmed", video_backend="pyav")
    assert len(data) == 2 * T
    assert data.meta.camera_keys == ["observation.images.front"]
    first = data[1]
    second = data[T + 1]
    np.testing.assert_allclose(
        first["observation.state"][: len(human.joint_names)], human.joint_position[1], atol=1e-6
    )
    assert tuple(first["observation.images.front"].shape) == (3, 240, 320)
    assert abs(first["observation.images.front"] - second["observation.images.front"]).mean() < 0.01


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(["export", "motion", *arguments])
    return int(end.value.code or 0)


def test_recorded_episodes_and_motion_files_are_exported_by_the_command(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    entries: list[Entry] = Converter()(
        "congrasp/run/log/episode/actor/a0", episode_message(T), 10**15
    )
    with_log = LogWriter(tmp_path / "logs", "log")
    with_log.write(*entries)
    with_log.close()
    save_motion(tmp_path / "mug.npz", episode(T).normalised())
    assert run("logs", "--to", "bvh") == 0
    assert run("mug.npz") == 0
    assert "cylinder-0.glb: 7 frames" in capsys.readouterr().out
    changed = tmp_path / "cylinder-0.glb"
    changed.write_bytes(b"mine")
    assert run("mug.npz") == 2
    assert changed.read_bytes() == b"mine"
    assert "cylinder-0.glb exists already" in capsys.readouterr().err
    assert run("mug.npz", "--force") == 0
    assert changed.read_bytes().startswith(b"glTF")
    (tmp_path / "cylinder-0.bvh").rename(tmp_path / "taken.bvh")
    assert run("mug.npz", "--to", "bvh") == 2  # what goes beside the file is there already, too
    assert not (tmp_path / "cylinder-0.bvh").exists()
    (tmp_path / "taken.bvh").rename(tmp_path / "cylinder-0.bvh")
    assert run("mug.npz", "logs", "--to", "lerobot") == 0
    expected_files = {
        "cylinder-0.bvh",
        "cylinder-0.bvh.json",
        "cylinder-0-lerobot",
        "cylinder-0.glb",
    }
    assert {p.name for p in tmp_path.iterdir()} == {"logs", "mug.npz", *expected_files}
    capsys.readouterr()
    for arguments, words in (
        (["mug.npz", "logs", "--to", "glb"], "contains a single motion, but there are 2"),
        (["mug.npz", "--to", "lerobot"], "exists already"),
        (["mug.npz", "--to", "usd", "--out", "x.glb"], "ends in .usda, and x.glb does not"),
        (["mug.npz", "--to", "usd", "--out", "x.usd"], "does not. Use --out x.usda"),
        (["mug.npz", "--out", "logs"], "Use --out logs/grasp.glb"),
        (["nothing.npz"], "There is no file nothing.npz"),
        (["logs", "--index", "4"], "contains 1 episodes"),
        ([], "No motion was given"),
    ):
        assert run(*arguments) == 2
        (error,) = errors(capsys.readouterr().err)
        assert words in error


def test_a_motions_file_has_no_other_number(human: Episode, tmp_path: pathlib.Path) -> None:
    path = tmp_path / "grasp.npz"
    save_motion(path, human)
    assert pick_motion(path, 0).object == pick_motion(path).object == human.object
    with pytest.raises(
        CongraspError, match=r"grasp\.npz holds a single motion, .* 99. Remove --index"
    ):
        pick_motion(path, 99)
