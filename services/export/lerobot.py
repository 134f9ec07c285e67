"""A LeRobot dataset, version 3.0: one episode per motion.

`observation.state` is the proprioception (joints of arm and fingers, then the wrist's pose),
`observation.environment_state` the object's pose, `action` the arm's joints one step later, the
finger targets, and the wrist's pose one step later. The hand is in `meta/hand.urdf`, with an arm
the whole robot in `meta/robot.urdf`. With a camera there is `observation.images.front` too: one MP4
for all episodes, a frame for every row.
"""

import json
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.hands.skin import Skin
from congrasp.common.runtime.parallel import cores
from congrasp.services.export.frames import facts, skin_of_motion
from congrasp.services.export.joint_trajectory import robot_joints
from congrasp.services.export.urdf import robot_urdf
from congrasp.services.viz.camera import Camera, fit
from congrasp.services.viz.hand_shapes import skin_shape
from congrasp.services.viz.raster import render_scene
from congrasp.services.viz.shapes import (
    Shape,
    arm_shapes,
    object_shape,
    table_shape,
)
from congrasp.services.viz.sheets import save_video

VERSION = "v3.0"
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_PLACE = {"chunk_index": 0, "file_index": 0}
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_COUNTERS = {
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_STATE, _OBJECT, _ACTION = "observation.state", "observation.environment_state", "action"
_CAMERA = "observation.images.front"
_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
SIZE = (320, 240)
"""Width and height of the video, pixels."""
_DIRECTION = np.array([0.8, -1.0, 0.7])  # from the table's middle to the camera
_STEP = 10  # frames between those that the camera must contain
_KEYFRAMES = ("-g", "2")  # for random access in training
_COUNTED = 64  # pixels between those that the statistics count


def write(path: pathlib.Path, motions: Sequence[Episode], *, camera: bool = False) -> None:
    """Writes motions of one hand and one control step as a dataset folder, optionally with a
    camera's video.

    Raises:
      CongraspError: the motions differ in robot or control step, or the control step is no whole
        number of frames a second.
    """
    first, fps = motions[0], _frame_rate(motions)
    tasks = list(dict.fromkeys(map(_task, motions)))
    starts = np.cumsum([0, *(len(motion.time) for motion in motions)])
    episodes = [_columns(motion, i, int(starts[i]), tasks) for i, motion in enumerate(motions)]
    every = {name: np.concatenate([columns[name] for columns in episodes]) for name in episodes[0]}
    stats = {name: _statistics(values) for name, values in every.items()}
    info = _info(first, len(motions), int(starts[-1]), len(tasks), fps)
    described = {"congrasp": _about(motions), "stats": stats, "info": info}
    pixels: list[np.ndarray] = []
    if camera:
        video = path / _VIDEO.format(video_key=_CAMERA, **_PLACE)
        described["camera"], pixels = film(video, motions, fps)
        stats[_CAMERA] = _statistics(np.concatenate(pixels), int(starts[-1]))
        info["video_path"], info["features"][_CAMERA] = _VIDEO, _video_feature(fps)
    rows = []
    for i, columns in enumerate(episodes):
        start, end = starts[i : i + 2].tolist()
        row = {"episode_index": i, "tasks": [_task(motions[i])], "length": end - start}
        row |= _prefixed("data", _PLACE) | {"dataset_from_index": start, "dataset_to_index": end}
        for name, values in columns.items():
            row |= _prefixed(f"stats/{name}", _statistics(values))
        if camera:
            span = {**_PLACE, "from_timestamp": start / fps, "to_timestamp": end / fps}
            row |= _prefixed(f"videos/{_CAMERA}", span)
            row |= _prefixed(f"stats/{_CAMERA}", _statistics(pixels[i], end - start))
        rows.append(row | _prefixed("meta/episodes", _PLACE))
    _write_parquet(
        path / "data" / _FILE.format(**_PLACE), pa.table({n: _column(v) for n, v in every.items()})
    )
    _write_parquet(path / "meta" / "episodes" / _FILE.format(**_PLACE), pa.Table.from_pylist(rows))
    _write_parquet(path / "meta" / "tasks.parquet", _tasks_table(tasks))
    (path / "meta" / ("robot.urdf" if first.arm else "hand.urdf")).write_text(robot_urdf(first))
    for name, content in described.items():
        (path / "meta" / f"{name}.json").write_text(json.dumps(content, indent=1))


def _frame_rate(motions: Sequence[Episode]) -> int:
    """Frames a second of motions of one robot."""
    dt = motions[0].control_dt
    fps = round(1 / dt)
    if abs(fps * dt - 1) > 1e-6:
        raise CongraspError(f"A control step of {dt} s makes no whole number of frames a second.")
    if any(_robot(motion) != _robot(motions[0]) for motion in motions):
        raise CongraspError(
            "A dataset has one robot and one control step, but the motions differ.",
            "Export each set.",
        )
    return fps


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
    del about["object"], about["constraints"]
    about |= {
        "objects": [motion.object for motion in motions],
        "success": [motion.success for motion in motions],
    }
    if motions[0].arm:
        about["arm_base"] = [
            [*m.arm.link_position[0, 0].tolist(), *m.arm.link_quaternion[0, 0].tolist()]
            for m in motions
            if m.arm
        ]
    about["action"] = (
        "finger targets of the joints' position servos; arm's joints and wrist's pose one step "
        "later"
    )
    return about


def _video_feature(fps: int) -> dict[str, Any]:
    """Description of the camera as a feature."""
    width, height = SIZE
    about = {
        "height": height,
        "width": width,
        "channels": 3,
        "codec": "h264",
        "pix_fmt": "yuv420p",
        "fps": fps,
    }
    about |= {"is_depth_map": False}
    info = {**{f"video.{name}": value for name, value in about.items()}, "has_audio": False}
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
    """Identity of the hand, the arm, and the control step."""
    arm = motion.arm
    return (
        motion.hand,
        motion.control_dt,
        arm and (arm.name, *arm.joint_names, *arm.hand_position, *arm.hand_quaternion),
    )


def _columns(
    motion: Episode, episode: int, start: int, tasks: Sequence[str]
) -> dict[str, np.ndarray]:
    """A motion's columns (T, ...) by name; `start` is the number of rows before them."""
    count = len(motion.time)
    arm = motion.arm.joint_position if motion.arm else np.zeros((count, 0))
    wrist = np.concatenate([motion.wrist_position, motion.wrist_quaternion], 1)
    later = np.minimum(np.arange(count) + 1, count - 1)
    return {
        _STATE: np.concatenate([arm, motion.joint_position, wrist], 1).astype(np.float32),
        _OBJECT: np.concatenate([motion.object_position, motion.object_quaternion], 1).astype(
            np.float32
        ),
        _ACTION: np.concatenate([arm[later], motion.joint_target, wrist[later]], 1).astype(
            np.float32
        ),
        "timestamp": motion.time.astype(np.float32),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, episode),
        "index": start + np.arange(count),
        "task_index": np.full(count, tasks.index(_task(motion))),
    }


def _column(values: np.ndarray) -> pa.Array:
    """Values (T,) or (T, n) as a column."""
    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def _tasks_table(tasks: Sequence[str]) -> pa.Table:
    """Tasks in pandas' format of a frame with one column and the tasks as its index, as LeRobot
    expects them.
    """
    columns = [
        {
            "name": name,
            "field_name": name,
            "pandas_type": kind,
            "numpy_type": numpy,
            "metadata": None,
        }
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": columns,
        "pandas_version": "2.0.0",
    }
    table = pa.table(
        {
            "task_index": pa.array(range(len(tasks)), pa.int64()),
            "task": pa.array(tasks, pa.string()),
        }
    )
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _statistics(values: np.ndarray, frames: int = 0) -> dict[str, list[Any]]:
    """Statistics of a column (T, ...), in the names of the format, or of some pixels (n, 3) of a
    number of frames.
    """
    columns = values.reshape(len(values), -1).astype(float)
    shape = (-1, 1, 1) if frames else (-1,)
    found = {
        "min": columns.min(0),
        "max": columns.max(0),
        "mean": columns.mean(0),
        "std": columns.std(0),
    }
    quantiles = {name: np.quantile(columns, q, axis=0) for name, q in _QUANTILES.items()}
    first, rest = (
        {name: x.reshape(shape).tolist() for name, x in part.items()} for part in (found, quantiles)
    )
    return {**first, "count": [frames or len(columns)], **rest}


def _write_parquet(path: pathlib.Path, table: pa.Table) -> None:
    """Writes a table, and its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, compression="snappy")


def _info(motion: Episode, episodes: int, frames: int, tasks: int, fps: int) -> dict[str, Any]:
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
        name: {"dtype": "float32", "shape": [len(parts)], "names": parts}
        for name, parts in names.items()
    }
    for name, dtype in {"timestamp": "float32", **_COUNTERS}.items():
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    return {
        "codebase_version": VERSION,
        "robot_type": "_".join(
            ["congrasp", *([motion.arm.name] if motion.arm else []), motion.hand]
        ),
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


class Film(NamedTuple):
    """Video of motions."""

    calibration: dict[str, Any]
    """See `calibration`."""
    pixels: list[np.ndarray]
    """(n, 3) from 0 to 1 for each motion: some pixels of every frame."""


def film(path: pathlib.Path, motions: Sequence[Episode], frame_rate: int) -> Film:
    """Writes the video of all motions in sequence, from a camera that shows all of them."""
    camera, pixels = camera_for(motions), list[np.ndarray]()

    def frames() -> Iterator[np.ndarray]:
        """Yields every frame, and keeps some of its pixels."""
        for motion in motions:
            kept = []
            for picture in pictures(motion, camera):
                kept.append(picture.reshape(-1, 3)[::_COUNTED] / 255)
                yield picture
            pixels.append(np.concatenate(kept))

    save_video(path, frames(), SIZE, frame_rate, _KEYFRAMES)
    return Film(calibration(camera), pixels)


def camera_for(motions: Sequence[Episode]) -> Camera:
    """Returns a camera that shows hands and objects of all motions."""
    points = np.concatenate([_extent(motion) for motion in motions])
    return fit(points[ConvexHull(points).vertices], _DIRECTION, SIZE[0] / SIZE[1])


def _extent(motion: Episode) -> np.ndarray:
    """(n, 3) points of the hand's skin and of the object at some frames of a motion."""
    found = []
    skin = skin_of_motion(motion)
    for frame in {*range(0, len(motion.time), _STEP), len(motion.time) - 1}:
        hand, thing = _shapes(motion, skin, frame)[:2]
        found += [
            hand.vertices,
            Rotation.from_quat(thing.quaternion, scalar_first=True).apply(thing.vertices),
        ]
        found[-1] = found[-1] + thing.position
    return np.concatenate(found)


def pictures(motion: Episode, camera: Camera) -> Iterator[np.ndarray]:
    """(height, width, 3) uint8 of every frame of a motion."""
    skin = skin_of_motion(motion)
    with ThreadPoolExecutor(cores()) as pool:
        frames = range(len(motion.time))
        yield from pool.map(
            lambda frame: render_scene(_shapes(motion, skin, frame), camera, SIZE), frames
        )


def calibration(camera: Camera) -> dict[str, Any]:
    """Parameters of the pinhole camera in the convention of computer vision: x right, y down, z
    forward.
    """
    right, up, forward = camera.axes()
    focal = SIZE[1] / 2 / np.tan(np.radians(camera.field_of_view) / 2)
    return {
        "model": (
            "pinhole, no distortion; x right, y down, z forward; pixel (0, 0) is the upper left "
            "one's centre"
        ),
        "width": SIZE[0],
        "height": SIZE[1],
        "intrinsics": [
            [focal, 0.0, SIZE[0] / 2 - 0.5],
            [0.0, focal, SIZE[1] / 2 - 0.5],
            [0.0, 0.0, 1.0],
        ],
        "camera_to_world": [
            *np.column_stack([right, -up, forward, camera.position]).tolist(),
            [0.0, 0.0, 0.0, 1.0],
        ],
    }


def _shapes(motion: Episode, skin: Skin, frame: int) -> list[Shape]:
    """Shapes of the hand, the object, the arm, and the table while it is present."""
    hand = skin_shape(skin, motion.link_position[frame], motion.link_quaternion[frame])
    mesh = motion.object_vertices, motion.object_faces
    thing = object_shape(
        mesh, motion.object_position[frame], motion.object_quaternion[frame], motion.colours
    )
    arm = arm_shapes(motion.arm, frame) if motion.arm else []
    return [
        hand,
        thing,
        *arm,
        *([table_shape(motion.object_position[0])] if motion.table[frame] else []),
    ]
