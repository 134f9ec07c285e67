"""Files of a grasp with an arm: joint trajectories of the robot, its picture and its video."""

import functools
import json
import pathlib
from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.episode.arm import MovedArm
from congrasp.common.episode.episode import Episode
from congrasp.common.io.files import write_atomically
from congrasp.services.export.joint_trajectory import joint_trajectory, robot_joints
from congrasp.services.viz.camera import Camera, fit
from congrasp.services.viz.episode_scene import episode_shapes
from congrasp.services.viz.film import Film, save_episode_video
from congrasp.services.viz.raster import render_scene
from congrasp.services.viz.shapes import Shape, arm_shapes, shape_points
from congrasp.services.viz.sheets import save_png

ARM_CSV = "arm.csv"
ARM_TRAJECTORY = "arm_trajectory.json"
ARM_PICTURE = "arm.png"
_PICTURE_SIZE = (1280, 960)  # pixels
_TOWARDS_CAMERA = np.array([0.35, -1.0, 0.45])
"""Direction from the robot to the camera, in the frame of the base."""
_GREY = (0.75, 0.76, 0.78)
_TABLE_MARGIN = 0.6  # m, around arm and object
_TABLE_DEPTH = 0.001  # m, of its top below height zero


def save_trajectories(folder: pathlib.Path, motion: Episode, arm: MovedArm) -> None:
    """Writes the joints of arm and hand at every control step: `arm.csv` and `arm_trajectory.json`.

    Angles are in rad, slides in m, times in s. Finger joints are the targets of their servos, which
    hold the object. The JSON has the fields of trajectory_msgs/JointTrajectory, and `ros2 topic
    pub` accepts it as YAML; its points are those of `joint_trajectory`.

    Raises:
      CongraspError: a file cannot be written.
    """
    targets = np.clip(motion.joint_target, motion.joint_limits[:, 0], motion.joint_limits[:, 1])
    names = robot_joints(motion)
    trajectory = joint_trajectory(motion, targets)
    lines = [",".join(["time", *names])]
    for time, row in zip(motion.time, trajectory.positions, strict=True):
        lines.append(",".join(f"{x:.6f}" for x in (time, *row)))
    write_atomically(folder / ARM_CSV, ("\n".join(lines) + "\n").encode())
    points = []
    for position, velocity, ns in zip(*trajectory, strict=True):
        point = {
            "positions": position.round(6).tolist(),
            "velocities": velocity.round(6).tolist(),
            "time_from_start": {"sec": ns // 10**9, "nanosec": ns % 10**9},
        }
        points.append(point)
    message = {"header": {"frame_id": arm.name}, "joint_names": names, "points": points}
    write_atomically(folder / ARM_TRAJECTORY, json.dumps(message).encode())


def save_robot_picture(path: pathlib.Path, arm: MovedArm, episode: Episode, step: int) -> None:
    """Draws the whole robot with object and table at a control step of its episode, as PNG."""
    shapes = [*_robot_shapes(arm, episode, step), *_grasp_shapes(episode, step)]
    camera = _robot_camera(arm, episode, [step], _PICTURE_SIZE[0] / _PICTURE_SIZE[1])
    save_png(path, render_scene(shapes, camera, _PICTURE_SIZE))


def save_robot_video(
    path: pathlib.Path,
    arm: MovedArm,
    episode: Episode,
    film: Film,
    steps: Sequence[int],
    progress: Callable[[float], None] = lambda share: None,
) -> None:
    """Writes an MP4 of an episode with the whole robot.

    Args:
      path: the file.
      arm: the arm of the episode.
      episode: the episode.
      film: size, frame rate and overlays.
      steps: control steps in which the camera shows all of the robot.
      progress: see `save_episode_video`.

    Raises:
      CongraspError: see `save_episode_video`.
    """
    camera = _robot_camera(arm, episode, steps, film.size[0] / film.size[1])
    around = functools.partial(_robot_shapes, arm, episode)
    save_episode_video(path, episode, film, camera, progress, around=around)


def _robot_camera(arm: MovedArm, episode: Episode, steps: Sequence[int], aspect: float) -> Camera:
    """Returns a camera that shows the whole robot and the object in all of the control steps."""
    points = []
    for step in steps:
        shapes = [*arm_shapes(arm, step), *_grasp_shapes(episode, step)]
        points += [shape_points(shape) for shape in shapes]
    base = Rotation.from_quat(arm.link_quaternion[0, 0], scalar_first=True)
    return fit(np.concatenate(points), base.apply(_TOWARDS_CAMERA), aspect)


def _robot_shapes(arm: MovedArm, episode: Episode, step: int) -> list[Shape]:
    """Returns the arm at a control step of its episode and the table on which arm and object
    stand.
    """
    base = arm.link_position[0, 0, :2]
    obj = episode.object_position[0][:2]
    radius = float(np.linalg.norm(base - obj)) / 2 + _TABLE_MARGIN
    middle = np.array([*np.mean((base, obj), axis=0), -_TABLE_DEPTH])
    table = Shape("table", (radius, 0.0), _GREY, middle, shine=0.0, shadow=False)
    return [*arm_shapes(arm, step), table]


def _grasp_shapes(episode: Episode, step: int) -> list[Shape]:
    """Returns hand and object, without the table of `episode_shapes`."""
    return [
        shape for shape in episode_shapes(episode, step, overlays=False) if shape.kind != "table"
    ]
