"""Starts the node: `ros2 launch congrasp_ros2 grasp.launch.py object:=mug:7 hand:=allegro`.

`options:="--slow 0.25 --dry-run"` passes further options of the node.
"""

import shlex

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    "object": ("", "a mesh, an object file, or FAMILY:SEED; none for a policy with a camera"),
    "hand": ("allegro", "name of the hand"),
    "connect": ("tcp/127.0.0.1:7457", "endpoint of the policy server"),
    "options": ("", "further options of the node"),
    "namespace": ("", "namespace of the node's topics"),
}
"""Defaults and descriptions of the launch arguments."""


def generate_launch_description() -> LaunchDescription:
    """Returns the launch arguments, and the node that they describe."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start_node)])


def start_node(context: LaunchContext) -> list[Node]:
    """Returns the node, with the words of `options` as separate arguments."""
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    words = ["--hand", values["hand"], "--connect", values["connect"]]
    if values["object"]:
        words.insert(0, values["object"])
    words += shlex.split(values["options"])
    node = Node(
        package="congrasp_ros2",
        executable="grasp_node",
        namespace=values["namespace"],
        arguments=words,
        output="screen",
    )
    return [node]
