"""The ROS 2 node's loop over Zenoh: a simulated hand on a wrist, the node and the policy server as
processes.
"""

import contextlib
import dataclasses
import functools
import json
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from zenoh.handlers import RingChannel

import congrasp
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural, store
from congrasp.common.objects.pool import scale_objects
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import named_policy
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import goal_of
from congrasp.common.task.sensors import get_sensor
from congrasp.common.task.sensors.base import EpisodeStart, Moment
from congrasp.common.task.sensors.parameters import SensorParameters
from congrasp.common.task.types import SceneState, Surface
from congrasp.common.transport.ports import free_port
from tests.bare_zenoh import bare_session
from tests.examples import EXAMPLES, ROS2, example

JOINTS = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/PoseStamped"
CLOUD = "sensor_msgs/msg/PointCloud2"
FIELD = "sensor_msgs/msg/PointField"
FLOAT32 = 7
STORE = get_typestore(Stores.ROS2_HUMBLE)
SEED = 1_000_000
"""Of the object."""
_DROP = 0.03
"""m below its height at the end of the lift from which on an object counts as dropped."""


class DepthCamera:
    """The camera of an episode as drawn in training (`common.task.sensors.camera`), which takes
    images throughout.

    Attributes:
      delay: seconds from an image to its arrival.
    """

    def __init__(self, robot: Any, task: TaskConfig, surface: np.ndarray, episode: int):
        """Draws the camera and takes the first image, of an object with surface points (N, 3) in
        its frame, m.
        """
        config = dataclasses.replace(task.sensing, single_image=0.0)
        self._task = dataclasses.replace(task, sensing=config)
        self._sensor = get_sensor(task)
        self._parameters = self._sensor.draw(config, task.control_dt, jax.random.key(episode), 1)
        self._surface = Surface(surface[None].astype(np.float32), np.zeros((1, len(surface)), bool))
        start = robot.request
        goal = goal_of(get_hand(task.hand), task, start)
        pose = np.concatenate(start.object_pose)
        goal, pose = jax.tree.map(lambda x: np.asarray(x, np.float32)[None], (goal, pose))
        begin = EpisodeStart(
            hand=get_hand(task.hand), task=self._task, pose=pose, surface=self._surface, goal=goal
        )
        self._camera = self._sensor.begin(self._parameters, begin)
        self._base = dict(zip(("base_position", "base_quaternion"), start.wrist, strict=True))
        self._steps = 0
        self._shown = np.zeros(0)
        self.delay = task.control_dt * int(self._parameters.delay[0])

    def look(self, state: dict[str, np.ndarray]) -> np.ndarray | None:
        """Advances by a control step to the robot's state; returns the points (N, 3) of an image
        that arrives, m.
        """
        self._steps += 1
        scene = {name: state[name] for name in SceneState._fields if name in state} | self._base
        time, scene = jax.tree.map(lambda x: np.asarray(x)[None], (np.int32(self._steps), scene))
        self._camera = _look(self._task, self._parameters, self._camera, time, scene, self._surface)
        before, self._shown = self._shown, np.asarray(self._camera.cloud.points[0])
        return None if np.array_equal(before, self._shown) else self._shown


@functools.partial(jax.jit, static_argnums=0)
def _look(
    task: TaskConfig,
    parameters: SensorParameters,
    camera: Any,
    time: Any,
    scene: dict[str, Any],
    surface: Surface,
) -> Any:
    unknown: dict[str, Any] = dict.fromkeys(SceneState._fields)
    moment = Moment(
        hand=get_hand(task.hand),
        task=task,
        time=time,
        state=SceneState(**{**unknown, **scene}),
        object_position=scene["object_position"],
        lift=None,
        surface=surface,
    )
    return get_sensor(task).step(parameters, camera, moment)


class Rig:
    """A simulated hand whose joints, wrist and object are topics, and which follows the topics of
    commands.

    A policy with a camera gets clouds of the object instead of its pose.

    Attributes:
      robot: the simulation (`examples/robot_loop.py`).
      lines: output of the node, line by line.
      commands: commands of the node so far.
    """

    def __init__(self, folder: pathlib.Path, robot: Any, task: TaskConfig):
        """Opens the topics.

        Args:
          folder: takes the object's file and the node's output.
          robot: a `MujocoRobot` with the object of `SEED`.
          task: its task.
        """
        self.robot = robot
        self._folder = folder
        self._task = task
        hand = get_hand(task.hand)
        (obj,) = scale_objects(hand, task, [procedural.generate(SEED)])
        self._object = folder / f"object{store.SUFFIX}"
        store.save(obj, self._object)
        self._origin = np.asarray(obj.origin)
        self._names = [joint.name for joint in hand.joints]
        self._surface = obj.points[: task.surface_points]
        self._camera = None
        self._episodes = 0
        position, quaternion = self.robot.request.wrist
        self._base = np.asarray(position), Rotation.from_quat(quaternion, scalar_first=True)
        self._endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._session = bare_session("peer", listen=self._endpoint)
        topics = ("joint_command", "wrist_command")
        self._heard = {
            topic: self._session.declare_subscriber(topic, RingChannel(1)) for topic in topics
        }
        self._node: subprocess.Popen[bytes] | None = None
        self._ticker = congrasp.Ticker(100.0)
        self.commands = 0
        self._highest = -np.inf
        # Ns, of the episode's begin
        self._target = (np.array(self.robot.request.q), np.zeros(6))
        self._begun = 0

    @property
    def lines(self) -> list[str]:
        return (self._folder / "node.txt").read_text().splitlines()

    def begin(self, server: str, *options: str) -> None:
        """Puts hand and object to where an episode begins, and starts the node."""
        self.end()
        self.robot.reset()
        self._target = (np.array(self.robot.request.q), np.zeros(6))
        self._highest = -np.inf
        self._begun = time.time_ns()
        heading = self.robot.request.constraints["heading"]["direction"]
        thing = [str(self._object)]
        if self._task.observation == "camera":
            self._camera = DepthCamera(self.robot, self._task, self._surface, self._episodes)
            self._episodes += 1
            turn = Rotation.from_quat(self.robot.request.object_pose[1], scalar_first=True)
            heading, thing = turn.apply(heading), ["--cloud-topic", "points"]
        direction = " ".join(f"{x:.6f}" for x in heading)
        command = [
            sys.executable,
            "-m",
            "congrasp_ros2.node",
            *thing,
            "--zenoh",
            self._endpoint,
        ]
        command += [
            "--connect",
            server,
            "--heading",
            direction,
            "--hand",
            self._task.hand,
            *options,
        ]
        with (self._folder / "node.txt").open("wb") as output:
            environment = {**os.environ, "PYTHONPATH": f"{EXAMPLES.parent}{os.pathsep}{ROS2}"}
            self._node = subprocess.Popen(
                command, stdout=output, stderr=subprocess.STDOUT, env=environment
            )

    def end(self) -> None:
        """Kills the node."""
        if self._node:
            self._node.kill()
            self._node.wait()

    def close(self) -> None:
        """Kills the node and closes the topics."""
        self.end()
        self._session.close()

    def run(self, until: Callable[[], bool], seconds: float) -> None:
        """Simulates in real time until a condition holds, for at most so many seconds."""
        deadline = time.monotonic() + seconds
        while not until():
            assert time.monotonic() < deadline, self.lines[-3:]
            self._ticker.wait()
            self._step()

    @property
    def lifted(self) -> float:
        """Metres by which the object is above where it began."""
        return float(self.robot.height - self.robot.request.object_pose[0][2])

    @property
    def dropped(self) -> bool:
        """True if the object fell after it was lifted."""
        return bool(self._highest > 2 * _DROP and self.lifted < self._highest - _DROP)

    def _step(self) -> None:
        """One control step: publishes measurements, follows the newest commands."""
        state = self.robot.state()
        turn = self._base[1] * Rotation.from_euler("XYZ", state["u"][3:])
        thing = Rotation.from_quat(state["object_quaternion"], scalar_first=True)
        self._send_joints(state["q"])
        self._send_pose("wrist_pose", self._base[0] + self._base[1].apply(state["u"][:3]), turn)
        if self._camera is None:
            self._send_pose(
                "object_pose", state["object_position"] + thing.apply(self._origin), thing
            )
        elif (points := self._camera.look(state)) is not None:
            self._send_points(points, self._camera.delay)
        joints = self._newest("joint_command", JOINTS)
        wrist = self._newest("wrist_command", POSE)
        q_target, u_target = self._target
        if joints is not None:
            self.commands += 1
            q_target = np.array(joints.position)
        if wrist is not None:
            place = wrist.pose.position
            around = wrist.pose.orientation
            back = self._base[1].inv()
            turn = back * Rotation.from_quat([around.x, around.y, around.z, around.w])
            moved = back.apply(np.array([place.x, place.y, place.z]) - self._base[0])
            u_target = np.append(moved, turn.as_euler("XYZ"))
        self._target = q_target, u_target
        self.robot.move(congrasp.Command(q_target, u_target, q_target, u_target, "follow", None))
        self._highest = max(self._highest, self.lifted)

    def _newest(self, topic: str, kind: str) -> Any:
        """The newest command since the last call; None if there is none, or it is of the node
        before.
        """
        sample = self._heard[topic].try_recv()
        message = sample and STORE.deserialize_cdr(sample.payload.to_bytes(), kind)
        if (
            message is None
            or message.header.stamp.sec * 10**9 + message.header.stamp.nanosec < self._begun
        ):
            return None
        return message

    def _header(self, age: float = 0.0) -> Any:
        types = STORE.types
        stamp = time.time_ns() - round(1e9 * age)
        now = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        return types["std_msgs/msg/Header"](stamp=now, frame_id="world")

    def _send_joints(self, q: np.ndarray) -> None:
        none = np.zeros(0)
        message = STORE.types[JOINTS](self._header(), self._names, np.asarray(q, float), none, none)
        self._session.put("joint_states", bytes(STORE.serialize_cdr(message, JOINTS)))

    def _send_pose(self, topic: str, position: np.ndarray, rotation: Rotation) -> None:
        types = STORE.types
        x, y, z, w = rotation.as_quat().tolist()
        place = types["geometry_msgs/msg/Point"](*np.asarray(position, float).tolist())
        pose = types["geometry_msgs/msg/Pose"](
            place, types["geometry_msgs/msg/Quaternion"](x, y, z, w)
        )
        self._session.put(
            topic, bytes(STORE.serialize_cdr(types[POSE](self._header(), pose), POSE))
        )

    def _send_points(self, points: np.ndarray, age: float) -> None:
        fields = [STORE.types[FIELD](name, 4 * i, FLOAT32, 1) for i, name in enumerate("xyz")]
        data = points.astype("<f4").view(np.uint8).ravel()
        size = len(points)
        message = STORE.types[CLOUD](
            self._header(age), 1, size, fields, False, 12, 12 * size, data, True
        )
        self._session.put("points", bytes(STORE.serialize_cdr(message, CLOUD)))


def robot(
    seconds: float = 600.0,
    kill_every: float = 30.0,
    student: str = "allegro-student",
    out: pathlib.Path = pathlib.Path("runs/robot"),
) -> int:
    """The ROS 2 node over Zenoh against a simulated hand that lifts an object, while the policy
    server is killed.

    The policy is a student, because the topics have neither contact forces nor velocities.

    Args:
      seconds: How long.
      kill_every: Seconds from one kill to the next; half of them come while the object is held.
      student: Policy: allegro-student has a tracker, allegro-camera a camera as in its training.
      out: Folder for the node's output.

    Examples:
      python -m tests.benchmarks robot
      python -m tests.benchmarks robot --student allegro-camera
      python -m tests.benchmarks robot --seconds 60 --kill-every 20
    """
    out.mkdir(parents=True, exist_ok=True)
    loop = example("robot_loop")
    policy = named_policy(student)
    task = bundles.load(policy).task
    hand = get_hand(task.hand)
    simulated = loop.MujocoRobot(hand, task, SEED, congrasp.JointLimits.of_hand(hand, task.control))
    with contextlib.closing(Rig(out, simulated, task)) as rig:
        server = loop.Server(policy)
        counts = {"episodes": 0, "lifted": 0, "kills": 0, "dropped after a kill": 0, "dropped": 0}
        end = time.monotonic() + seconds
        kill = time.monotonic() + kill_every
        try:
            while time.monotonic() < end:
                with congrasp.PolicyClient(server.url, hand=task.hand, wait=180.0) as client:
                    # The node itself does not wait for a server that is still
                    # compiling
                    client.metadata()
                rig.begin(server.url, "--lift", "0.1")
                counts["episodes"] += 1
                rig.run(lambda: "follow" in "\n".join(rig.lines), 240.0)
                over = time.monotonic() + 8.0
                rig.run(lambda over=over: rig.dropped or time.monotonic() > over, 20.0)
                counts["lifted"] += rig.lifted > 2 * _DROP
                counts["dropped"] += rig.dropped
                if time.monotonic() > kill:
                    kill += kill_every
                    server.kill()
                    counts["kills"] += 1
                    over = time.monotonic() + 5.0
                    rig.run(lambda over=over: time.monotonic() > over, 20.0)
                    counts["dropped after a kill"] += rig.dropped
                    server.start()
        finally:
            server.kill()
    shares = {
        "beyond": rig.robot.beyond,
        "fastest": rig.robot.fastest,
        "strongest": rig.robot.strongest,
    }
    print(
        json.dumps({**counts, **{name: round(float(x), 4) for name, x in shares.items()}}, indent=1)
    )
    return int(counts["dropped after a kill"] > 0 or rig.robot.beyond > 0.0)
