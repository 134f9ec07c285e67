"""MyoDM files: the arm against MuJoCo, a known answer, and what is wrong with files."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common.objects.store import Catalogue
from congrasp.common.task.sampling.set_bank import bank_of
from congrasp.common.task.sampling.set_file import load_for
from congrasp.services.assets.captures.myohand import wrist_pose
from tests.services.assets.captures import known

# MyoHand's arm on its table (Apache-2.0, MyoHub), from the base to the lunate.
ARM = """<mujoco><compiler angle="radian"/><worldbody><body pos=".1 -.55 .32">
  <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/>
  <joint axis="1 0 0"/><joint axis="0 1 0"/><joint axis="0 0 1"/><geom size=".01"/>
  <body pos="-.175 .1 -1.4" euler="0 0 3.14"><body pos="0 .08 1.4" euler="1.57 -1.57 0">
  <body pos=".006325 .00693 .025465"><body pos="-.01433 .02007 .135535"><body pos="-.00955 -.034 .009">
  <body euler="0 0 1.57"><body pos=".0061 -.2904 -.0123"><body pos=".0004 -.011503 .019999">
  <joint axis="-.017161 .992666 -.119668"/><geom size=".01"/>
  <body name="lunate" pos=".018 -.242 .025"><joint axis="0 0 1"/><joint axis="1 0 0"/><geom size=".01"/></body>
  </body></body></body></body></body></body></body></body></body></worldbody></mujoco>"""


def arm_for(position, rotation, rng):
    """(T, 9) joints that put the wrist at positions (T, 3) and orientations."""
    lower = np.tile(rng.uniform(-0.4, 0.4, 3), (len(position), 1))
    bare = np.concatenate([np.zeros((len(position), 6)), lower], 1)
    _, turn = wrist_pose(bare)
    arm = rotation * turn.inv()
    joints = np.concatenate([np.zeros((len(position), 3)), arm.as_euler("XYZ"), lower], 1)
    joints[:, :3] = position - wrist_pose(joints)[0]
    return joints


def write(case, path, **changes):
    rng = np.random.default_rng(1)
    robot = np.concatenate(
        [arm_for(case.wrist_position, case.wrist_rotation, rng), case.fingers], 1
    )
    place = case.object_position - [0, 0, 0.035]
    arrays = {
        "time": 0.02 * np.arange(len(robot)),
        "robot": robot,
        "object": np.concatenate([place, case.object_rotation.as_quat(scalar_first=True)], 1),
        "robot_init": robot[0],
        "object_init": np.zeros(7),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        path, **{name: array for name, array in (arrays | changes).items() if array is not None}
    )
    return arrays


def test_the_arm_is_that_of_the_model():
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    joints = np.random.default_rng(0).uniform(-0.5, 0.5, (5, 9))
    position, rotation = wrist_pose(joints)
    for row, place, turn in zip(joints, position, rotation, strict=True):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(place, data.body("lunate").xpos, atol=1e-6)
        other = Rotation.from_quat(data.body("lunate").xquat, scalar_first=True)
        assert (turn * other.inv()).magnitude() < 1e-5


def test_a_synthetic_grasp_is_recovered(run_import, tmp_path):
    cases = [known.make(f"MyoHand_box_lift{seed}", "box", seed) for seed in range(2)]
    for case in cases:
        write(case, tmp_path / "data" / f"{case.name}.npz")
    known.write_mesh(cases[0], tmp_path / "meshes" / "box.stl")
    sets, report = run_import("myohand", tmp_path / "data", "--meshes", tmp_path / "meshes")
    assert not report.dropped
    assert [row["frame"] for row in report.kept] == [known.GRASP] * 2
    for m, case in enumerate(cases):
        known.check(sets["box"].arrays, m, case)
    assert sets["box"].meta["demonstrations"] == [case.name for case in cases]
    assert sets["box"].meta["source"] == "myohand"
    assert all(0.0 <= row["posture_rad"] <= 1.0 for row in report.kept)


@pytest.mark.parametrize("headings", ["sampled", "demonstrated"])
@pytest.mark.slow
def test_a_fifth_of_all_sequences_is_held_out(run_import, tmp_path, headings):
    for seed, name in enumerate("abcde"):
        case = known.make(f"MyoHand_{name}_lift", name, seed)
        write(case, tmp_path / "data" / f"{case.name}.npz")
        known.write_mesh(case, tmp_path / "meshes" / f"{name}.stl")
    options = ["--meshes", tmp_path / "meshes", "--headings", headings]
    _, report = run_import("myohand", tmp_path / "data", *options)
    held = [row["object"] for row in report.kept if row["split"] == "held-out"]
    assert len(report.kept) == 5
    assert len(held) == 1
    catalogue = Catalogue(tmp_path / "objects")
    imported = [catalogue.get(name) for name in catalogue.list()]
    for split, names in (("training", set("abcde") - set(held)), ("held-out", set(held))):
        objects, chosen = load_for(tmp_path / "out", imported, split)
        if headings == "demonstrated":  # a heading belongs where its demonstration does
            assert {obj.name for obj in objects} == names
        valid = bank_of(chosen, split).pose_valid[:, 0].any((1, 2))
        assert {
            obj.name for obj, any_valid in zip(objects, valid, strict=True) if any_valid
        } == names


def test_a_faulty_file_names_its_fault(run_import, tmp_path):
    case = known.make("MyoHand_box_lift", "box")
    folder = tmp_path / "data"
    right = write(case, folder / "MyoHand_box_right.npz")
    robot = right["robot"]
    pose = right["object"]
    write(case, folder / "MyoHand_box_nokey.npz", object=None)
    write(case, folder / "MyoHand_box_back.npz", time=right["time"][::-1])
    write(case, folder / "MyoHand_box_shape.npz", robot=robot[:, :28])
    write(case, folder / "MyoHand_box_words.npz", object=np.full(len(pose), "a"))
    degrees = np.concatenate([robot[:, :3], np.degrees(robot[:, 3:])], 1)
    write(case, folder / "MyoHand_box_degrees.npz", robot=degrees)
    write(case, folder / "MyoHand_box_millimetres.npz", object=pose * ([1000] * 3 + [1] * 4))
    write(case, folder / "MyoHand_box_reversed.npz", robot=robot[::-1], object=pose[::-1])
    gone = robot.copy()
    gone[:, 0] = np.nan
    write(case, folder / "MyoHand_box_gone.npz", robot=gone)
    write(case, folder / "MyoHand_cup_lift.npz")
    (folder / "MyoHand_box_text.npz").write_text("not an archive")
    limits = robot.copy()
    limits[:, 9 + 14] = 2.2
    write(case, folder / "MyoHand_box_limits.npz", robot=limits)
    known.write_mesh(case, tmp_path / "meshes" / "box.stl")
    sets, report = run_import("myohand", folder, "--meshes", tmp_path / "meshes")
    assert [row["sequence"] for row in report.kept] == ["MyoHand_box_right"]
    assert list(sets) == ["box"]
    reasons = {
        row["sequence"].split("_")[-1]: (row["rule"], row["reason"]) for row in report.dropped
    }
    for name, rule, words in (
        ("nokey", "wrong layout", "no 'object'"),
        ("back", "wrong layout", "time decreases"),
        ("shape", "wrong layout", "(90, 28)"),
        ("words", "wrong layout", "'object' of the file is not a numeric array"),
        ("degrees", "wrong units", "radians"),
        ("millimetres", "wrong units", "in metres"),
        ("gone", "frames missing", "no frame"),
        ("text", "unreadable", "cannot be read"),
        ("reversed", "no approach", "does not move before the grasp"),
        ("lift", "no mesh", "no mesh of 'cup'"),
        ("limits", "joint limits", "ring_pip is 0.45 rad beyond"),
    ):
        assert reasons[name][0] == rule
        assert words in reasons[name][1]


def test_missing_frames_are_bridged_or_end_the_approach(run_import, tmp_path):
    case = known.make("MyoHand_box_short", "box")
    right = write(case, tmp_path / "data" / "MyoHand_box_bridged.npz")
    for name, start, count in (("bridged", 20, 3), ("ended", 30, 6)):
        pose = right["object"].copy()
        pose[start : start + count] = np.nan
        write(case, tmp_path / "data" / f"MyoHand_box_{name}.npz", object=pose)
    known.write_mesh(case, tmp_path / "meshes" / "box.stl")
    sets, report = run_import("myohand", tmp_path / "data", "--meshes", tmp_path / "meshes")
    assert {row["sequence"]: row["first_frame"] for row in report.kept} == {
        "MyoHand_box_bridged": 0,
        "MyoHand_box_ended": 36,
    }
    known.check(sets["box"].arrays, 0, case)
