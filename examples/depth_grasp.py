"""A motion from one depth image, by a policy with a camera (docs/camera.md).

    python examples/depth_grasp.py
    python examples/depth_grasp.py --depth depth.png --intrinsics 615 615 320 240 \
        --camera 0.5 0 0.4 0.271 -0.653 -0.653 0.271

The image is a PNG of millimetres (16 bit) or an NPY of metres; without one, a cylinder is seen by a
simulated camera. Points above the table are the object. Joints follow their targets like unloaded
servos; a robot passes its readings.
"""

import dataclasses
import pathlib
import sys

import mujoco
import numpy as np
import tyro
from PIL import Image

import congrasp
from congrasp.common import rotations
from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.task.constraints.heading import HeadingGoal, heading_wrist_pose

SIZE = 160, 120
"""Width and height of the simulated image in pixels."""
SERVO_RATE = 20.0
"""kp / kv of the servos, 1/s."""
SCENE = """<mujoco><worldbody><geom type="plane" size="2 2 .1"/>
<geom type="cylinder" size=".03 .06" pos="0 0 .06"/></worldbody></mujoco>"""


@dataclasses.dataclass
class Arguments:
    """Image, camera and grasp."""

    policy: str = "human-camera"
    """A policy trained with --method camera: a file, or the name of a pretrained one."""
    depth: pathlib.Path | None = None
    """Depth along the optical axis: PNG, mm, or NPY, m; zero or not finite where there is none."""
    intrinsics: tuple[float, float, float, float] = (150.0, 150.0, 79.5, 59.5)
    """fx, fy, cx, cy in pixels."""
    camera: tuple[float, float, float, float, float, float, float] = (
        0.4,
        0.0,
        0.4,
        0.27060,
        -0.65328,
        -0.65328,
        0.27060,
    )
    """Position (m) and quaternion (w, x, y, z) of the optical frame (z forward, y down), world
    frame; the table's top is at z = 0."""
    floor: float = 0.005
    """Height above which a point belongs to the object, m."""
    heading: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """Direction in which the hand approaches, world frame."""
    back_off: float = 0.15
    """Distance from the first wrist to the grasp, m."""
    steps: int = 200
    """Control steps of the motion."""
    out: pathlib.Path = pathlib.Path("motion.csv")
    """Time, finger targets and wrist targets of each control step."""


def simulated(arguments: Arguments) -> np.ndarray:
    """(height, width) depth of a cylinder on the table, m."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    fx, fy, cx, cy = arguments.intrinsics
    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    local = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones(columns.shape)], -1).reshape(
        -1, 3
    )
    rays = np.asarray(rotations.rotate(np.asarray(arguments.camera[3:]), local))
    depth, hit, normal = np.zeros(len(rays)), np.zeros((1,), np.int32), np.zeros((3, 1))
    for i, ray in enumerate(rays):  # distances in lengths of the ray, which are depths
        depth[i] = mujoco.mj_ray(
            model, data, np.asarray(arguments.camera[:3]), ray, None, 1, -1, hit, normal
        )
    return np.maximum(depth, 0.0).reshape(columns.shape)


def cloud_of(depth: np.ndarray, arguments: Arguments) -> np.ndarray:
    """(N, 3) points of the object, world frame, m.

    Raises:
      CongraspError: no point is above the floor.
    """
    fx, fy, cx, cy = arguments.intrinsics
    rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
    z = depth[rows, columns]
    local = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], -1)
    position, quaternion = np.split(np.asarray(arguments.camera), [3])
    points = np.asarray(rotations.transform(position, quaternion, local))
    points = points[points[:, 2] > arguments.floor]
    if not len(points):
        raise congrasp.CongraspError(
            "No point of the depth image is above the table.",
            "Check --camera, --intrinsics and --floor.",
        )
    return points.astype(np.float32)


def read_depth(file: pathlib.Path) -> np.ndarray:
    """(height, width) depth of a file, m."""
    try:
        if file.suffix == ".npy":
            depth = np.load(file, allow_pickle=False)
        else:
            depth = np.asarray(Image.open(file), np.float32) / 1000.0
    except (OSError, ValueError) as error:
        raise congrasp.CongraspError(
            f"--depth: {file} cannot be read ({error}).", "Pass a PNG or an NPY."
        ) from None
    if depth.ndim != 2:
        raise congrasp.CongraspError(
            f"--depth: {file} has shape {depth.shape}.", "Pass one depth a pixel."
        )
    return depth


def main(arguments: Arguments) -> None:
    """Writes the motion for the object in the image."""
    depth = simulated(arguments) if arguments.depth is None else read_depth(arguments.depth)
    cloud = cloud_of(depth, arguments)
    direction = np.asarray(arguments.heading) / np.linalg.norm(arguments.heading)
    cross = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    heading = {
        "position": cloud.mean(0),
        "direction": direction,
        "cross": cross / np.linalg.norm(cross),
    }
    with congrasp.load_policy(arguments.policy) as policy:
        described = policy.metadata()
        hand, q, u = get_hand(described["hand"]), np.asarray(described["open_pose"]), np.zeros(6)
        aligned, turn = heading_wrist_pose(hand, HeadingGoal(**heading), grasp_frame(hand).center)
        wrist = np.asarray(aligned) - arguments.back_off * direction, np.asarray(turn)
        policy.reset(
            congrasp.GraspRequest(
                {"heading": heading},
                cloud=cloud,
                camera=np.asarray(arguments.camera[:3]),
                q=q,
                wrist=wrist,
            )
        )
        rows = []
        for step in range(arguments.steps):
            answer = policy.act({"q": q, "u": u, "table": step < described["approach_steps"]})
            rows.append([step * described["period"], *answer.q_target, *answer.u_target])
            share = 1.0 - np.exp(-SERVO_RATE * described["period"])
            q, u = q + share * (answer.q_target - q), u + share * (answer.u_target - u)
    names = ["time", *described["joints"], "x", "y", "z", "rx", "ry", "rz"]
    np.savetxt(arguments.out, rows, "%.6f", ",", header=",".join(names), comments="")
    print(f"{arguments.out}: {len(rows)} control steps for {len(cloud)} points.")


if __name__ == "__main__":
    try:
        main(tyro.cli(Arguments, description=__doc__))
    except congrasp.CongraspError as error:
        sys.exit(f"depth_grasp: error: {error}")
