"""Files of a motion on an arm: joint trajectories as CSV and as ROS 2's JointTrajectory, and a picture."""

import json
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.io.files import write_atomically
from congrasp.common.wire.codec import Message
from congrasp.services.assets.hands.geometry import geom_mesh
from congrasp.services.viz.episode import episode_shapes
from congrasp.services.viz.raster import render_scene
from congrasp.services.viz.scene import Camera, Shape
from congrasp.services.viz.shapes import fit, object_shape, shape_points
from congrasp.services.viz.sheets import save_png

if TYPE_CHECKING:
    from congrasp.services.arm.planner import ArmMotion

CSV, TRAJECTORY, PICTURE = "arm.csv", "arm_trajectory.json", "arm.png"
_SIZE = (1280, 960)  # pixels
_AHEAD = np.array([0.35, -1.0, 0.45])  # from the robot to the camera, in the frame of the base
_GREY = (0.75, 0.76, 0.78)
_EDGE, _UNDER = 0.6, 0.001  # table beyond arm and object, and below the grasp's own table, m


def save_trajectories(folder: pathlib.Path, motion: "ArmMotion") -> None:
    """Writes the joints of arm and hand at every control step: `arm.csv` and `arm_trajectory.json`.

    Angles are in rad, slides in m, times in s. Finger joints are the targets of their servos, which hold the object.
    The JSON has the fields of trajectory_msgs/JointTrajectory, and is YAML that `ros2 topic pub` takes.

    Raises:
      CongraspError: a file cannot be written.
    """
    names = [*motion.robot.arm.joints, *motion.hand_joints]
    joints = np.concatenate([motion.track.q, motion.hand_target], 1)
    lines = [",".join(["time", *names])]
    lines += [",".join(f"{x:.6f}" for x in (time, *row)) for time, row in zip(motion.time, joints, strict=True)]
    write_atomically(folder / CSV, ("\n".join(lines) + "\n").encode())
    velocities = np.gradient(joints, motion.scene.dt, axis=0)
    since = (1e9 * motion.time).round().astype(int).tolist()
    points = [
        {
            "positions": position.round(6).tolist(),
            "velocities": velocity.round(6).tolist(),
            "time_from_start": {"sec": ns // 10**9, "nanosec": ns % 10**9},
        }
        for position, velocity, ns in zip(joints, velocities, since, strict=True)
    ]
    message = {"header": {"frame_id": motion.robot.arm.name}, "joint_names": names, "points": points}
    write_atomically(folder / TRAJECTORY, json.dumps(message).encode())


def save_picture(path: pathlib.Path, motion: "ArmMotion", episode: Message, step: int) -> None:
    """Draws the whole robot with object and table at a control step of its episode, as PNG."""
    shapes = [*robot_shapes(motion, episode, step), *_grasp_shapes(episode, step)]
    save_png(path, render_scene(shapes, robot_camera(motion, episode, [step], _SIZE[0] / _SIZE[1]), _SIZE))


def robot_camera(motion: "ArmMotion", episode: Message, steps: Sequence[int], aspect: float) -> Camera:
    """Returns a camera that shows the whole robot and the object in all of the control steps."""
    shapes = [shape for step in steps for shape in (*_arm_shapes(motion, step), *_grasp_shapes(episode, step))]
    points = np.concatenate([shape_points(shape) for shape in shapes])
    return fit(points, motion.world_base.rotation.apply(_AHEAD), aspect)


def robot_shapes(motion: "ArmMotion", episode: Message, step: int) -> list[Shape]:
    """Returns the arm at a control step of its episode and the table on which arm and object stand."""
    ends = motion.world_base.position[:2], episode.arrays["object_position"][0][:2]
    radius = float(np.linalg.norm(ends[0] - ends[1])) / 2 + _EDGE
    middle = np.array([*np.mean(ends, axis=0), -_UNDER])
    table = Shape("table", (radius, 0.0), _GREY, middle, shine=0.0, shadow=False)
    return [*_arm_shapes(motion, step), table]


def _grasp_shapes(episode: Message, step: int) -> list[Shape]:
    """Returns hand and object without the table of the hand alone."""
    return [shape for shape in episode_shapes(episode, step, overlays=False) if shape.kind != "table"]


def _arm_shapes(motion: "ArmMotion", step: int) -> list[Shape]:
    """Returns the visual shapes of the arm at a control step, world frame."""
    robot, scene, base = motion.robot, motion.scene, motion.world_base
    data = mujoco.MjData(robot.model)
    q = robot.model.qpos0.copy()
    q[robot.joints], q[robot.fingers] = motion.track.q[step], scene.q[step]
    robot.place(data, q, scene.object_position[step], scene.object_quaternion[step], scene.table[step])
    shapes = []
    for g in robot.drawn():
        mesh = geom_mesh(robot.model, g)
        if mesh is None:
            continue
        turn = base.rotation * Rotation.from_matrix(data.geom_xmat[g].reshape(3, 3))
        material = robot.model.geom_matid[g]
        red, green, blue, _ = (robot.model.mat_rgba[material] if material >= 0 else robot.model.geom_rgba[g]).tolist()
        place, quaternion = base.rotation.apply(data.geom_xpos[g]) + base.position, turn.as_quat(scalar_first=True)
        both = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        shapes.append(object_shape(both, place, quaternion, colour=(red, green, blue)))
    return shapes
