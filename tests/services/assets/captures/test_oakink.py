"""OakInk-Image's annotations, with tensors as PyTorch pickles them: a known answer, affordance, and
what is wrong.
"""

import json
import pickle
import struct

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.services.assets.captures.oakink import read
from congrasp.services.assets.captures.sequence import Meshes
from tests.mano_file import Global, Reduced, dumps
from tests.services.assets.captures import known

STAMP = "2021-09-26-19-59-58"


def tensor(values):
    """PyTorch's pickle of a tensor of 32-bit floats: pickles of facts about the storage, and its
    numbers.
    """
    values = np.ascontiguousarray(values, np.float32)
    machine = {
        "protocol_version": 1001,
        "little_endian": True,
        "type_sizes": {"short": 2, "int": 4, "long": 4},
    }
    facts = [
        pickle.dumps(fact, 2)
        for fact in (0x1950A86A20F9469CFC6C, 1001, machine, values.size, ["94"])
    ]
    reference = b"\x80\x02(" + b"".join(
        dumps(word)[2:-1] for word in ("storage", Global("torch FloatStorage"), "94", "cpu")
    )
    facts[3] = reference + facts[3][2:-1] + b"NtQ."
    stored = b"".join(facts) + struct.pack("<q", values.size) + values.tobytes()
    storage = Reduced(
        "torch.storage _load_from_bytes", (Reduced("_codecs encode", (stored, "latin1")),)
    )
    strides = tuple(stride // 4 for stride in values.strides)
    ordered = Reduced("collections OrderedDict")
    return Reduced(
        "torch._utils _rebuild_tensor_v2", (storage, 0, values.shape, strides, False, ordered)
    )


def pickled(info):
    """Annotations as OakInk has them, whose arrays are tensors."""
    if isinstance(info, dict):
        return {name: pickled(value) for name, value in info.items()}
    return tensor(info) if isinstance(info, np.ndarray) else info


def write(case, root, *, cameras=(3, 1), every=1, change=lambda frame, info: info):
    """Annotations of one sequence, seen by some cameras; its name is
    `<object>_<intent>_<subject>`.
    """
    folder = root / "anno" / "general_info"
    folder.mkdir(parents=True, exist_ok=True)
    index = root / "anno" / "seq_all.json"
    rows = json.loads(index.read_text()) if index.is_file() else []
    rotations = known.mano_rotations(case.fingers)
    roots = known.mano_root(case.wrist_rotation).as_matrix()
    # OakInk centres the mesh first
    middle = case.object_position + case.object_rotation.apply(known.ORIGIN)
    for frame in range(0, len(rotations), every):
        turns = Rotation.from_matrix(np.concatenate([roots[frame][None], rotations[frame]]))
        pose = np.eye(4)
        pose[:3, :3] = case.object_rotation[frame].as_matrix()
        pose[:3, 3] = middle[frame]
        hand = {
            "hand_pose": turns.as_quat(scalar_first=True).reshape(64),
            "hand_shape": np.zeros(10),
            "hand_tsl": case.wrist_position[frame],
        }
        info = change(
            frame,
            {"hand_anno": hand, "obj_anno": pose, "cam_extr": np.eye(4), "cam_intr": np.eye(3)},
        )
        for camera in cameras:
            rows.append([f"{case.name}/{STAMP}", 0, frame, camera])
            if info is not None:
                (folder / f"{case.name}__{STAMP}__0__{frame}__{camera}.pkl").write_bytes(
                    dumps(pickled(info))
                )
    index.write_text(json.dumps(rows))
    known.write_mesh(case, root / "obj" / f"{case.object_name}.obj")


def write_parts(case, root, border):
    """OakBase's parts of the box: what lies above a height in its own frame, and the rest."""
    points, _ = trimesh.sample.sample_surface(case.mesh(), 4000, seed=1)
    above = (points - known.ORIGIN)[:, 2] > border
    folder = root / "OakBase" / "bottle" / case.object_name
    folder.mkdir(parents=True)
    for i, (name, chosen) in enumerate((("grip", above), ("rest", ~above))):
        trimesh.PointCloud(points[chosen]).export(folder / f"part_{i}.ply")
        (folder / f"part_{i}.json").write_text(json.dumps({"name": name, "attr": ["held_by_hand"]}))


def test_a_synthetic_grasp_is_recovered_with_its_affordance(run_import, tmp_path):
    case = known.make("A01001_0001_0000", "A01001", 9, tail=0.08)
    write(case, tmp_path)
    border = case.size[2] / 2 - 0.045
    write_parts(case, tmp_path, border)
    sets, report = run_import("oakink", tmp_path)
    assert not report.dropped
    assert [row["frame"] for row in report.kept] == [known.GRASP]
    arrays = sets["A01001-grip"].arrays
    known.check(arrays, 0, case)
    below = arrays["surface/points"][:, 2] < border
    assert (arrays["surface/avoid"] == below).mean() > 0.98
    assert 0.2 < below.mean() < 0.8


def test_an_affordance_of_less_than_a_tenth_is_dropped(run_import, tmp_path):
    case = known.make("A01001_0001_0000", "A01001", 9, tail=0.8)
    write(case, tmp_path)
    write_parts(case, tmp_path, case.size[2] / 2 - 0.045)
    _, report = run_import("oakink", tmp_path, code=2)
    assert report.dropped[0]["rule"] == "graspable region too small"
    assert "% of its surface" in report.dropped[0]["reason"]
    _, report = run_import("oakink", tmp_path, "--affordance", "none")
    assert [row["object"] for row in report.kept] == ["A01001"]


def test_one_camera_counts_and_frames_are_sorted(tmp_path):
    case = known.make("A01001_0001_0000", "A01001", 10)
    write(case, tmp_path, cameras=(3, 1), every=2)
    index = tmp_path / "anno" / "seq_all.json"
    rows = json.loads(index.read_text())
    index.write_text(json.dumps(rows[::-1]))
    (sequence,) = read(tmp_path, Meshes(()), None)
    np.testing.assert_allclose(sequence.wrist_position, case.wrist_position[::2], atol=1e-6)


def test_subjects_of_one_sequence_have_different_names(tmp_path):
    case = known.make("A01001_0001_0000", "A01001", 10)
    write(case, tmp_path, cameras=(1,))
    index = tmp_path / "anno" / "seq_all.json"
    rows = json.loads(index.read_text())
    index.write_text(json.dumps([*rows, *([row[0], 1, *row[2:]] for row in rows)]))
    folder = tmp_path / "anno" / "general_info"
    for file in list(folder.iterdir()):
        copy = folder / file.name.replace(f"{STAMP}__0__", f"{STAMP}__1__")
        copy.write_bytes(file.read_bytes())
    names = [sequence.name for sequence in read(tmp_path, Meshes(()), None)]
    assert names == [f"{case.name}/{STAMP}/0", f"{case.name}/{STAMP}/1"]


def test_a_name_of_an_object_is_no_pattern(tmp_path):
    """The parts of another object are not those of one whose name would match any."""
    case = known.make("A01001_0001_0000", "A01001", 10)
    write(case, tmp_path)
    write_parts(case, tmp_path, 0.0)
    (tmp_path / "OakBase" / "bottle" / "A01001").rename(tmp_path / "OakBase" / "bottle" / "other")
    (tmp_path / "metaV2").mkdir()
    names = {"A01001": {"name": "*"}}
    (tmp_path / "metaV2" / "yodao_object_id.json").write_text(json.dumps(names))
    (sequence,) = read(tmp_path, Meshes(()), None)
    assert sequence.object_name == "*" and sequence.parts == ()


def test_faulty_annotations_name_their_fault(run_import, tmp_path):
    case = known.make("right", "A01001", 11)

    def variant(name, change):
        case.name = f"A01001_{name}_0000"
        write(case, tmp_path, cameras=(0,), every=1, change=change)

    def without(key, inside=None):
        def change(frame, info):
            (info[inside] if inside else info).pop(key)
            return info

        return change

    def millimetres(frame, info):
        info["obj_anno"] = info["obj_anno"] * np.array([[1, 1, 1, 1000]] * 3 + [[1] * 4])
        return info

    variant("0001", lambda frame, info: None if frame in (20, 21, 22) else info)
    variant("nokey", without("obj_anno"))
    variant("nopose", without("hand_pose", "hand_anno"))
    variant("gone", lambda frame, info: None)
    variant("lefthand", lambda frame, info: info | {"hand_anno": None})
    variant("millimetres", millimetres)
    case.object_name = "C90001"
    case.name = "C90001_0001_0000"
    write(case, tmp_path, cameras=(0,))
    (tmp_path / "obj" / "C90001.obj").unlink()
    sets, report = run_import("oakink", tmp_path)
    assert [row["sequence"] for row in report.kept] == [f"A01001_0001_0000/{STAMP}"]
    known.check(sets["A01001"].arrays, 0, case)
    assert {"_".join(row["sequence"].split("_")[:2]): row["rule"] for row in report.dropped} == {
        "A01001_nokey": "wrong layout",
        "A01001_nopose": "wrong layout",
        "A01001_gone": "frames missing",
        "A01001_lefthand": "frames missing",
        "A01001_millimetres": "wrong units",
        "C90001_0001": "no mesh",
    }


def test_a_file_that_would_run_something_is_not_unpickled(run_import, tmp_path):
    hostile = Reduced("os mkdir", (str(tmp_path / "it ran"),))
    case = known.make("A01001_0001_0000", "A01001", 12)
    write(case, tmp_path, cameras=(0,), change=lambda frame, info: info | {"obj_anno": hostile})
    _, report = run_import("oakink", tmp_path, code=2)
    assert report.dropped[0]["rule"] == "unreadable"
    assert "is not part of an array" in report.dropped[0]["reason"]
    assert not (tmp_path / "it ran").exists()


def test_a_folder_without_annotations_is_refused(run_import, tmp_path):
    with pytest.raises(CongraspError, match="seq_all"):
        run_import("oakink", tmp_path)


@pytest.mark.parametrize("text", ['{"a": 1}', "[[1, 2]]", '[["A01001_0001_0000", "x", 0, 0]]', "3"])
def test_a_list_of_other_rows_is_refused(tmp_path, text):
    (tmp_path / "anno").mkdir()
    (tmp_path / "anno" / "seq_all.json").write_text(text)
    with pytest.raises(
        CongraspError, match=r"rows that are not \[sequence, subject, frame, camera\]"
    ):
        list(read(tmp_path, Meshes(()), None))
