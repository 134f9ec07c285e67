"""The files of a grasp: `congrasp grasp` writes them into an object's folder, the result last."""

import functools
import hashlib
import json
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.io.files import write_atomically
from congrasp.common.wire.codec import Message
from congrasp.services.export.motion_file import (
    GraspMotion,
    joint_trajectory,
    robot_joints,
    save_motion,
)
from congrasp.services.grasp.motion import Grasp
from congrasp.services.record.episode import MovedArm
from congrasp.services.record.scene import save_episode
from congrasp.services.viz.camera import Camera, fit
from congrasp.services.viz.episode_scene import episode_shapes
from congrasp.services.viz.film import Film, save_episode_video
from congrasp.services.viz.raster import render_scene
from congrasp.services.viz.render import (
    episode_sheet,
    grasp_picture,
    grasp_steps,
    render_episode_frames,
)
from congrasp.services.viz.shapes import Shape, arm_shapes, shape_points
from congrasp.services.viz.sheets import save_png
from congrasp.services.viz.views import View, camera_of

MOTION, RECORDING, PICTURE, VIDEO, RESULT = (
    "grasp.npz",
    "grasp.mcap",
    "grasp.png",
    "grasp.mp4",
    "result.json",
)
PORTRAIT = "portrait.png"
"""The last frame, 1280 x 720, from two sides."""
_FORMAT = 4  # of result.json: results of another format are repeated
THUMBNAIL = "thumbnail.png"
"""A small picture of the last frame."""
OBJECT = "object.png"
"""Pictures of the object before and after its import."""


_SMALL = (320, 240)  # pixels
ARM_CSV, ARM_TRAJECTORY, ARM_PICTURE = "arm.csv", "arm_trajectory.json", "arm.png"
_SIZE = (1280, 960)  # pixels
_AHEAD = np.array([0.35, -1.0, 0.45])  # from the robot to the camera, in the frame of the base
_GREY = (0.75, 0.76, 0.78)
# Margin of the table around arm and object, and its depth below height zero, m
_EDGE, _UNDER = (
    0.6,
    0.001,
)


def save_grasp(
    folder: pathlib.Path,
    found: Grasp,
    *,
    film: Film | None,
    pictures: bool,
    about: dict[str, Any],
    view: View | None = None,
) -> None:
    """Writes a grasp; the result comes last, so that its presence means that all files are
    complete.

    Args:
      folder: the object's folder.
      found: the grasp.
      film: style of the MP4; None writes none.
      pictures: also writes the contact sheet, the portrait, the thumbnail and, with an arm, the
        arm's picture.
      about: further entries of the result.
      view: viewpoint of pictures and video; the one that shows most of the grasp by default.

    Raises:
      CongraspError: a file cannot be written.
    """
    (folder / RESULT).unlink(missing_ok=True)
    save_motion(folder / MOTION, found.motion)
    save_episode(folder / RECORDING, "grasp", found.episode)
    episode, arm = found.episode, found.motion.arm
    if arm:
        save_trajectories(folder, found.motion, arm)
        if pictures:
            save_robot_picture(folder / ARM_PICTURE, arm, episode, found.first("hold"))
    steps = _steps_to_draw(*grasp_steps(episode), len(episode.arrays["table"]) - 1)
    last = steps[-1]
    if pictures:
        camera = camera_of(episode, steps, view=view, overlays=True)
        save_png(folder / PICTURE, episode_sheet(episode, steps=steps, camera=camera))
        save_png(folder / PORTRAIT, grasp_picture(episode, last, view=view))
        save_png(folder / THUMBNAIL, next(render_episode_frames(episode, [last], _SMALL, camera)))
    if film:
        if arm:
            save_robot_video(folder / VIDEO, arm, episode, film, steps)
        else:
            save_episode_video(folder / VIDEO, episode, film._replace(view=view))
    write_atomically(folder / RESULT, json.dumps({**found.facts(), **about}, indent=2).encode())


def _steps_to_draw(first: int, end: int, last: int) -> list[int]:
    """Up to eight steps to draw: before the grasp begins at `first`, during it, after its `end`,
    and the last one.
    """
    reach = [0, first / 2] if first else []
    grasp = np.linspace(first, min(end, last), 6 - len(reach))
    return sorted({round(step) for step in [*reach, *grasp, (end + last) / 2, last]})


def finished(folder: pathlib.Path, key: str) -> dict[str, Any] | None:
    """The stored result of an earlier grasp with the same key; None if there is none."""
    try:
        result = json.loads((folder / RESULT).read_text())
    except (OSError, ValueError):
        return None
    return result if isinstance(result, dict) and result.get("key") == key else None


def key_of(*parts: Any) -> str:
    """Sixteen hex digits that change with any input of a grasp."""
    return hashlib.sha256(json.dumps((_FORMAT, *parts), default=str).encode()).hexdigest()[:16]


def save_trajectories(folder: pathlib.Path, motion: GraspMotion, arm: MovedArm) -> None:
    """Writes the joints of arm and hand at every control step: `arm.csv` and `arm_trajectory.json`.

    Angles are in rad, slides in m, times in s. Finger joints are the targets of their servos, which
    hold the object. The JSON has the fields of trajectory_msgs/JointTrajectory, and `ros2 topic
    pub` accepts it as YAML; its points are those of `joint_trajectory`.

    Raises:
      CongraspError: a file cannot be written.
    """
    targets = np.clip(motion.joint_target, motion.joint_limits[:, 0], motion.joint_limits[:, 1])
    names, (joints, velocities, since) = robot_joints(motion), joint_trajectory(motion, targets)
    lines = [",".join(["time", *names])]
    lines += [
        ",".join(f"{x:.6f}" for x in (time, *row))
        for time, row in zip(motion.time, joints, strict=True)
    ]
    write_atomically(folder / ARM_CSV, ("\n".join(lines) + "\n").encode())
    points = [
        {
            "positions": position.round(6).tolist(),
            "velocities": velocity.round(6).tolist(),
            "time_from_start": {"sec": ns // 10**9, "nanosec": ns % 10**9},
        }
        for position, velocity, ns in zip(joints, velocities, since, strict=True)
    ]
    message = {"header": {"frame_id": arm.name}, "joint_names": names, "points": points}
    write_atomically(folder / ARM_TRAJECTORY, json.dumps(message).encode())


def save_robot_picture(path: pathlib.Path, arm: MovedArm, episode: Message, step: int) -> None:
    """Draws the whole robot with object and table at a control step of its episode, as PNG."""
    shapes = [*_robot_shapes(arm, episode, step), *_grasp_shapes(episode, step)]
    save_png(
        path, render_scene(shapes, _robot_camera(arm, episode, [step], _SIZE[0] / _SIZE[1]), _SIZE)
    )


def save_robot_video(
    path: pathlib.Path,
    arm: MovedArm,
    episode: Message,
    film: Film,
    steps: Sequence[int],
) -> None:
    """Writes an MP4 of an episode with the whole robot.

    Args:
      path: the file.
      arm: the arm of the episode.
      episode: the episode.
      film: size, frame rate and overlays.
      steps: control steps in which the camera shows all of the robot.

    Raises:
      CongraspError: see `save_episode_video`.
    """
    camera = _robot_camera(arm, episode, steps, film.size[0] / film.size[1])
    around = functools.partial(_robot_shapes, arm, episode)
    save_episode_video(path, episode, film, camera, around=around)


def _robot_camera(arm: MovedArm, episode: Message, steps: Sequence[int], aspect: float) -> Camera:
    """Returns a camera that shows the whole robot and the object in all of the control steps."""
    shapes = [
        shape for step in steps for shape in (*arm_shapes(arm, step), *_grasp_shapes(episode, step))
    ]
    points = np.concatenate([shape_points(shape) for shape in shapes])
    base = Rotation.from_quat(arm.link_quaternion[0, 0], scalar_first=True)
    return fit(points, base.apply(_AHEAD), aspect)


def _robot_shapes(arm: MovedArm, episode: Message, step: int) -> list[Shape]:
    """Returns the arm at a control step of its episode and the table on which arm and object
    stand.
    """
    ends = arm.link_position[0, 0, :2], episode.arrays["object_position"][0][:2]
    radius = float(np.linalg.norm(ends[0] - ends[1])) / 2 + _EDGE
    middle = np.array([*np.mean(ends, axis=0), -_UNDER])
    table = Shape("table", (radius, 0.0), _GREY, middle, shine=0.0, shadow=False)
    return [*arm_shapes(arm, step), table]


def _grasp_shapes(episode: Message, step: int) -> list[Shape]:
    """Returns hand and object, without the table of `episode_shapes`."""
    return [
        shape for shape in episode_shapes(episode, step, overlays=False) if shape.kind != "table"
    ]
