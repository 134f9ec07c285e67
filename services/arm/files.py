"""Files of a motion on an arm: joint trajectories as CSV and as ROS 2's JointTrajectory, and a picture."""

import json
import pathlib
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.io.files import write_atomically
from congrasp.common.wire.codec import Message
from congrasp.services.assets.hands.geometry import geom_mesh
from congrasp.services.viz.episode import episode_shapes
from congrasp.services.viz.raster import render_scene
from congrasp.services.viz.scene import Shape
from congrasp.services.viz.shapes import fit, shape_points
from congrasp.services.viz.sheets import save_png

if TYPE_CHECKING:
    from congrasp.services.arm.planner import ArmMotion

CSV, TRAJECTORY, PICTURE = "arm.csv", "arm_trajectory.json", "arm.png"
_SIZE = (1280, 960)  # pixels
_AHEAD = np.array([0.35, -1.0, 0.45])  # from the robot to the camera, in the frame of the base
_GREY = (0.75, 0.76, 0.78)


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
    base = motion.world_base
    arm = _arm_shapes(motion, step)
    scene = [shape for shape in episode_shapes(episode, step, overlays=False) if shape.kind != "table"]
    points = np.concatenate([shape_points(shape) for shape in (*arm, *scene)])
    low, high = points.min(0), points.max(0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high[:2] - low[:2])) / 2 + 0.1
    table = Shape("table", (1.6 * radius, 0.0), _GREY, np.array([*middle[:2], 0.0]), shine=0.0, shadow=False)
    camera = fit(points, base.rotation.apply(_AHEAD), _SIZE[0] / _SIZE[1])
    save_png(path, render_scene([*arm, *scene, table], camera, _SIZE))


def _arm_shapes(motion: "ArmMotion", step: int) -> list[Shape]:
    """Visual shapes of the arm's file at a control step, in the world frame."""
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
        shapes.append(
            Shape(
                "mesh",
                (0, 0),
                (red, green, blue),
                base.rotation.apply(data.geom_xpos[g]) + base.position,
                turn.as_quat(scalar_first=True),
                vertices=np.asarray(mesh.vertices),
                faces=np.asarray(mesh.faces),
            )
        )
    return shapes
