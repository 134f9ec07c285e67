"""A LeRobot dataset, version 3.0: one episode per motion; written with pyarrow, read back by the layout in its files.

`observation.state` is the proprioception (joints of arm and fingers, then the wrist's pose),
`observation.environment_state` the object's pose, `action` the arm's joints one step later, the finger targets, and the
wrist's pose one step later. The hand is in `meta/hand.urdf`, with an arm the whole robot in `meta/robot.urdf`. With a
camera there is `observation.images.front` too: one MP4 for all episodes, a frame for every row.
"""

import json
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.services.export.camera import SIZE, calibration, camera_for, pictures
from congrasp.services.export.frames import OBJECT, Track, facts, pose_matrices
from congrasp.services.export.motion_file import GraspMotion, robot_joints
from congrasp.services.export.urdf import forward_kinematics, robot_urdf
from congrasp.services.viz.scene import Camera
from congrasp.services.viz.sheets import save_video

VERSION = "v3.0"
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_PLACE = {"chunk_index": 0, "file_index": 0}
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_COUNTERS = {"frame_index": "int64", "episode_index": "int64", "index": "int64", "task_index": "int64"}
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_STATE, _OBJECT, _ACTION = "observation.state", "observation.environment_state", "action"
_CAMERA = "observation.images.front"
_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_KEYFRAMES = ("-g", "2")  # for random access in training
_COUNTED = 64  # pixels between those that the statistics count


def write(path: pathlib.Path, motions: Sequence[GraspMotion], *, camera: bool = False) -> None:
    """Writes motions of one hand and one control step as a dataset folder, optionally with a camera's video.

    Raises:
      CongraspError: the motions differ in robot or control step, or the control step is no whole number of frames a
        second.
    """
    first = motions[0]
    fps = round(1 / first.control_dt)
    if abs(fps * first.control_dt - 1) > 1e-6:
        raise CongraspError(f"A control step of {first.control_dt} s makes no whole number of frames a second.")
    for motion in motions:
        if _robot(motion) != _robot(first):
            raise CongraspError(
                "A dataset has one robot and one control step, but the motions differ.", "Export each set."
            )
    tasks = list(dict.fromkeys(_task(motion) for motion in motions))
    episodes = [_columns(motion, i, tasks) for i, motion in enumerate(motions)]
    lengths = [len(motion.time) for motion in motions]
    starts = np.cumsum([0, *lengths])
    for columns, start, length in zip(episodes, starts, lengths, strict=False):
        columns["index"] = start + np.arange(length)
    every = {name: np.concatenate([columns[name] for columns in episodes]) for name in episodes[0]}
    seen = _film(path, motions, fps) if camera else None
    rows: list[dict[str, Any]] = []
    for i, columns in enumerate(episodes):
        own = {f"stats/{name}/{key}": value for name, c in columns.items() for key, value in _statistics(c).items()}
        rows.append(
            {
                "episode_index": i,
                "tasks": [_task(motions[i])],
                "length": lengths[i],
                "data/chunk_index": 0,
                "data/file_index": 0,
                "dataset_from_index": int(starts[i]),
                "dataset_to_index": int(starts[i + 1]),
                **own,
                **(_filmed(seen.pixels[i], lengths[i], starts[i : i + 2] / fps) if seen else {}),
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
    _write_parquet(path / "data" / _FILE.format(**_PLACE), pa.table({n: _column(v) for n, v in every.items()}))
    _write_parquet(path / "meta" / "episodes" / _FILE.format(**_PLACE), pa.Table.from_pylist(rows))
    _write_parquet(path / "meta" / "tasks.parquet", _tasks_table(tasks))
    about = {
        **facts(first, frame="world: z up, table's top at z = 0", unit="m, rad, s", quaternion="qw, qx, qy, qz"),
        "objects": [motion.object for motion in motions],
        "success": [motion.success for motion in motions],
        **({"arm_base": [_base(motion) for motion in motions]} if first.arm else {}),
        "action": "finger targets of the joints' position servos; arm's joints and wrist's pose one step later",
    }
    del about["object"], about["constraints"]
    meta = path / "meta"
    (meta / ("robot.urdf" if first.arm else "hand.urdf")).write_text(robot_urdf(first))
    (meta / "congrasp.json").write_text(json.dumps(about, indent=1))
    stats: dict[str, Any] = {name: _statistics(values) for name, values in every.items()}
    info = _info(first, len(motions), int(starts[-1]), len(tasks), fps)
    if seen:
        stats[_CAMERA] = _image_statistics(np.concatenate(seen.pixels), int(starts[-1]))
        info["video_path"], info["features"][_CAMERA] = _VIDEO, _video_feature(fps)
        (meta / "camera.json").write_text(json.dumps(calibration(seen.camera), indent=1))
    (meta / "stats.json").write_text(json.dumps(stats, indent=1))
    (meta / "info.json").write_text(json.dumps(info, indent=1))


class _Film(NamedTuple):
    """Recording of a camera."""

    camera: Camera
    pixels: list[np.ndarray]
    """(n, 3) from 0 to 1 of each episode: some pixels of every frame."""


def _film(path: pathlib.Path, motions: Sequence[GraspMotion], fps: int) -> _Film:
    """Writes the video of all motions in sequence, from a camera that shows all of them."""
    camera, pixels = camera_for(motions), list[np.ndarray]()

    def frames() -> Iterator[np.ndarray]:
        """Yields every frame, and counts its pixels."""
        for motion in motions:
            counted = []
            for picture in pictures(motion, camera):
                counted.append(picture.reshape(-1, 3)[::_COUNTED] / 255)
                yield picture
            pixels.append(np.concatenate(counted))

    save_video(path / _VIDEO.format(video_key=_CAMERA, **_PLACE), frames(), SIZE, fps, _KEYFRAMES)
    return _Film(camera, pixels)


def _filmed(pixels: np.ndarray, frames: int, seconds: np.ndarray) -> dict[str, Any]:
    """Entries of an episode's row for its part of the video, between two times (2,), s."""
    begin, end = seconds.tolist()
    place = {**_PLACE, "from_timestamp": begin, "to_timestamp": end}
    statistics = _image_statistics(pixels, frames)
    return {
        **{f"videos/{_CAMERA}/{name}": value for name, value in place.items()},
        **{f"stats/{_CAMERA}/{name}": value for name, value in statistics.items()},
    }


def _image_statistics(pixels: np.ndarray, frames: int) -> dict[str, Any]:
    """Statistics of pixels (n, 3), of shape (3, 1, 1) each; the count is that of frames."""
    found = {name: np.reshape(values, (-1, 1, 1)).tolist() for name, values in _statistics(pixels).items()}
    return found | {"count": [frames]}


def _video_feature(fps: int) -> dict[str, Any]:
    """Description of the camera as a feature."""
    width, height = SIZE
    about = {"height": height, "width": width, "channels": 3, "codec": "h264", "pix_fmt": "yuv420p", "fps": fps}
    about |= {"is_depth_map": False}
    info = {**{f"video.{name}": value for name, value in about.items()}, "has_audio": False}
    return {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": info}


def _task(motion: GraspMotion) -> str:
    """A motion's task as a sentence."""
    return f"Grasp the object {motion.object} under {' and '.join(motion.constraints)}."


def _robot(motion: GraspMotion) -> tuple[Any, ...]:
    """Identity of the hand, the arm, and the control step."""
    arm = motion.arm
    return (
        motion.hand,
        motion.control_dt,
        arm and (arm.name, *arm.joint_names, *arm.hand_position, *arm.hand_quaternion),
    )


def _base(motion: GraspMotion) -> list[float]:
    """Position and quaternion (7,) of the arm's base in the world."""
    assert motion.arm is not None
    return [*motion.arm.link_position[0, 0].tolist(), *motion.arm.link_quaternion[0, 0].tolist()]


def _columns(motion: GraspMotion, episode: int, tasks: Sequence[str]) -> dict[str, np.ndarray]:
    """A motion's columns (T, ...) by name."""
    count = len(motion.time)
    arm = motion.arm.joint_position if motion.arm else np.zeros((count, 0))
    wrist = np.concatenate([motion.wrist_position, motion.wrist_quaternion], 1)
    later = np.minimum(np.arange(count) + 1, count - 1)
    return {
        _STATE: np.concatenate([arm, motion.joint_position, wrist], 1).astype(np.float32),
        _OBJECT: np.concatenate([motion.object_position, motion.object_quaternion], 1).astype(np.float32),
        _ACTION: np.concatenate([arm[later], motion.joint_target, wrist[later]], 1).astype(np.float32),
        "timestamp": motion.time.astype(np.float32),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, episode),
        "index": np.arange(count),
        "task_index": np.full(count, tasks.index(_task(motion))),
    }


def _column(values: np.ndarray) -> pa.Array:
    """Values (T,) or (T, n) as a column."""
    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def _tasks_table(tasks: Sequence[str]) -> pa.Table:
    """Tasks in pandas' format of a frame with one column and the tasks as its index, as LeRobot expects them."""
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _statistics(values: np.ndarray) -> dict[str, list[float]]:
    """Statistics of a column, in the names of the format."""
    columns = values.reshape(len(values), -1).astype(float)
    return {
        "min": columns.min(0).tolist(),
        "max": columns.max(0).tolist(),
        "mean": columns.mean(0).tolist(),
        "std": columns.std(0).tolist(),
        "count": [len(columns)],
        **{name: np.quantile(columns, q, axis=0).tolist() for name, q in _QUANTILES.items()},
    }


def _write_parquet(path: pathlib.Path, table: pa.Table) -> None:
    """Writes a table, and its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, compression="snappy")


def _info(motion: GraspMotion, episodes: int, frames: int, tasks: int, fps: int) -> dict[str, Any]:
    """Description of the data set: features with their shapes and names, counts, paths of files."""
    joints, count = robot_joints(motion), len(motion.joint_names)
    arm, fingers = joints[:-count], joints[-count:]
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
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": [len(parts)], "names": parts} for name, parts in names.items()
    }
    for name, dtype in {"timestamp": "float32", **_COUNTERS}.items():
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    return {
        "codebase_version": VERSION,
        "robot_type": "_".join(["congrasp", *([motion.arm.name] if motion.arm else []), motion.hand]),
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": f"data/{_FILE}",
        "video_path": None,
        "features": features,
    }


def read(path: pathlib.Path) -> list[Track]:
    """Reads every episode by the description in the files: features by name, kinematics by the URDF."""
    info = json.loads((path / "meta" / "info.json").read_text())
    (urdf,) = (file.read_text() for file in (path / "meta").glob("*.urdf"))
    about = json.loads((path / "meta" / "congrasp.json").read_text())
    links = [*about["links"], *about.get("arm_links", ())]
    episodes = pq.read_table(path / "meta" / "episodes").to_pylist()
    tracks = []
    wrist = [f"wrist_{name}" for name in _POSE]
    for episode in sorted(episodes, key=lambda row: row["episode_index"]):
        place = {name: episode[f"data/{name}"] for name in _PLACE}
        table = pq.read_table(path / info["data_path"].format(**place))
        rows = table.filter(pc.equal(table["episode_index"], episode["episode_index"])).sort_by("index")
        state = _named(info, rows, _STATE)
        environment = _named(info, rows, _OBJECT)
        angles = {name: state[name] for name in state if name not in wrist}
        palm = _pose(state, "wrist")
        bases = about.get("arm_base")
        base = _matrices(np.array([bases[episode["episode_index"]]])) if bases else palm
        poses = forward_kinematics(urdf, angles, palm, links[0], base)
        poses[OBJECT] = _pose(environment, "object")
        kept = {name: pose for name, pose in poses.items() if name in links or name == OBJECT}
        tracks.append(Track(rows["frame_index"].to_numpy() / info["fps"], kept))
    return tracks


def _named(info: Mapping[str, Any], rows: pa.Table, feature: str) -> dict[str, np.ndarray]:
    """(T,) columns of a feature by the names of its parts."""
    values = np.array(rows[feature].to_pylist(), float)
    return dict(zip(info["features"][feature]["names"], values.T, strict=True))


def _pose(values: Mapping[str, np.ndarray], prefix: str) -> np.ndarray:
    """(T, 4, 4) of the columns with a prefix."""
    return _matrices(np.stack([values[f"{prefix}_{name}"] for name in _POSE], -1))


def _matrices(poses: np.ndarray) -> np.ndarray:
    """(T, 4, 4) of positions and quaternions (T, 7)."""
    return pose_matrices(poses[:, :3], Rotation.from_quat(poses[:, 3:], scalar_first=True))
