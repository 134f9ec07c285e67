"""Files of a motion on an arm: joint trajectories as CSV and as ROS 2's JointTrajectory, picture and video."""

import functools
import json
import pathlib
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.io.files import write_atomically
from congrasp.common.wire.codec import Message
from congrasp.services.export.motion_file import GraspMotion, joint_trajectory, robot_joints
from congrasp.services.record.episode import MovedArm
from congrasp.services.viz.raster import render_scene
from congrasp.services.viz.render import Film, save_episode_video
from congrasp.services.viz.shapes import Camera, Shape, arm_shapes, fit, shape_points
from congrasp.services.viz.sheets import save_png
from congrasp.services.viz.views import episode_shapes

CSV, TRAJECTORY, PICTURE = "arm.csv", "arm_trajectory.json", "arm.png"
_SIZE = (1280, 960)  # pixels
_AHEAD = np.array([0.35, -1.0, 0.45])  # from the robot to the camera, in the frame of the base
_GREY = (0.75, 0.76, 0.78)
_EDGE, _UNDER = 0.6, 0.001  # margin of the table around arm and object, and its depth below height zero, m


def save_trajectories(folder: pathlib.Path, motion: GraspMotion, arm: MovedArm) -> None:
    """Writes the joints of arm and hand at every control step: `arm.csv` and `arm_trajectory.json`.

    Angles are in rad, slides in m, times in s. Finger joints are the targets of their servos, which hold the object.
    The JSON has the fields of trajectory_msgs/JointTrajectory, and is YAML that `ros2 topic pub` takes; its points are
    those of `joint_trajectory`.

    Raises:
      CongraspError: a file cannot be written.
    """
    targets = np.clip(motion.joint_target, motion.joint_limits[:, 0], motion.joint_limits[:, 1])
    names, (joints, velocities, since) = robot_joints(motion), joint_trajectory(motion, targets)
    lines = [",".join(["time", *names])]
    lines += [",".join(f"{x:.6f}" for x in (time, *row)) for time, row in zip(motion.time, joints, strict=True)]
    write_atomically(folder / CSV, ("\n".join(lines) + "\n").encode())
    points = [
        {
            "positions": position.round(6).tolist(),
            "velocities": velocity.round(6).tolist(),
            "time_from_start": {"sec": ns // 10**9, "nanosec": ns % 10**9},
        }
        for position, velocity, ns in zip(joints, velocities, since, strict=True)
    ]
    message = {"header": {"frame_id": arm.name}, "joint_names": names, "points": points}
    write_atomically(folder / TRAJECTORY, json.dumps(message).encode())


def save_picture(path: pathlib.Path, arm: MovedArm, episode: Message, step: int) -> None:
    """Draws the whole robot with object and table at a control step of its episode, as PNG."""
    shapes = [*_robot_shapes(arm, episode, step), *_grasp_shapes(episode, step)]
    save_png(path, render_scene(shapes, _robot_camera(arm, episode, [step], _SIZE[0] / _SIZE[1]), _SIZE))


def save_robot_video(
    path: pathlib.Path, arm: MovedArm, episode: Message, film: Film, steps: Sequence[int], until: int | None = None
) -> None:
    """Writes an MP4 of an episode with the whole robot, from a camera that shows it in all of some control steps.

    Args:
      path: the file.
      arm: the arm of the episode.
      episode: the episode.
      film: size, frame rate and overlays.
      steps: control steps that the camera must show.
      until: see `save_episode_video`.

    Raises:
      CongraspError: see `save_episode_video`.
    """
    camera = _robot_camera(arm, episode, steps, film.size[0] / film.size[1])
    around = functools.partial(_robot_shapes, arm, episode)
    save_episode_video(path, episode, film, camera, until=until, around=around)


def _robot_camera(arm: MovedArm, episode: Message, steps: Sequence[int], aspect: float) -> Camera:
    """Returns a camera that shows the whole robot and the object in all of the control steps."""
    shapes = [shape for step in steps for shape in (*arm_shapes(arm, step), *_grasp_shapes(episode, step))]
    points = np.concatenate([shape_points(shape) for shape in shapes])
    base = Rotation.from_quat(arm.link_quaternion[0, 0], scalar_first=True)
    return fit(points, base.apply(_AHEAD), aspect)


def _robot_shapes(arm: MovedArm, episode: Message, step: int) -> list[Shape]:
    """Returns the arm at a control step of its episode and the table on which arm and object stand."""
    ends = arm.link_position[0, 0, :2], episode.arrays["object_position"][0][:2]
    radius = float(np.linalg.norm(ends[0] - ends[1])) / 2 + _EDGE
    middle = np.array([*np.mean(ends, axis=0), -_UNDER])
    table = Shape("table", (radius, 0.0), _GREY, middle, shine=0.0, shadow=False)
    return [*arm_shapes(arm, step), table]


def _grasp_shapes(episode: Message, step: int) -> list[Shape]:
    """Returns hand and object, without the table of `episode_shapes`."""
    return [shape for shape in episode_shapes(episode, step, overlays=False) if shape.kind != "table"]
