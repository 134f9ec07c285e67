"""DexYCB's folders: a known answer, and what is wrong with files."""

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.services.assets.captures.dexycb import OBJECTS
from tests.mano_file import content, skeleton
from tests.services.assets.captures import known

MUG = OBJECTS.index("025_mug") + 1


def write(case, root, session, *, meta=None, change=lambda poses: None):
    """One session, the mug's mesh and the subject's calibration."""
    values = content()
    angles = (
        Rotation.from_matrix(known.mano_rotations(case.fingers).reshape(-1, 3, 3))
        .as_rotvec()
        .reshape(-1, 45)
    )
    coefficients = np.linalg.solve(
        values["hands_components"].T, (angles - values["hands_mean"]).T
    ).T
    root_turn = known.mano_root(case.wrist_rotation).as_rotvec()
    hand = np.concatenate([root_turn, coefficients, case.wrist_position - skeleton()[0][0]], 1)
    other = np.tile([0, 0, 0, 1, 0.5, 0, 0], (len(hand), 1))
    place = np.concatenate([case.object_rotation.as_quat(), case.object_position], 1)
    poses = {
        "pose_y": np.stack([other, place], 1).astype(np.float32),
        "pose_m": hand[:, None].astype(np.float32),
    }
    change(poses)
    folder = root / "20200709-subject-01" / session
    folder.mkdir(parents=True)
    np.savez(folder / "pose.npz", **poses)
    facts = {
        "serials": ["836212060125"],
        "num_frames": len(hand),
        "ycb_ids": [3, MUG],
        "ycb_grasp_ind": 1,
        "mano_sides": ["right"],
        "mano_calib": ["20200709-subject-01_right"],
        "extrinsics": "20200702_151821",
    }
    (folder / "meta.yml").write_text(
        yaml.safe_dump({k: v for k, v in (facts | (meta or {})).items() if v is not None})
    )
    calibration = root / "calibration" / "mano_20200709-subject-01_right"
    calibration.mkdir(parents=True, exist_ok=True)
    (calibration / "mano.yml").write_text(yaml.safe_dump({"betas": [0.0] * 10}))
    known.write_mesh(case, root / "models" / "025_mug" / "textured_simple.obj")


def test_a_synthetic_grasp_is_recovered(run_import, tmp_path, mano):
    case = known.make("lift", "025_mug", 7)
    write(case, tmp_path, "20200709_141754")
    sets, report = run_import("dexycb", tmp_path, "--mano", mano)
    assert [row["frame"] for row in report.kept] == [known.GRASP]
    known.check(sets["025_mug"].arrays, 0, case)


def test_a_faulty_session_names_its_fault(run_import, tmp_path, mano):
    case = known.make("lift", "025_mug", 8)

    def unseen(poses):
        poses["pose_m"][:] = 0.0

    def hidden(poses):  # the object is not seen from shortly before the grasp on
        poses["pose_y"][known.GRASP - 5 :, 1] = [0, 0, 0, 1, 0, 0, 0]

    def bridged(poses):
        poses["pose_y"][20:23, 1] = [0, 0, 0, 1, 0, 0, 0]
        poses["pose_m"][30:32] = 0.0

    write(case, tmp_path, "bridged", change=bridged)
    write(case, tmp_path, "left", meta={"mano_sides": ["left"]})
    write(case, tmp_path, "nokey", meta={"ycb_grasp_ind": None})
    write(case, tmp_path, "noobject", meta={"ycb_grasp_ind": 4})
    write(case, tmp_path, "nopose", change=lambda poses: poses.pop("pose_m"))
    write(
        case, tmp_path, "shape", change=lambda poses: poses.update(pose_m=poses["pose_m"][..., :48])
    )
    write(case, tmp_path, "unseen", change=unseen)
    write(case, tmp_path, "hidden", change=hidden)
    write(case, tmp_path, "uncalibrated", meta={"mano_calib": ["someone"]})
    write(case, tmp_path, "nomesh", meta={"ycb_grasp_ind": 0})
    sets, report = run_import("dexycb", tmp_path, "--mano", mano)
    assert [row["sequence"] for row in report.kept] == ["20200709-subject-01/bridged"]
    known.check(sets["025_mug"].arrays, 0, case)
    assert {row["sequence"].split("/")[1]: row["rule"] for row in report.dropped} == {
        "left": "left hand",
        "nokey": "wrong layout",
        "noobject": "wrong layout",
        "nopose": "wrong layout",
        "shape": "wrong layout",
        "unseen": "frames missing",
        "hidden": "no stable contact",
        "uncalibrated": "wrong layout",
        "nomesh": "no mesh",
    }


def test_a_missing_mano_file_is_requested(run_import, tmp_path):
    with pytest.raises(CongraspError, match="require the file MANO_RIGHT"):
        run_import("dexycb", tmp_path)
