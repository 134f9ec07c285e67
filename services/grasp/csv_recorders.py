"""Headers of CSV files with the path of a wrist: that of this project, and those of recorders."""

from collections.abc import Sequence
from typing import NamedTuple

HEADER = "x,y,z,qw,qx,qy,qz"
"""Header that a message asks for."""
_ROSTOPIC = "http://wiki.ros.org/rostopic, section rostopic echo -p"
_BAGPY = "https://jmscslgroup.github.io/bagpy, bagreader.message_by_topic"


class Recorder(NamedTuple):
    """Program whose files are read, and the names of its columns in lower case."""

    name: str
    position: tuple[str, str, str]
    """x, y, z in m."""
    quaternion: tuple[str, str, str, str]
    """w, x, y, z."""
    times: tuple[str, ...]
    """Names that a column of the time may have, which is checked and not used."""
    source: str
    """Source of the header."""


def _ros(name: str, pose: str, time: str, source: str) -> Recorder:
    """A program that names columns by the fields of a ROS message with a pose."""
    x, y, z = [f"{pose}.position.{axis}" for axis in "xyz"]
    qw, qx, qy, qz = [f"{pose}.orientation.{axis}" for axis in "wxyz"]
    return Recorder(name, (x, y, z), (qw, qx, qy, qz), (time,), source)


RECORDERS = (
    Recorder(
        "congrasp",
        ("x", "y", "z"),
        ("qw", "qx", "qy", "qz"),
        ("t", "time", "timestamp"),
        "the header of this project",
    ),
    Recorder(
        "TUM RGB-D",
        ("tx", "ty", "tz"),
        ("qw", "qx", "qy", "qz"),
        ("timestamp",),
        "https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats, also of evo and SLAM "
        "programs",
    ),
    Recorder(
        "EuRoC",
        ("p_rs_r_x [m]", "p_rs_r_y [m]", "p_rs_r_z [m]"),
        ("q_rs_w []", "q_rs_x []", "q_rs_y []", "q_rs_z []"),
        ("timestamp", "timestamp [ns]"),
        "https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets, "
        "state_groundtruth_estimate0/data.csv",
    ),
    _ros("rostopic, PoseStamped", "field.pose", "%time", _ROSTOPIC),
    _ros("rostopic, Odometry", "field.pose.pose", "%time", _ROSTOPIC),
    _ros("bagpy, PoseStamped", "pose", "time", _BAGPY),
    _ros("bagpy, Odometry", "pose.pose", "time", _BAGPY),
)


class Columns(NamedTuple):
    """Columns of a file."""

    pose: list[int]
    """Columns of x, y, z and the quaternion w, x, y, z."""
    time: int | None
    """Column of the time; None without one."""
    width: int
    """Number of columns of the file."""


PLAIN = Columns(pose=list(range(7)), time=None, width=7)
"""Columns of a file without a header."""


def columns_of(names: Sequence[str]) -> Columns | None:
    """Returns the columns that a header names; None if it is of no known recorder.

    Args:
      names: names of all columns, in any case.

    Raises:
      ValueError: it is the header of several recorders, or names a column of the pose twice.
    """
    lower_names = [name.lower() for name in names]
    recorders = []
    for recorder in RECORDERS:
        if {*recorder.position, *recorder.quaternion} <= set(lower_names):
            recorders.append(recorder)
    if not recorders:
        return None
    if len(recorders) > 1:
        programs = " and ".join(recorder.name for recorder in recorders)
        raise ValueError(f"names the columns of {programs}")
    (recorder,) = recorders
    pose_names = [*recorder.position, *recorder.quaternion]
    for name in pose_names:
        if lower_names.count(name) > 1:
            raise ValueError(f"names the column {name} twice")
    time = None
    for name in recorder.times:
        if time is None and name in lower_names:
            time = lower_names.index(name)
    pose = [lower_names.index(name) for name in pose_names]
    return Columns(pose, time, len(names))
