"""Topics of ROS 2 for the node: through rclpy, or the same messages over Zenoh."""

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

import congrasp

JOINTS, POSE, FRAMES = (
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/PoseStamped",
    "tf2_msgs/msg/TFMessage",
)
CLOUD, CLOCK = "sensor_msgs/msg/PointCloud2", "rosgraph_msgs/msg/Clock"
INPUTS = {
    "joint_states": JOINTS,
    "wrist_pose": POSE,
    "object_pose": POSE,
    "tf": FRAMES,
    "tf_static": FRAMES,
    "clock": CLOCK,
}
OUTPUTS = {"joint_command": JOINTS, "wrist_command": POSE}
_MOST = 64
"""Maximum number of waiting messages of a topic."""


class Bus(Protocol):
    """Topics of typed messages."""

    def make(self, kind: str, **fields: Any) -> Any:
        """A message of a type such as `geometry_msgs/msg/Point`; numbers of an array come as a
        list.
        """
        ...

    def receive(self) -> list[tuple[str, Any]]:
        """Topics and messages received since the last call; those of one topic are in their
        order.
        """
        ...

    def publish(self, topic: str, message: Any) -> None:
        """Sends a message."""
        ...

    def close(self) -> None:
        """Ends the subscriptions."""
        ...


class RosBus:
    """Topics of ROS 2 through rclpy."""

    def __init__(self, inputs: Mapping[str, str] = INPUTS) -> None:
        """Creates the node.

        Args:
          inputs: message types by topic.

        Raises:
          CongraspError: rclpy is not installed.
        """
        try:
            self._rclpy, qos = (
                importlib.import_module("rclpy"),
                importlib.import_module("rclpy.qos"),
            )
        except ImportError:
            raise congrasp.CongraspError(
                "ROS 2's rclpy cannot be imported here.",
                "Source ROS 2's setup.bash, or use --zenoh (docs/ros2.md).",
            ) from None
        self._rclpy.init()
        self._node = self._rclpy.create_node("congrasp")
        self._received: list[tuple[str, Any]] = []
        for topic, kind in inputs.items():
            # Takes reliable publishers, too. Static transforms are published once and kept for
            # later subscribers.
            lasting = (
                {"durability": qos.DurabilityPolicy.TRANSIENT_LOCAL} if topic == "tf_static" else {}
            )
            # Several nodes publish joints and frames
            depth = 1 if kind in (POSE, CLOUD, CLOCK) else _MOST
            profile = qos.QoSProfile(
                depth=depth, reliability=qos.ReliabilityPolicy.BEST_EFFORT, **lasting
            )
            self._node.create_subscription(self._type(kind), topic, self._keep(topic), profile)
        self._publishers = {
            t: self._node.create_publisher(self._type(k), t, 1) for t, k in OUTPUTS.items()
        }

    def make(self, kind: str, **fields: Any) -> Any:
        """See `Bus.make`."""
        return self._type(kind)(**fields)

    def receive(self) -> list[tuple[str, Any]]:
        """See `Bus.receive`."""
        for _ in range(_MOST):
            before = len(self._received)
            self._rclpy.spin_once(self._node, timeout_sec=0.0)
            if len(self._received) == before:
                break
        received, self._received = self._received, []
        return received

    def publish(self, topic: str, message: Any) -> None:
        """See `Bus.publish`."""
        self._publishers[topic].publish(message)

    def close(self) -> None:
        """See `Bus.close`."""
        self._node.destroy_node()
        self._rclpy.try_shutdown()

    def _type(self, kind: str) -> Any:
        """The class of a message."""
        package, folder, name = kind.split("/")
        return getattr(importlib.import_module(f"{package}.{folder}"), name)

    def _keep(self, topic: str) -> Callable[[Any], None]:
        """Returns a callback that stores a topic's messages."""

        def keep(message: Any) -> None:
            self._received.append((topic, message))

        return keep


class ZenohBus:
    """The same topics over Zenoh, as CDR, which rosbags writes and reads."""

    def __init__(self, endpoint: str, inputs: Mapping[str, str] = INPUTS):
        """Connects to a router, a bridge or a robot.

        Args:
          endpoint: the Zenoh endpoint, such as `tcp/127.0.0.1:7447`.
          inputs: message types by topic.

        Raises:
          CongraspError: nothing answers at the endpoint.
        """
        import zenoh
        from rosbags.typesys import Stores, get_typestore
        from zenoh.handlers import RingChannel

        self._inputs, self._store = inputs, get_typestore(Stores.ROS2_HUMBLE)
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", f'["{endpoint}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise congrasp.CongraspError(
                f"--zenoh: nothing answers at {endpoint} ({str(error).partition('  at /')[0]}).",
                "Start the router or the bridge, or correct the endpoint.",
            ) from None
        self._subscribers = {
            topic: self._session.declare_subscriber(
                topic.strip("/"), RingChannel(1 if kind in (POSE, CLOUD, CLOCK) else _MOST)
            )
            for topic, kind in inputs.items()
        }

    def make(self, kind: str, **fields: Any) -> Any:
        """See `Bus.make`."""
        arrays = {
            name: np.array(x)
            for name, x in fields.items()
            if isinstance(x, list) and name != "name"
        }
        return self._store.types[kind](**{**fields, **arrays})

    def receive(self) -> list[tuple[str, Any]]:
        """See `Bus.receive`; a message that is not of its topic's type is reported and skipped."""
        received = []
        for topic, subscriber in self._subscribers.items():
            for _ in range(_MOST):
                if (sample := subscriber.try_recv()) is None:
                    break
                try:
                    message = self._store.deserialize_cdr(
                        sample.payload.to_bytes(), self._inputs[topic]
                    )
                    received.append((topic, message))
                except Exception as error:
                    print(
                        f"{topic}: not a {self._inputs[topic]} ({type(error).__name__})",
                        file=sys.stderr,
                    )
        return received

    def publish(self, topic: str, message: Any) -> None:
        """See `Bus.publish`."""
        self._session.put(topic, bytes(self._store.serialize_cdr(message, OUTPUTS[topic])))

    def close(self) -> None:
        """See `Bus.close`."""
        self._session.close()
