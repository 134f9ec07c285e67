"""Wrist paths from CSV, NPZ and BVH, each written with the same path."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.services.grasp.bvh import read_bvh
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
    np.savetxt(tmp_path / "c.csv", rows, delimiter=",", header="x,y,z,w,x,y,z", comments="")
    rows = np.c_[T, POSITION, ROTATION.as_quat()]
    header = "t,pose.x,pose.y,pose.z,orientation.x,orientation.y,orientation.z,orientation.w"
    np.savetxt(tmp_path / "d.csv", rows, delimiter=",", header=header, comments="")
    for name in ("a.npz", "b.npz", "c.csv", "d.csv"):
        check(read_wrist_path(tmp_path / name))


@pytest.mark.parametrize(
    ("header", "order", "separator"),
    [
        ("# " + ROS, "pq", ","),
        ("# ground truth of a wrist\n# timestamp tx ty tz qx qy qz qw", "tpq", " "),
        ('"time","Pos X","Pos Y","Pos Z","Quat X","Quat Y","Quat Z","Quat W"', "tpq", ","),
        ("Pos X;Pos Y;Pos Z;Quat X;Quat Y;Quat Z;Quat W;", "pq", ";"),
        ("x [m] y [m] z [m] qx qy qz qw", "pq", " "),
        ("t\tx (m)\ty (m)\tz (m)\tqx\tqy\tqz\tqw", "tpq", "\t"),
        (f",{ROS}", "tpq", ","),
        ("t_x,t_y,t_z,q_x,q_y,q_z,q_w", "pq", ","),
        (ROS + ",vx,vy,vz", "pqp", ","),
        ("a title of the file\n" + ROS, "pq", ","),
        ("px,py,pz,vx,vy,vz,qx,qy,qz,qw", "pvq", ","),
        ("p_x,p_y,p_z,p_v_x,p_v_y,p_v_z,qx,qy,qz,qw", "pvq", ","),
        ("p_BW_W_x,p_BW_W_y,p_BW_W_z,p_BW_v_x,p_BW_v_y,p_BW_v_z,qx,qy,qz,qw", "pvq", ","),
        ("t,qx,qy,qz,qw,wx,wy,wz,px,py,pz", "tqvp", ","),
        (
            "twist.linear.x,twist.linear.y,twist.linear.z,pose.position.x,pose.position.y,pose.position.z,"
            "pose.orientation.x,pose.orientation.y,pose.orientation.z,pose.orientation.w",
            "vpq",
            ",",
        ),
        (
            "wrist_x,wrist_y,wrist_z,acc_x,acc_y,acc_z,wrist_rot_x,wrist_rot_y,wrist_rot_z,wrist_rot_w",
            "pvq",
            ",",
        ),
        ("x_mm,y_mm,z_mm,qx,qy,qz,qw", "mq", ","),
        (
            "wrist_x,wrist_y,wrist_z,wrist_qx,wrist_qy,wrist_qz,wrist_qw,target_pos_x,target_pos_y,target_pos_z",
            "pqv",
            ",",
        ),
        (
            "targetPosX,targetPosY,targetPosZ,wristPosX,wristPosY,wristPosZ,wristQX,wristQY,wristQZ,wristQW",
            "vpq",
            ",",
        ),
        (",".join(f"end_effector_{name}" for name in ROS.split(",")), "pq", ","),
        (",".join(f"torso_{name}" for name in ROS.split(",")), "pq", ","),
        ("title,of,the,file,and,its,cells,written\n" + ROS, "pq", ","),
        (ROS, "pq", " "),
        (
            "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_x [], q_RS_y [], "
            "q_RS_z [], q_RS_w [], "
            "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], "
            "b_w_RS_S_y [rad s^-1], "
            "b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]",
            "tpqvvv",
            ",",
        ),
        ("Pos X [cm],Pos Y [cm],Pos Z [cm],QX [-],QY [-],QZ [-],QW [-]", "cq", ","),
    ],
)
def test_a_header_places_the_columns(tmp_path, header, order, separator):
    parts = {"t": T[:, None], "p": POSITION, "q": ROTATION.as_quat(), "v": 7 + POSITION}
    parts |= {"m": 1000 * POSITION, "c": 100 * POSITION}
    rows = np.concatenate([parts[part] for part in order], 1)
    np.savetxt(tmp_path / "a.csv", rows, delimiter=separator, header=header, comments="")
    check(read_wrist_path(tmp_path / "a.csv"))


def test_cells_may_be_empty_or_text_and_have_decimal_commas(tmp_path):
    def save(name, head, rows, mark=","):
        (tmp_path / name).write_text("\n".join([head, *(mark.join(map(str, row)) for row in rows)]))
        check(read_wrist_path(tmp_path / name))

    rows = np.c_[POSITION, ROTATION.as_quat()].tolist()
    save(
        "ros.csv",
        f"stamp,frame_id,note,{ROS}",
        [[i, "", '"a, b"', *row] for i, row in enumerate(rows)],
    )
    with_commas = []
    for row in rows:
        with_commas.append([str(x).replace(".", ",") for x in row])
    save("dec.csv", ROS.replace(",", ";"), with_commas, ";")
    save("note.csv", f"note,{ROS}", [[f"a;b #{i}", *row] for i, row in enumerate(rows)])
    with pytest.raises(CongraspError, match="quaternions whose length is not one"):
        save("turned.csv", "X,Y,Z,W,X,Y,Z", [row[3:] + row[:3] for row in rows])


@pytest.mark.parametrize(
    ("header", "complaint"),
    [
        ("vx,vy,vz,qx,qy,qz,qw", "no position"),
        ("p_v_x,p_v_y,p_v_z,qx,qy,qz,qw", "no position"),
        (
            "x [m map],y [m map],z [m map],goal_x,goal_y,goal_z,qx,qy,qz,qw",
            "several positions: x, y, z, goal",
        ),
        ("x,y,z,q1,q2,q3,q4", "no quaternion"),
        ("#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]", "no quaternion"),
        ("x,y,z,roll,pitch,yaw,grip", "no quaternion"),
        ("px,py,pz,elbow.px,elbow.py,elbow.pz,qx,qy,qz,qw", "several positions: p, elbow p"),
        ("x_mm,y_mm,z_m,qx,qy,qz,qw", "positions in m and mm, not all in one of m, cm, mm, in"),
        (
            "target_x,target_y,target_z,wrist_qw,wrist_qx,wrist_qy,wrist_qz",
            "the position of 'target', but the quat.*'wrist'",
        ),
        (
            "wrist_pos_x,wrist_pos_y,wrist_pos_z,wrist_tip_x,wrist_tip_y,wrist_tip_z,wrist_qw,wrist_qx,wrist_qy,wrist_qz",
            "several positions: wrist pos, wrist tip",
        ),
        ("lx,ly,lz,lqw,lqx,lqy,lqz,rx,ry,rz,rqw,rqx,rqy,rqz", "several quaternions"),
        ("# lx ly lz lqx lqy lqz lqw rx ry rz rqx rqy rqz rqw", "several quaternions"),
    ],
)
def test_a_header_without_one_position_and_one_quaternion_is_refused(tmp_path, header, complaint):
    (tmp_path / "a.csv").write_text(f"{header}\n0,0,0,1,0,0,0\n")
    with pytest.raises(
        CongraspError, match=rf"line 1 of .*a\.csv names {complaint}.*\. Name them x, y, z, qw"
    ):
        read_wrist_path(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("0,0,0,nan,nan,nan,nan\n0,0,0,1,0,0,0", "line 1 of .* is not 7 finite numbers"),
        ("1,2,3,,x,y,z\n0,0,0,1,0,0,0", "line 1 of .* is not 7 finite numbers"),
        (f"{ROS}\nm,m,m,,,,\n0,0,0,0,0,0,1", "line 2 of .* is not 7 finite numbers"),
        (f"note,{ROS}\n{'a' * 200_000},0,0,0,0,0,0,1", "line 2 of .* cannot be read: field larger"),
        (
            "Format Version,1.23,Length Units,Millimeters\nX,Y,Z,W,X,Y,Z\n0,0,0,1,0,0,0",
            "line 1 of .*export z up",
        ),
        (
            "Rotation,,,,Position,,\nX,Y,Z,W,X,Y,Z\n0,0,0,1,0,0,0",
            "line 2 of .* names columns twice below another",
        ),
        (
            f"t,{ROS}\n0.0,0,0,0,0,0,0,1\n0.1,0,0,1,0,0,0,1\n0.1,0,0,2,0,0,0,1\n0,0,0,3,0,0,0,1",
            "line 5 .*earlier",
        ),
        *(
            (f"{clock},{ROS}\n2,0,0,0,0,0,0,1\n1,0,0,1,0,0,0,1", "line 3 .*earlier")
            for clock in (
                "Time (s)",
                "%time",
                "timestamp_ns",
                "timeStamp",
                "t_ms",
                "seconds",
                "stamp.sec",
            )
        ),
        (f"stamp_sec,stamp_ns,{ROS}\n7,5,0,0,0,0,0,0,1\n7,4,0,0,0,0,0,0,1", "line 3 .*earlier"),
        (
            f"header.stamp.secs,{ROS}\n-1,0,0,0,0,0,0,1\n-2,0,0,1,0,0,0,1",
            "line 3 of .* is earlier .*Sort the lines",
        ),
        ("a" + "[ " * 300 + "_" * 40_000 + "\n", "has no numbers"),
    ],
)
def test_lines_that_could_be_misread_are_refused(tmp_path, text, complaint):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(CongraspError, match=complaint):
        read_wrist_path(tmp_path / "a.csv")


@pytest.mark.parametrize(
    "name",
    (
        *(
            "delta_time",
            "deltaTime",
            "frame_time",
            "exposure_time",
            "latency_seconds",
            "time_offset",
        ),
        *("time_to_contact", "time_left", "header.stamp.nanosec"),
    ),
)
def test_a_column_that_may_fall_is_no_clock(tmp_path, name):
    # The last is jitter
    lines = [f"{9 - i},{t},0,0,0,0,0,0,1" for i, t in enumerate((0.0, 1.0, 0.9995))]
    (tmp_path / "a.csv").write_text("\n".join([f"{name},header.stamp.sec,{ROS}", *lines]))
    assert len(read_wrist_path(tmp_path / "a.csv").position) == 3


@pytest.mark.parametrize(
    ("clock", "times"),
    [
        ("stamp_ns,stamp_sec", ("900000000,7", "0,8", "100000000,8")),
        ("stamp.sec,stamp.nanosec", ("7,999999000", "8,0", "8,900000000")),
        ("t", ("5.000003", "5", "5.01")),
        ("t", ("", "5", "6")),
        ("t", ("nan", "inf", "6")),
        ("sec,s", ("7,3", "8,1", "9,0")),  # an arc's length, say
        ("seconds,ns", ("7,3", "8,1", "9,0")),
        ("time_s,time_ns", ("7.9,7900000000", "8.0,8000000000", "8.1,8100000000")),
        ("sec,nanosec,stamp_sec,stamp_ns", ("7,0,9,0", "8,0,9,0", "9,0,3,0")),
    ],
)
def test_a_clock_has_one_or_two_columns_and_jitter_from_its_first_line_on(tmp_path, clock, times):
    (tmp_path / "a.csv").write_text(
        "\n".join([f"{clock},{ROS}", *(f"{t},0,0,0,0,0,0,1" for t in times)])
    )
    assert len(read_wrist_path(tmp_path / "a.csv").position) == 3


@pytest.mark.parametrize(
    ("clock", "times"),
    [
        ("t", ("0", "1", "0", "1", "2000")),
        ("t", ("0", "1", "0.5", "1000")),
        ("t", ("0", "1732731489", "1732731488", "1732731487")),
        ("t", ("0", "inf", "2", "1")),
        ("stamp_sec,stamp_ns", ("7,0", "7,500000000", "7,100000000")),
        ("stamp_ns,stamp_sec", ("0,7", "500000000,7", "100000000,7")),
    ],
)
def test_a_clock_that_runs_back_is_refused_however_long_the_file_is(tmp_path, clock, times):
    (tmp_path / "a.csv").write_text(
        "\n".join([f"{clock},{ROS}", *(f"{t},0,0,0,0,0,0,1" for t in times)])
    )
    with pytest.raises(CongraspError, match="is earlier than a line above"):
        read_wrist_path(tmp_path / "a.csv")


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
