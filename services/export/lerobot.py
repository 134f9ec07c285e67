"""A LeRobot dataset, version 3.0: one episode per motion.

`observation.state` is the proprioception (joints of arm and fingers, then the wrist's pose),
`observation.environment_state` the object's pose, `action` the arm's joints one step later, the
finger targets, and the wrist's pose one step later. The hand is in `meta/hand.urdf`, with an arm
the whole robot in `meta/robot.urdf`. With a camera there is `observation.images.front` too: one MP4
for all episodes, a frame for every row.
"""

import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from congrasp.common.episode.arm import MovedArm
from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.services.export.facts import facts
from congrasp.services.export.film import SIZE, Film, film
from congrasp.services.export.joint_trajectory import robot_joints
from congrasp.services.export.urdf import robot_urdf

VERSION = "v3.0"
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_PLACE = {"chunk_index": 0, "file_index": 0}
"""Numbers of the chunk and file of every table and video: there is one of each."""
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_COUNTERS = {
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_RATE_TOLERANCE = 1e-6
"""Relative deviation from an integer frame rate that is due to rounding."""
_STATE = "observation.state"
_OBJECT = "observation.environment_state"
_ACTION = "action"
_CAMERA = "observation.images.front"
_PANDAS_COLUMNS = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
"""Columns of the table of tasks: name, and types in pandas and in NumPy."""


class _Dataset(NamedTuple):
    """Motions as episodes of a dataset."""

    motions: Sequence[Episode]
    fps: int
    """Frames a second."""
    tasks: list[str]
    """Different tasks, as sentences."""
    starts: list[int]
    """Number of rows before each episode, and of all rows."""

    @property
    def rows(self) -> int:
        """Number of rows of all episodes."""
        return self.starts[-1]


def write(path: pathlib.Path, motions: Sequence[Episode], *, camera: bool = False) -> None:
    """Writes motions of one robot and one control step as a dataset.

    Args:
      path: the folder to write.
      motions: the motions.
      camera: also writes a camera's video.

    Raises:
      CongraspError: the motions differ in robot or control step, or one second is not a whole
        number of control steps.
    """
    dataset = _dataset(motions)
    columns_of_episodes = [_columns(dataset, episode) for episode in range(len(motions))]
    columns = {}
    for name in columns_of_episodes[0]:
        columns[name] = np.concatenate([episode[name] for episode in columns_of_episodes])
    stats = {name: _statistics(values) for name, values in columns.items()}
    info = _info(dataset)
    json_files = {"congrasp": _about(motions), "stats": stats, "info": info}
    video = None
    if camera:
        file = path / _VIDEO.format(video_key=_CAMERA, **_PLACE)
        video = film(file, motions, dataset.fps)
        json_files["camera"] = video.calibration
        stats[_CAMERA] = _statistics_of_pixels(np.concatenate(video.pixels), dataset.rows)
        info["video_path"] = _VIDEO
        info["features"][_CAMERA] = _video_feature(dataset.fps)
    rows = []
    for episode, episode_columns in enumerate(columns_of_episodes):
        rows.append(_episode_row(dataset, episode, episode_columns, video))
    data = pa.table({name: _column(values) for name, values in columns.items()})
    meta = path / "meta"
    _write_parquet(path / "data" / _FILE.format(**_PLACE), data)
    _write_parquet(meta / "episodes" / _FILE.format(**_PLACE), pa.Table.from_pylist(rows))
    _write_parquet(meta / "tasks.parquet", _tasks_table(dataset.tasks))
    urdf = "robot.urdf" if motions[0].arm else "hand.urdf"
    (meta / urdf).write_text(robot_urdf(motions[0]), encoding="utf-8")
    for name, content in json_files.items():
        (meta / f"{name}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")


def _dataset(motions: Sequence[Episode]) -> _Dataset:
    """Returns the dataset of motions of one robot.

    Raises:
      CongraspError: see `write`.
    """
    fps = _frame_rate(motions[0])
    _check_same_robot(motions)
    tasks = [_task(motion) for motion in motions]
    starts = [0]
    for motion in motions:
        starts.append(starts[-1] + len(motion.time))
    return _Dataset(motions, fps, tasks=list(dict.fromkeys(tasks)), starts=starts)


def _episode_row(
    dataset: _Dataset, episode: int, columns: Mapping[str, np.ndarray], video: Film | None
) -> dict[str, Any]:
    """Row of an episode in the table of episodes.

    Args:
      dataset: the dataset.
      episode: index of the episode.
      columns: the episode's columns.
      video: the dataset's video, if it has one.
    """
    start, end = dataset.starts[episode : episode + 2]
    tasks = [_task(dataset.motions[episode])]
    row: dict[str, Any] = {"episode_index": episode, "tasks": tasks, "length": end - start}
    row |= _prefixed("data", _PLACE)
    row |= {"dataset_from_index": start, "dataset_to_index": end}
    for name, values in columns.items():
        row |= _prefixed(f"stats/{name}", _statistics(values))
    if video is not None:
        section = {
            **_PLACE,
            "from_timestamp": start / dataset.fps,
            "to_timestamp": end / dataset.fps,
        }
        row |= _prefixed(f"videos/{_CAMERA}", section)
        stats = _statistics_of_pixels(video.pixels[episode], end - start)
        row |= _prefixed(f"stats/{_CAMERA}", stats)
    row |= _prefixed("meta/episodes", _PLACE)
    return row


def _frame_rate(motion: Episode) -> int:
    """Frames per second of a motion; raises a CongraspError if it is not an integer."""
    dt = motion.control_dt
    fps = round(1 / dt)
    if abs(fps * dt - 1) > _RATE_TOLERANCE:
        raise CongraspError(
            f"A control step of {dt} s does not give an integer number of frames per second.",
            "LeRobot stores integer frame rates alone: export another format.",
        )
    return fps


def _check_same_robot(motions: Sequence[Episode]) -> None:
    """Raises a CongraspError if the motions differ in robot or control step."""
    robot = _robot(motions[0])
    if any(_robot(motion) != robot for motion in motions):
        raise CongraspError(
            "A dataset has one robot and one control step, but the motions differ.",
            "Export the motions of each robot and control step as a separate dataset.",
        )


def _prefixed(prefix: str, entries: Mapping[str, Any]) -> dict[str, Any]:
    """Entries with their names below a prefix."""
    return {f"{prefix}/{name}": value for name, value in entries.items()}


def _about(motions: Sequence[Episode]) -> dict[str, Any]:
    """Meaning of the dataset's numbers, and origin of its motions."""
    about = facts(
        motions[0],
        frame="world: z up, table's top at z = 0",
        unit="m, rad, s",
        quaternion="qw, qx, qy, qz",
    )
    del about["object"]
    del about["constraints"]
    about["objects"] = [motion.object for motion in motions]
    about["success"] = [motion.success for motion in motions]
    arms = [motion.arm for motion in motions if motion.arm]
    if arms:
        about["arm_base"] = [_base_pose(arm) for arm in arms]
    about["action"] = (
        "finger targets of the joints' position servos; arm's joints and wrist's pose one step "
        "later"
    )
    return about


def _base_pose(arm: MovedArm) -> list[float]:
    """Position (m) and quaternion of an arm's base in the world."""
    return [*arm.link_position[0, 0].tolist(), *arm.link_quaternion[0, 0].tolist()]


def _video_feature(fps: int) -> dict[str, Any]:
    """Description of the camera as a feature."""
    width, height = SIZE
    info = {
        "video.height": height,
        "video.width": width,
        "video.channels": 3,
        "video.codec": "h264",
        "video.pix_fmt": "yuv420p",
        "video.fps": fps,
        "video.is_depth_map": False,
        "has_audio": False,
    }
    return {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": info,
    }


def _task(motion: Episode) -> str:
    """A motion's task as a sentence."""
    return f"Grasp the object {motion.object} under {' and '.join(motion.constraints)}."


def _robot(motion: Episode) -> tuple[Any, ...]:
    """Hand, control step, arm and mount of the hand, which are the same in one dataset."""
    identity = (motion.hand, motion.control_dt)
    arm = motion.arm
    if arm is None:
        return identity
    return (*identity, arm.name, *arm.joint_names, *arm.hand_position, *arm.hand_quaternion)


def _columns(dataset: _Dataset, episode: int) -> dict[str, np.ndarray]:
    """Columns (T, ...) of an episode, by name."""
    motion = dataset.motions[episode]
    count = len(motion.time)
    arm = np.zeros((count, 0))
    if motion.arm:
        arm = motion.arm.joint_position
    wrist = np.concatenate([motion.wrist_position, motion.wrist_quaternion], 1)
    next_row = np.minimum(np.arange(count) + 1, count - 1)
    state = np.concatenate([arm, motion.joint_position, wrist], 1)
    object_pose = np.concatenate([motion.object_position, motion.object_quaternion], 1)
    action = np.concatenate([arm[next_row], motion.joint_target, wrist[next_row]], 1)
    return {
        _STATE: state.astype(np.float32),
        _OBJECT: object_pose.astype(np.float32),
        _ACTION: action.astype(np.float32),
        "timestamp": motion.time.astype(np.float32),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, episode),
        "index": dataset.starts[episode] + np.arange(count),
        "task_index": np.full(count, dataset.tasks.index(_task(motion))),
    }


def _column(values: np.ndarray) -> pa.Array:
    """Values (T,) or (T, n) as a column of a table."""
    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def _tasks_table(tasks: Sequence[str]) -> pa.Table:
    """Tasks in pandas' format of a frame with one column and the tasks as its index, as LeRobot
    expects them.
    """
    columns = []
    for name, pandas_type, numpy_type in _PANDAS_COLUMNS:
        column = {
            "name": name,
            "field_name": name,
            "pandas_type": pandas_type,
            "numpy_type": numpy_type,
            "metadata": None,
        }
        columns.append(column)
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": columns,
        "pandas_version": "2.0.0",
    }
    numbers = pa.array(range(len(tasks)), pa.int64())
    table = pa.table({"task_index": numbers, "task": pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _statistics(values: np.ndarray) -> dict[str, list[Any]]:
    """Statistics of a column (T, ...), by their names in the format."""
    columns = values.reshape(len(values), -1).astype(float)
    statistics: dict[str, list[Any]] = {
        "min": columns.min(0).tolist(),
        "max": columns.max(0).tolist(),
        "mean": columns.mean(0).tolist(),
        "std": columns.std(0).tolist(),
        "count": [len(columns)],
    }
    for name, share in _QUANTILES.items():
        statistics[name] = np.quantile(columns, share, axis=0).tolist()
    return statistics


def _statistics_of_pixels(pixels: np.ndarray, frames: int) -> dict[str, list[Any]]:
    """Statistics of each channel of some pixels (n, 3), in the format's shape (3, 1, 1).

    Args:
      pixels: the pixels.
      frames: number of the frames, which the format counts in place of pixels.
    """
    statistics = _statistics(pixels)
    for name, values in statistics.items():
        statistics[name] = [[[value]] for value in values]
    statistics["count"] = [frames]
    return statistics


def _write_parquet(path: pathlib.Path, table: pa.Table) -> None:
    """Writes a table; its folder is created if needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, compression="snappy")


def _info(dataset: _Dataset) -> dict[str, Any]:
    """Description of the dataset: features with their shapes and names, counts, paths of files."""
    motion = dataset.motions[0]
    episodes = len(dataset.motions)
    robot = f"congrasp_{motion.hand}"
    if motion.arm:
        robot = f"congrasp_{motion.arm.name}_{motion.hand}"
    return {
        "codebase_version": VERSION,
        "robot_type": robot,
        "total_episodes": episodes,
        "total_frames": dataset.rows,
        "total_tasks": len(dataset.tasks),
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": dataset.fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": f"data/{_FILE}",
        "video_path": None,
        "features": _features(motion),
    }


def _features(motion: Episode) -> dict[str, Any]:
    """Types, shapes and names of the columns of a motion."""
    joints = robot_joints(motion)
    fingers = joints[-len(motion.joint_names) :]
    arm = joints[: -len(fingers)]
    wrist = [f"wrist_{name}" for name in _POSE]
    names = {
        _STATE: [*joints, *wrist],
        _OBJECT: [f"object_{name}" for name in _POSE],
        _ACTION: [
            *(f"{name}_next" for name in arm),
            *(f"{name}_target" for name in fingers),
            *(f"{name}_next" for name in wrist),
        ],
    }
    features: dict[str, Any] = {}
    for column, numbers in names.items():
        features[column] = {"dtype": "float32", "shape": [len(numbers)], "names": numbers}
    for column, dtype in {"timestamp": "float32", **_COUNTERS}.items():
        features[column] = {"dtype": dtype, "shape": [1], "names": None}
    return features
