"""GRAB's files: a known answer, the grasping frame's sources, and what is wrong with files."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.services.assets.captures.human import MEAN_WRIST
from tests.mano_file import content, skeleton
from tests.services.assets.captures import known


def write(case, root, wrist, *, labels=None, change=lambda data: None):
    """`<root>/grab/s1/<name>.npz` and the object's mesh; the wrist (3,) is the rest shape's."""
    frames = len(case.fingers)
    vertices = 8
    if labels is None:
        labels = np.zeros((frames, vertices), int)
        labels[known.GRASP :, 0] = 55
        labels[known.GRASP :, 1] = 43
    hand = {
        "global_orient": known.mano_root(case.wrist_rotation).as_rotvec(),
        "hand_pose": np.zeros((frames, 24)),
        "transl": case.wrist_position - wrist,
        "fullpose": Rotation.from_matrix(
            known.mano_rotations(case.fingers).reshape(-1, 3, 3)
        ).as_rotvec(),
    }
    hand["fullpose"] = hand["fullpose"].reshape(frames, 45)
    thing = {
        "transl": case.object_position,
        "global_orient": case.object_rotation.inv().as_rotvec(),
    }
    data = {
        "gender": "male",
        "sbj_id": "s1",
        "obj_name": case.object_name,
        "framerate": 120.0,
        "n_frames": frames,
        "rhand": {"params": hand, "vtemp": "tools/subject_meshes/male/s1_rhand.ply"},
        "lhand": {"params": {}, "vtemp": "tools/subject_meshes/male/s1_lhand.ply"},
        "object": {
            "params": thing,
            "object_mesh": f"tools/object_meshes/contact_meshes/{case.object_name}.ply",
        },
        "contact": {"body": np.zeros((frames, 3), int), "object": labels},
    }
    change(data)
    path = root / "grab" / "s1" / f"{case.name}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **data)
    known.write_mesh(
        case, root / "tools" / "object_meshes" / "contact_meshes" / f"{case.object_name}.ply"
    )


def test_a_synthetic_grasp_is_recovered_with_the_subjects_template(run_import, tmp_path, mano):
    template = content()["v_template"] + np.array([0.003, -0.002, 0.004])
    folder = tmp_path / "tools" / "subject_meshes" / "male"
    folder.mkdir(parents=True)
    faces = np.arange(777).reshape(-1, 3)
    trimesh.Trimesh(template, faces, process=False).export(folder / "s1_rhand.ply")
    case = known.make("box_lift_1", "box", 3)
    write(case, tmp_path, skeleton()[0][0] + np.array([0.003, -0.002, 0.004]))
    sets, report = run_import("grab", tmp_path, "--mano", mano)
    assert not report.dropped
    assert report.kept[0]["residual_rad"] < 1e-3
    assert report.kept[0]["residual_tip_m"] < 1e-4
    known.check(sets["box"].arrays, 0, case)
    # No labelled parts: everything may be grasped
    assert not sets["box"].arrays["surface/avoid"].any()


def test_without_a_mano_file_the_human_hands_bones_are_used(run_import, tmp_path):
    case = known.make("box_lift_1", "box", 4)
    write(case, tmp_path, MEAN_WRIST)
    sets, _ = run_import("grab", tmp_path / "grab" / "s1" / "box_lift_1.npz")
    known.check(sets["box"].arrays, 0, case)


def test_grabnet_names_the_grasping_frame(run_import, tmp_path):
    case = known.make("box_lift_1", "box", 5)
    write(case, tmp_path, MEAN_WRIST)
    (tmp_path / "data" / "train").mkdir(parents=True)
    names = [f"data/train/s1/box_lift_1/{frame}.npz" for frame in (75, 70, 80)] + [
        "data/train/s2/box_lift_1/3.npz"
    ]
    np.savez(tmp_path / "data" / "train" / "frame_names.npz", frame_names=np.array(names))
    _, report = run_import("grab", tmp_path)
    assert [row["frame"] for row in report.kept] == [70]


def test_a_faulty_file_names_its_fault(run_import, tmp_path):
    case = known.make("box_lift", "box", 6)

    def variant(name, change, **options):
        case.name = name
        write(case, tmp_path, MEAN_WRIST, change=change, **options)

    variant("box_right_1", lambda data: None)
    variant("box_left_1", lambda data: data.pop("rhand"))
    variant("box_nokey_1", lambda data: data["rhand"]["params"].pop("fullpose"))
    variant("box_noobject_1", lambda data: data.pop("object"))
    variant(
        "box_millimetres_1",
        lambda data: data["object"]["params"].update(transl=1000 * case.object_position),
    )
    gone = case.wrist_position.copy()
    gone[known.GRASP - 10 :] = np.nan
    variant("box_gone_1", lambda data: data["rhand"]["params"].update(transl=gone))
    variant("box_lefttouch_1", lambda data: None, labels=np.full((known.FRAMES, 8), 25))
    variant("cup_lift_1", lambda data: data.update(obj_name="cup"))
    sets, report = run_import("grab", tmp_path)
    assert [row["sequence"] for row in report.kept] == ["s1/box_right_1"]
    assert list(sets) == ["box"]
    assert {
        row["sequence"].removeprefix("s1/").removesuffix("_1"): row["rule"]
        for row in report.dropped
    } == {
        "box_left": "left hand",
        "box_nokey": "wrong layout",
        "box_noobject": "wrong layout",
        "box_millimetres": "wrong units",
        "box_gone": "no stable contact",
        "box_lefttouch": "no stable contact",
        "cup_lift": "no mesh",
    }


def test_a_folder_of_another_kind_is_refused(run_import, tmp_path):
    with pytest.raises(
        CongraspError, match=r"contains no sequence of grab\. Pass the folder with s1/"
    ):
        run_import("grab", tmp_path)
