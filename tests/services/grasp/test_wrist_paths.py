"""Wrist paths from CSV, NPZ and BVH, each written with the same path."""

import itertools
import pathlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.services.grasp.bvh import read_bvh
from congrasp.services.grasp.csv_recorders import HEADER, RECORDERS
from congrasp.services.grasp.wrist_paths import read_wrist_path

FRAMES = 12
T = np.linspace(0, 1, FRAMES)
POSITION = np.stack([0.3 * T, 0.1 * np.sin(3 * T), 0.2 + 0.1 * T], -1)
ROTATION = Rotation.from_rotvec(np.outer(T, [0.4, -0.3, 0.8]))
ROS = "x,y,z,qx,qy,qz,qw"


def bvh(path, order="ZXY", unit=0.01):
    """Writes a skeleton of three joints, y up, whose hand follows the path; the angles of the arm
    are arbitrary.
    """
    up = Rotation.from_euler("X", -90, degrees=True)
    place = up.apply(POSITION) / unit
    turn = up * ROTATION
    shoulder = Rotation.from_rotvec(np.outer(T, [0.2, 0.5, -0.1]))
    arm = np.array([3.0, -20.0, 1.0])
    hand = np.array([0.0, -25.0, 2.0])
    elbow = Rotation.from_rotvec(np.outer(T, [-0.3, 0.0, 0.6]))
    root = place - shoulder.apply(arm) - (shoulder * elbow).apply(hand)
    turns = [shoulder, elbow, (shoulder * elbow).inv() * turn]
    names = " ".join(f"{axis}rotation" for axis in order)
    text = f"""HIERARCHY
ROOT Shoulder
{{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition {names}
  JOINT Arm
  {{
    OFFSET {" ".join(map(str, arm))}
    CHANNELS 3 {names}
    JOINT Hand
    {{
      OFFSET {" ".join(map(str, hand))}
      CHANNELS 3 {names}
      End Site
      {{
        OFFSET 0 -10 0
      }}
    }}
  }}
  JOINT Head
  {{
    OFFSET 0 30 0
    CHANNELS 3 {names}
  }}
}}
MOTION
Frames: {FRAMES}
Frame Time: 0.02
"""
    angles = [turn.as_euler(order, degrees=True) for turn in turns]
    rows = np.concatenate([root, *angles, np.zeros((FRAMES, 3))], 1)
    lines = []
    for row in rows:
        lines.append(" ".join(f"{x:.6f}" for x in row))
    path.write_text(text + "\n".join(lines) + "\n")
    return path


def check(path):
    np.testing.assert_allclose(path.position, POSITION, atol=1e-6)
    assert (path.rotation * ROTATION.inv()).magnitude().max() < 1e-6


@pytest.mark.parametrize("order", ["".join(axes) for axes in itertools.permutations("XYZ")])
def test_the_channels_of_a_skeleton_may_have_any_order(tmp_path, order):
    path = read_wrist_path(file := bvh(tmp_path / "motion.bvh", order), joint="Hand")
    check(path)
    assert path.seconds == 0.02
    file.write_text(
        file.read_text().replace("position", "POSITION").replace("rotation", "Rotation")
    )
    check(read_wrist_path(file, joint="Hand"))


def test_csv_and_npz_give_the_same_path(tmp_path):
    quaternion = ROTATION.as_quat(scalar_first=True)
    np.savez(tmp_path / "a.npz", position=POSITION, quaternion=quaternion)
    np.savez(tmp_path / "b.npz", wrist_position=POSITION, wrist_quaternion=quaternion)
    rows = np.concatenate([POSITION, quaternion], 1)
    np.savetxt(tmp_path / "c.csv", rows, delimiter=",")
    np.savetxt(tmp_path / "d.csv", rows, delimiter=",", header="x, y, z, qw, qx, qy, qz")
    for name in ("a.npz", "b.npz", "c.csv", "d.csv"):
        check(read_wrist_path(tmp_path / name))


ROS = "x,y,z,qx,qy,qz,qw"
FIELDS = "position.x position.y position.z orientation.x orientation.y orientation.z orientation.w"
EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]"
)


def _ros(pose, first):
    return ",".join([first, *(f"{pose}.{field}" for field in FIELDS.split())])


@pytest.mark.parametrize(
    ("header", "order", "separator"),
    [
        (HEADER, "pw", ","),
        ("# " + ROS, "pq", ","),
        ('"T","X","Y","Z","QX","QY","QZ","QW"', "tpq", ","),
        ("x;y;z;qx;qy;qz;qw;", "pq", ";"),
        ("t\tx\ty\tz\tqx\tqy\tqz\tqw", "tpq", "\t"),
        (f",{ROS}", "tpq", ","),
        (ROS + ",vx,vy,vz", "pqv", ","),
        ("t,qx,qy,qz,qw,vx,vy,vz,x,y,z", "tqvp", ","),
        (ROS, "pq", " "),
        ("# a title\n" + ROS, "pq", ","),
        ("# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw", "tpq", " "),
        ("#\tx\ty\tz\tqx\tqy\tqz\tqw", "pq", "\t"),
        (EUROC, "tpwv", ","),
        (EUROC.replace("timestamp", "timestamp [ns]"), "tpwv", ","),
        (_ros("field.pose", "%time"), "tpq", ","),
        (_ros("field.pose.pose", "%time"), "tpq", ","),
        (_ros("pose", "Time"), "tpq", ","),
        (_ros("pose.pose", "Time") + ",twist.linear.x,twist.linear.y,twist.linear.z", "tpqv", ","),
    ],
)
def test_a_header_places_the_columns(tmp_path, header, order, separator):
    parts = {"t": T[:, None], "p": POSITION, "q": ROTATION.as_quat(), "v": 7 + POSITION}
    parts["w"] = ROTATION.as_quat(scalar_first=True)
    rows = np.concatenate([parts[part] for part in order], 1)
    np.savetxt(tmp_path / "a.csv", rows, delimiter=separator, header=header, comments="")
    check(read_wrist_path(tmp_path / "a.csv"))


def test_every_recorder_is_documented():
    page = pathlib.Path(__file__).parents[3] / "docs" / "grasp.md"
    text = page.read_text()
    for recorder in RECORDERS:
        assert recorder.name in text
        assert recorder.source.partition(",")[0] in text


def test_cells_may_be_empty_or_text_and_have_decimal_commas(tmp_path):
    def save(name, head, rows, mark=","):
        (tmp_path / name).write_text("\n".join([head, *(mark.join(map(str, row)) for row in rows)]))
        check(read_wrist_path(tmp_path / name))

    rows = np.c_[POSITION, ROTATION.as_quat()].tolist()
    save(
        "ros.csv",
        f"stamp,frame_id,note,{ROS},rest",
        [[i, "", '"a, b"', *row, ""] for i, row in enumerate(rows)],
    )
    with_commas = []
    for row in rows:
        with_commas.append([str(x).replace(".", ",") for x in row])
    save("dec.csv", ROS.replace(",", ";"), with_commas, ";")
    save("note.csv", f"note,{ROS}", [[f"a;b #{i}", *row] for i, row in enumerate(rows)])
    plain = np.c_[POSITION, ROTATION.as_quat(scalar_first=True)].tolist()
    save("end.csv", "# three words here", [[*r[:6], f"{r[6]} # a"] for r in plain])
    save("seven.csv", "# path of the right wrist in metres", plain)
    save("date.csv", "# recorded by Anna on the 12 May", plain, " ")
    save("units.csv", "# the length units are metres", plain)
    with pytest.raises(CongraspError, match="quaternions whose length is not one"):
        save("turned.csv", "# rotation first", [row[3:] + row[:3] for row in rows])


@pytest.mark.parametrize(
    ("header", "complaint"),
    [
        ("vx,vy,vz,qx,qy,qz,qw", "1 of .* is a header"),
        ("x_mm,y_mm,z_mm,qx,qy,qz,qw", "1 of .* is a header"),
        ("wrist_x,wrist_y,wrist_z,wrist_qx,wrist_qy,wrist_qz,wrist_qw", "1 of .* is a header"),
        ("lx,ly,lz,lqw,lqx,lqy,lqz,rx,ry,rz,rqw,rqx,rqy,rqz", "1 of .* is a header"),
        ("X,Y,Z,W,X,Y,Z", "1 of .* is a header"),
        ("a title\n" + HEADER, "1 of .* is a header"),
        ("# vx,vy,vz,qw,qx,qy,qz", "2 of .* follows a header"),
        ("# in mm\n# px,py,pz,qw,qx,qy,qz", "3 of .* follows a header"),
    ],
)
def test_header_of_no_recorder_is_refused(tmp_path, header, complaint):
    (tmp_path / "a.csv").write_text(f"{header}\n0,0,0,1,0,0,0\n")
    expected = (
        rf"line {complaint} of no known recorder\. Name the columns {HEADER} \(positions in m"
    )
    with pytest.raises(CongraspError, match=expected):
        read_wrist_path(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("header", "complaint"),
    [
        (f"tx,ty,tz,{HEADER}", "names the columns of congrasp and TUM RGB-D"),
        (f"x,{HEADER}", "names the column x twice"),
        (f"{HEADER},QW", "names the column qw twice"),
    ],
)
def test_ambiguous_header_is_refused(tmp_path, header, complaint):
    (tmp_path / "a.csv").write_text(f"{header}\n0,0,0,1,0,0,0\n")
    with pytest.raises(
        CongraspError, match=rf"line 1 of .*{complaint}\. Name the columns {HEADER}"
    ):
        read_wrist_path(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (
            "0,0,0,nan,nan,nan,nan\n0,0,0,1,0,0,0",
            "line 1 of .* has 'nan' in column 4, which is not a finite",
        ),
        ("0,1e10,0,1,0,0,0", "line 1 of .* has '1e10' in column 2"),
        ("1,2,3,,x,y,z\n0,0,0,1,0,0,0", "line 1 of .* has '' in column 4"),
        ("0.1 0 0 0 1 0 0 0", "line 1 of .* has 8 cells instead of 7"),
        (f"{ROS}\nm,m,m,,,,\n0,0,0,0,0,0,1", "line 2 of .* has 'm' in column 1"),
        (f"note,{ROS}\n{'a' * 200_000},0,0,0,0,0,0,1", "line 2 of .* cannot be read: field larger"),
        (
            "Format Version,1.23,Length Units,Millimeters\nX,Y,Z,W,X,Y,Z\n0,0,0,1,0,0,0",
            "line 1 of .*export z up",
        ),
        (
            f"t,{ROS}\n0.0,0,0,0,0,0,0,1\n0.1,0,0,1,0,0,0,1\n0.1,0,0,2,0,0,0,1\n0,0,0,3,0,0,0,1",
            "line 5 .*earlier",
        ),
        (
            f"{_ros('field.pose', '%time')}\n2,0,0,0,0,0,0,1\n1,0,0,1,0,0,0,1",
            "line 3 of .* is earlier .*Sort the lines",
        ),
        ('"",""\n0,0,0,1,0,0,0', "line 1 of .* is a header of no known recorder"),
        ("# a\n#\n", "has no numbers"),
    ],
)
def test_lines_that_could_be_misread_are_refused(tmp_path, text, complaint):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(CongraspError, match=complaint):
        read_wrist_path(tmp_path / "a.csv")


def _timed(path, times):
    path.write_text("\n".join([f"t,{ROS}", *(f"{t},0,0,0,0,0,0,1" for t in times)]))
    return path


@pytest.mark.parametrize("times", [("5.000003", "5", "5.01"), ("", "5", "6"), ("nan", "inf", "6")])
def test_a_clock_may_have_gaps_and_jitter(tmp_path, times):
    assert len(read_wrist_path(_timed(tmp_path / "a.csv", times)).position) == 3


@pytest.mark.parametrize(
    "times",
    [
        ("0", "1", "0", "1", "2000"),
        ("0", "1", "0.5", "1000"),
        ("0", "1732731489", "1732731488", "1732731487"),
        ("0", "inf", "2", "1"),
    ],
)
def test_a_clock_that_runs_back_is_refused_however_long_the_file_is(tmp_path, times):
    with pytest.raises(CongraspError, match="is earlier than a line above"):
        read_wrist_path(_timed(tmp_path / "a.csv", times))


def test_another_wrist_frame_is_converted(tmp_path):
    # Fingers towards +x and the back of the hand +y: the thumb of a right hand then points to -z.
    frame = Rotation.from_matrix(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]]))
    quaternion = (ROTATION * frame.inv()).as_quat(scalar_first=True)
    np.savez(tmp_path / "a.npz", position=POSITION, quaternion=quaternion)
    check(read_wrist_path(tmp_path / "a.npz", fingers="+x", back="+y"))


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("Xrotation", "Xscale", "it has the channel Xscale"),
        ("CHANNELS 6", "CHANNELS 999", "it was cut"),
    ],
)
def test_a_skeleton_that_could_be_misread_is_refused(tmp_path, old, new, complaint):
    file = bvh(tmp_path / "motion.bvh")
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(CongraspError, match=rf"cannot be read as BVH: {complaint}"):
        read_bvh(file, "Hand")


def test_a_joint_without_channels_moves_with_its_parents(tmp_path):
    file = bvh(tmp_path / "motion.bvh")
    file.write_text(
        file.read_text().replace("    JOINT Hand", "JOINT Held\n{\nOFFSET 1 0 0\n}\nJOINT Hand")
    )
    np.testing.assert_allclose(
        read_bvh(file, "Held")[1].as_matrix(), read_bvh(file, "Arm")[1].as_matrix()
    )


def test_unreadable_files_are_errors(tmp_path):
    file = bvh(tmp_path / "motion.bvh")
    for joint in ("RightHand", "Site"):
        with pytest.raises(CongraspError, match=f"no joint '{joint}'"):
            read_wrist_path(file, joint=joint)
    file.write_text(file.read_text()[:-200])
    with pytest.raises(CongraspError, match="cannot be read as BVH"):
        read_bvh(file, "Hand")
    with pytest.raises(CongraspError, match="There is no file"):
        read_wrist_path(tmp_path / "absent.bvh")
    (tmp_path / "a.fbx").write_text("")
    with pytest.raises(CongraspError, match="not a CSV, NPZ or BVH file"):
        read_wrist_path(tmp_path / "a.fbx")
    np.savez(tmp_path / "a.npz", position=POSITION, quaternion=2 * ROTATION.as_quat())
    with pytest.raises(CongraspError, match="length is not one"):
        read_wrist_path(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", position=POSITION)
    with pytest.raises(CongraspError, match="needs 'position' and 'quaternion'"):
        read_wrist_path(tmp_path / "b.npz")
    with pytest.raises(CongraspError, match="not perpendicular"):
        np.savez(tmp_path / "c.npz", position=POSITION, quaternion=ROTATION.as_quat())
        read_wrist_path(tmp_path / "c.npz", fingers="+x", back="-x")
