"""Files with names, values, sizes and depths that no file of ours has: one line each, in bounded
memory and time.
"""

import dataclasses
import itertools
import json
import os
import pathlib
import tempfile

import numpy as np
import pytest

from congrasp.common.episode.motion_file import load_motion, save_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands.files import hand_from_text, read_hand
from congrasp.common.io.inputs import distinct_names, file_name, read_file, read_json, safe_name
from congrasp.common.objects import store
from congrasp.common.objects.object_message import object_to_message
from congrasp.common.objects.procedural import generate
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import policy_file
from congrasp.common.task.sampling import set_file
from congrasp.common.wire.codec import Message, decode, encode
from congrasp.services.grasp import bvh, wrist_paths
from congrasp.services.record.reader import (
    metrics_of,
    pick_episode,
    read_episodes,
    read_metrics,
    read_records,
)
from congrasp.services.record.writer import (
    EPISODE_SCHEMA,
    Entry,
    JsonChannels,
    LogWriter,
    opaque_channel,
)
from tests.episodes import episode, episode_message
from tests.limits import limited

CLAW = pathlib.Path(__file__).parents[1] / "hands" / "claw.json"
NAN = float("nan")
INF = float("inf")
LOADERS = {
    "object": store.load,
    "set": set_file.load,
    "hand": read_hand,
    "motion": load_motion,
    "policy": bundles.load,
}


BVH = """HIERARCHY
ROOT Hips
{
 OFFSET 0 0 0
 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
 JOINT RightHand
 {
  OFFSET 1 0 0
  CHANNELS 3 Zrotation Xrotation Yrotation
 }
}
MOTION
Frames: 2
Frame Time: 0.01
0 0 0 0 0 0 0 0 0
1 0 0 0 0 0 0 0 0
"""


def _saved(save, *arguments):
    """Bytes of a file that a function writes, to a path or an open file."""
    with tempfile.TemporaryDirectory() as folder:
        save(path := pathlib.Path(folder, "a.npz"), *arguments)
        return path.read_bytes()


OBJECT = _saved(lambda path: store.save(generate(0, "box"), path))


@pytest.mark.parametrize(
    ("kind", "data", "why"),
    [
        ("object", None, "There is no object file"),
        (
            "object",
            OBJECT[:-5] + bytes([OBJECT[-5] ^ 1]) + OBJECT[-4:],
            "cannot be read as an object: .*checksum",
        ),
        ("object", OBJECT[: len(OBJECT) // 2], "cannot be read as an object"),
        (
            "object",
            encode(Message({}, {"kind": "bundle", "format": 1})),
            "not an object of this version",
        ),
        (
            "object",
            encode(Message({}, {"kind": "object", "format": 1})),
            "lacks an array or a field",
        ),
        ("set", None, "cannot be read"),
        ("set", b"not a set", "cannot be read as a constraint set"),
        ("set", OBJECT, "not a constraint set"),
        ("hand", None, "cannot be read"),
        ("hand", b"not json", "is not JSON"),
        ("motion", None, "cannot be read: No such file"),
        ("motion", b"PK nothing", r"not a grasp motion \(it is not an NPZ file, or was cut\)"),
        ("motion", _saved(np.savez, np.zeros(3)), "not a grasp motion"),
        (
            "motion",
            _saved(lambda path: np.savez(path, meta=np.array({"a": 1}, object))),
            "not a grasp motion",
        ),
        ("policy", None, "cannot be read"),
        ("policy", policy_file(None).read_bytes()[:-5], "is damaged"),
    ],
)
def test_absent_cut_and_foreign_files_are_named(tmp_path, kind, data, why):
    path = tmp_path / "a.npz"
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(CongraspError, match=why) as raised:
        LOADERS[kind](path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)
    with pytest.raises(CongraspError, match="the hand file has the format None"):
        hand_from_text("{}")


@pytest.mark.parametrize("name", ["mug", "mug_7", "Becher groß (2)", "x" * 100, "v1.2-b+c"])
def test_names_are_names(name):
    assert file_name(name, "an object") == name


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "..",
        "../../x",
        "/etc/x",
        "a/b",
        "a\\b",
        ".x",
        "-x",
        "a\n",
        "a\0",
        "x" * 101,
        "aux",
        "Com1.obj",
        "mug.",
        None,
        3,
        ["a"],
    ],
)
def test_paths_and_anything_else_are_not(name):
    with pytest.raises(CongraspError, match="cannot name an object"):
        file_name(name, "an object")


def test_letters_of_any_script_stay_in_names_and_equal_names_become_distinct():
    for text, name in (
        ("कटोरी 1/2", "कटोरी_1_2"),
        ("e\u0301", "é"),
        ("..\x1b[1m", "1m"),
        ("☕", "object"),
        ("con", "con_"),
        ("Aux.v1", "Aux_.v1"),
        ("mug..", "mug_"),
    ):
        assert safe_name(text) == name
        file_name(name, "an object")
    long = [safe_name(letter * 150 + end) for letter, end in itertools.product("x碗", "ab")]
    assert len({file_name(name, "an object") for name in long}) == 4
    assert distinct_names(["mug", "Mug", "mug", "mug-2", "cup"]) == [
        "mug",
        "Mug-3",
        "mug-4",
        "mug-2",
        "cup",
    ]
    # Some file systems compose letters, others decompose them
    assert distinct_names(["ta\u0308sse", "t\u00e4sse"]) == ["ta\u0308sse", "t\u00e4sse-2"]


def test_an_object_that_names_another_folder_is_not_read(tmp_path):
    path = tmp_path / "a.safetensors"
    store.save(dataclasses.replace(generate(0, "box"), name="../../x"), path)
    with pytest.raises(CongraspError, match=r"a\.safetensors: '\.\./\.\./x' cannot name an object"):
        store.load(path)
    with pytest.raises(CongraspError, match="cannot name an object"):
        store.Catalogue(tmp_path / "b").add(dataclasses.replace(generate(0, "box"), name="../../x"))
    with pytest.raises(CongraspError, match="cannot name a constraint set"):
        set_file.save(Message({}, {"object": "../../x"}), tmp_path / "c")
    assert [file.name for file in tmp_path.iterdir()] == ["a.safetensors"]


def test_pipes_and_folders_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.safetensors")
    for read in (*LOADERS.values(), lambda path: [*read_records(path)]):
        assert "not a regular file" in limited(read, tmp_path / "a.safetensors", seconds=5)
    with pytest.raises(CongraspError, match="has 4 bytes; the limit is 3"):
        (tmp_path / "b").write_bytes(b"1234")
        read_file(tmp_path / "b", 3)


def _with(values, index, value):
    changed = np.array(values)
    changed[index] = value
    return changed


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda o: {"mass": -1.0}, "mass is -1.0"),
        (lambda o: {"mass": 1e300}, r"mass is 1e\+300"),
        (
            lambda o: {"points": _with(o.points, (3, 1), NAN)},
            "points holds numbers that are not finite",
        ),
        (lambda o: {"points": _with(o.points, 3, 1e9)}, r"points goes up to 1e\+09"),
        (lambda o: {"points": o.points[:7]}, "points has the shape"),
        (lambda o: {"normals": 0 * o.normals}, "normals are not normalised"),
        (lambda o: {"labels": o.labels + 99}, "labels name parts"),
        (lambda o: {"labels": o.labels - 99}, "labels name parts"),
        (lambda o: {"inertia": -o.inertia}, "principal moments"),
        (lambda o: {"inertia": np.diag([1.0, 1.0, 9.0])}, "which no rigid body has"),
        (lambda o: {"inertia": _with(o.inertia, (0, 1), 1.0)}, "not symmetric"),
        (lambda o: {"rest_poses": o.rest_poses[:0]}, "0 resting poses"),
        (lambda o: {"rest_poses": 2 * o.rest_poses}, "quaternions"),
        (lambda o: {"visual_faces": o.visual_faces + 10**6}, "visual_faces"),
        (lambda o: {"pieces": o.pieces * 200}, "pieces"),
        (
            lambda o: {"pieces": (dataclasses.replace(o.pieces[0], size=(-1.0, 1.0, 1.0)),)},
            "piece 0 has the size .* not above 0 and at most 10 m",
        ),
        (
            lambda o: {"pieces": (dataclasses.replace(o.pieces[0], pos=(INF, 0.0, 0.0)),)},
            "numbers that are not finite",
        ),
        (
            lambda o: {"pieces": (dataclasses.replace(o.pieces[0], pos=(99.0, 0.0, 0.0)),)},
            "piece 0 has the position .* more than 10 m from the origin",
        ),
        (lambda o: {"file_scale": 0.0}, "file_scale"),
        (lambda o: {"part_names": ("x" * 999,)}, "names of its parts are not texts of at most"),
        (lambda o: {"points": o.points.astype(int)}, "points has the type int64"),
        (lambda o: {"surface_error": -5.0}, "surface_error is -5.0, below 0 m"),
    ],
)
def test_objects_with_values_that_none_has_are_named(tmp_path, change, why):
    obj = generate(0, "box")
    store.save(dataclasses.replace(obj, **change(obj)), tmp_path / "a.safetensors")
    with pytest.raises(CongraspError, match=why) as raised:
        store.load(tmp_path / "a.safetensors")
    assert str(tmp_path) in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "change", "why"),
    [
        ("piece_size", lambda column: column[..., None], "piece_size has the shape"),
        ("piece_quat", lambda column: column[:, :3], "piece_quat has the shape"),
        ("piece_pos", lambda column: column.astype(bool), "piece_pos has the invalid type"),
        ("piece_kind", lambda column: column * 0 - 1, "piece_kind has a number without a kind"),
        ("piece_vertex_count", lambda column: column - 1, "does not match the vertices"),
    ],
)
def test_an_object_with_invalid_pieces_is_named(tmp_path, name, change, why):
    message = object_to_message(generate(0, "box"))
    arrays = {**message.arrays, name: change(message.arrays[name])}
    path = tmp_path / "a.safetensors"
    path.write_bytes(encode(Message(arrays, message.meta)))
    with pytest.raises(CongraspError, match=why):
        store.load(path)


@pytest.mark.parametrize(
    ("part", "changes", "why"),
    [
        ("task", {"surface_points": 1_000_000}, "surface_points is 1e[+]06, not 1 to 512"),
        ("task", {"trajectory_points": 10**9}, "trajectory_points"),
        ("task", {"substeps": 0}, "substeps is 0"),
        ("task", {"hold_steps_max": 10**12}, "hold_steps_max"),
        ("task", {"control_dt": -1.0}, "control_dt"),
        ("task", {"mass_range": (2.0, 1.0)}, "mass_range"),
        ("network", {"hidden": (10**9,)}, "hidden"),
        ("network", {"hidden": (8,) * 10_000}, "hidden"),
        ("network", {"encoder": 0}, "encoder"),
        (None, {"layout": [["task", 10**12]]}, "observation"),
        (None, {"action_size": 10**9}, "action"),
    ],
)
def test_a_policy_with_sizes_that_nothing_holds_is_refused_at_once(tmp_path, part, changes, why):
    bundle = decode(policy_file(None).read_bytes())
    meta = {**bundle.meta, **({part: {**bundle.meta[part], **changes}} if part else changes)}
    (tmp_path / "a.safetensors").write_bytes(encode(Message(bundle.arrays, meta)))
    with pytest.raises(CongraspError, match=why):
        bundles.load(tmp_path / "a.safetensors")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda h: h["links"][0].update(mass=0.0), "needs a mass above zero"),
        (lambda h: h["links"][0].update(mass=NAN), "not a finite number"),
        (lambda h: h["links"][1]["joints"][0].update(lower=2.0, upper=-2.0), "wrong order"),
        (lambda h: h["wrist"].update(slide_kp=-1.0), "numbers of the wrist must be above zero"),
        (lambda h: h["links"][1]["joints"][0].update(kp=1e300), "not a finite number"),
        (lambda h: h["links"][1].update(capsules=h["links"][1]["capsules"] * 10_000), "more than"),
        (lambda h: h.update(links=h["links"] * 1000), "the limit is"),
        (lambda h: h.update(name="../../x"), "the name"),
        (lambda h: h.update(object_scale=INF), "not a finite number"),
        (
            lambda h: h.update(links=h["links"][:1], open_pose={}, closed_pose={}),
            "it has no joints",
        ),
        (
            lambda h: h.update(couplings=[{"joint": "a", "leader": "b", "ratio": 1.0}] * 20_000),
            "more than 64 couplings",
        ),
        (lambda h: h["links"][1]["joints"][0].update(name="hold"), "the name 'hold' is taken"),
        (lambda h: h["links"][1]["joints"][0].update(axis=[0.0, 2.0, 0.0]), "not a unit vector"),
        (lambda h: h["links"].insert(1, h["links"].pop(2)), "parent 'palm' of|must precede"),
        (lambda h: h["links"].append(h["links"][-1]), "more than once"),
        (lambda h: h["links"].pop(0), "first link must be the palm"),
        (lambda h: h.update(links=3), "not a hand"),
        (lambda h: h.update(thumb="palm"), "the thumb must be a link with a tip"),
        (lambda h: h.update(open_pose={"elbow": 1.0}), "is not a joint"),
        (
            lambda h: h.update(closed_pose={"left_root": 3.0}),
            "outside its limits in the closed pose",
        ),
        (lambda h: h.update(wide_pose={"elbow": 1.0}), "wide pose names 'elbow'"),
        (lambda h: h.update(wide_pose={"left_root": 3.0}), "its limits in the wide pose"),
        (lambda h: h["links"][0].update(mass="0.1"), "must be a number, not '0.1'"),
        (lambda h: h["links"][0].update(mass=True), "must be a number, not True"),
        (lambda h: h.update(open_pose={"left_root": "0.1"}), "must be a number, not '0.1'"),
        (
            lambda h: h["links"][1]["joints"][0].update(axis=[0, "1", 0]),
            "must be a number, not '1'",
        ),
        (lambda h: h.update(text="another"), "unknown field 'text'"),
        (lambda h: h.update(name="x" * 101), "100 at most"),
        (lambda h: h.update(name="3claw"), "not begin with a digit"),
        (lambda h: h.update(format=2), "format 2"),
        (lambda h: h.update(wings=2), "'wings'|wings"),
        (lambda h: h.clear(), "has the format None"),
    ],
)
def test_hands_with_values_that_none_has_are_named(tmp_path, change, why):
    fields = json.loads(CLAW.read_text())
    change(fields)
    path = tmp_path / "a.json"
    path.write_text(json.dumps(fields))
    with pytest.raises(CongraspError, match=why) as raised:
        read_hand(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "text", ["[" * 100_000, "[]", "3", '{"a": ' * 100_000, "9" * 5000, " " * (2 << 20), '"\\ud800"']
)
def test_json_that_is_no_hand_is_refused(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    assert limited(read_hand, tmp_path / "a.json").startswith("CongraspError")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda m: {"control_dt": 0.0}, "control_dt"),
        (
            lambda m: {"joint_position": m.joint_position * NAN},
            "joint_position holds numbers that are not finite",
        ),
        (
            lambda m: {"joint_limits": m.joint_limits[:, ::-1]},
            "joint_limits are in the wrong order",
        ),
        (lambda m: {"link_parent": m.link_parent + 100}, "link_parent names links"),
        (lambda m: {"capsule_radius": -m.capsule_radius}, "capsule_radius"),
        (lambda m: {"table": m.table.astype(float)}, "table has the type"),
        (lambda m: {"time": m.time[:3]}, r"table has shape \(12,\), but \(T,\) requires \(3,\)"),
        (lambda m: {"object_vertices": m.object_vertices[:0]}, "object_vertices is empty"),
        (lambda m: {"object_faces": m.object_faces + 1000}, "names vertices that do not exist"),
        (
            lambda m: {"link_quaternion": 0 * m.link_quaternion},
            r"a\.npz's wrist_quaternion has .* not normalised",
        ),
        (
            lambda m: {"link_quaternion": m.link_quaternion[:, :, :3]},
            r"has shape \(12, 3\), but \(T, 4\) requires",
        ),
    ],
)
def test_motions_with_values_that_none_has_are_named(tmp_path, change, why):
    motion = episode().normalised()
    save_motion(tmp_path / "a.npz", dataclasses.replace(motion, **change(motion)))
    with pytest.raises(CongraspError, match=why):
        load_motion(tmp_path / "a.npz")


def test_motion_whose_object_is_a_path_is_neither_written_nor_read(tmp_path):
    motion = episode().normalised()
    path = tmp_path / "a.npz"
    with pytest.raises(CongraspError, match="cannot name the object"):
        save_motion(path, dataclasses.replace(motion, object="../../x"))
    save_motion(path, motion)
    with np.load(path) as file:
        arrays = dict(file)
    meta = {**json.loads(str(arrays.pop("meta"))), "object": "../../x"}
    np.savez(path, **arrays, meta=np.array(json.dumps(meta)))
    with pytest.raises(CongraspError, match="cannot name the object"):
        load_motion(path)


def constraint_set():
    meta = {
        "object": "mug",
        "hand": "human",
        "object_scale": 1.0,
        "object_digest": "0" * 16,
        "kind": "constraints",
    }
    meta |= {"format": 2, "variants": list(set_file.REGIONS), "finger_joints": ["a", "b"]}
    sizes = {"P": 8, "R": 2, "V": 2, "H": 4, "M": 3, "F": 2, "K": 5, "n": 4, "m": 4}
    arrays = {}
    for name, meaning in set_file.MEANING.items():
        letters = meaning[1 : meaning.index(")")].replace(",", " ").split()
        kind = bool if "bool" in meaning else np.int32 if "indices" in meaning else np.float32
        arrays[name] = np.ones([int(x) if x.isdigit() else sizes[x] for x in letters], kind)
    return Message(arrays, meta)


def test_constraint_sets_with_values_that_none_has_are_named(tmp_path):
    path = tmp_path / "a.safetensors"
    intact = constraint_set()
    for change, why in (
        (Message(intact.arrays, {**intact.meta, "object": "../../x"}), "cannot name the object"),
        (Message(intact.arrays, {**intact.meta, "object_scale": -1}), "object_scale"),
        (
            Message({**intact.arrays, "pose/q": np.full((2, 3, 2), NAN, np.float32)}, intact.meta),
            "pose/q holds",
        ),
        (
            Message({**intact.arrays, "pose/q": np.ones((2, 3, 9), np.float32)}, intact.meta),
            r"pose/q has shape \(2, 3, 9\), but",
        ),
    ):
        path.write_bytes(encode(change))
        with pytest.raises(CongraspError, match=why):
            set_file.load(path)
    path.write_bytes(encode(intact))
    assert set_file.load(path).meta == intact.meta


def refused(function, path, why):
    with pytest.raises(CongraspError, match=why) as caught:
        result = function(path)
        list(result) if hasattr(result, "__next__") else None
    assert len(str(caught.value)) < 1000
    assert str(caught.value).isprintable()


def test_json_is_of_bounded_size_and_depth(tmp_path):
    path = tmp_path / "x.json"
    for text in ("[" * 100_000, "{", ""):
        path.write_text(text)
        refused(lambda path: read_json(path, 10**6), path, "is not JSON")
    path.write_text("[" + "1," * 2000 + "1]")
    refused(lambda path: read_json(path, 1000), path, "4003 bytes; the limit is 1000")
    assert len(read_json(path, 5000)) == 2001
    path.write_bytes(b'"\xff"')
    refused(lambda path: read_json(path, 1000), path, "is not JSON")
    os.mkfifo(pipe := tmp_path / "pipe.json")
    refused(lambda path: read_json(path, 1000), pipe, "not a regular file")


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("CHANNELS 3 Zrotation", "CHANNELS 999999999 Zrotation"),
        ("CHANNELS 3 Zrotation", "CHANNELS -3 Zrotation"),
        ("Zrotation Xrotation Yrotation\n }", "Qrotation Xrotation Yrotation\n }"),
        ("Xposition", "Qposition"),
        ("OFFSET 1 0 0", "OFFSET 1 0"),
        ("Frames: 2", "Frames: 999999999999"),
        ("Frame Time: 0.01", "Frame Time: nan"),
        ("\n1 0 0", "\nnan 0 0"),
        ("{\n OFFSET", "{\n" * 300 + " OFFSET"),
        ("}\n}", "}\n}\n}\n}"),
        ("Frame Time: 0.01", ""),
    ],
)
def test_a_bvh_that_is_none_is_one_line(tmp_path, before, after):
    path = tmp_path / "x.bvh"
    path.write_text(BVH)
    assert bvh.read_bvh(path, "RightHand")[0].shape == (2, 3)
    assert before in BVH
    path.write_text(BVH.replace(before, after))
    refused(lambda path: bvh.read_bvh(path, "RightHand"), path, "cannot be read as BVH")


def test_motions_of_others_are_of_bounded_size(tmp_path, monkeypatch):
    monkeypatch.setattr(bvh, "MAX_BYTES", 100)
    monkeypatch.setattr(wrist_paths, "MAX_CSV_BYTES", 100)
    for name in ("x.bvh", "x.csv"):
        (tmp_path / name).write_text("0,0,0,1,0,0,0\n" * 20)
        refused(wrist_paths.read_wrist_path, tmp_path / name, "bytes; the limit is 100")


def _recording(folder, *entries):
    writer = LogWriter(folder, "log")
    writer.write(*entries)
    writer.close()
    return writer.files[0]


def test_recordings_of_others_are_one_line(tmp_path):
    channel = JsonChannels().entry("/metrics/learner/0", 1, {"values": {"x": 1.0}}).channel
    for number, data in enumerate(
        (
            b"{",
            b"[" * 10**5,
            b"[]",
            b"{}",
            (b'{"values": 7}'),
            b'{"values": {"x": "y"}}',
            b'{"values": {}, "update": "z"}',
        )
    ):
        path = _recording(tmp_path / str(number), Entry(channel, 1, data))
        refused(read_metrics, path, "is not JSON|has no metrics")
        (record,) = read_records(path)
        refused(
            lambda path, record=record: metrics_of(record), path, "A record of '/metrics/learner/0'"
        )
    raw = opaque_channel("/episode/a/raw", EPISODE_SCHEMA)
    message = episode_message()
    for number, (change, why) in enumerate(
        (
            ({"hand": "/etc/hosts.json"}, "not a built-in hand"),
            ({"success": None}, "'success' is None"),
            ({"metrics": []}, r"'metrics' is \[\]"),
        )
    ):
        data = encode(Message(message.arrays, {**message.meta, **change}))
        path = _recording(tmp_path / f"e{number}", Entry(raw, 1, data))
        refused(read_episodes, path, why)
        refused(lambda path: pick_episode(path, -1), path, why)
    lost = {name: array for name, array in message.arrays.items() if name != "visual_faces"}
    path = _recording(tmp_path / "lost", Entry(raw, 1, encode(Message(lost, message.meta))))
    refused(read_episodes, path, "lacks the array 'visual_faces'")
    path = _recording(tmp_path / "fine", Entry(raw, 1, encode(message)))
    np.testing.assert_array_equal(next(read_episodes(path)).joint_position, message.arrays["q"])
