"""The ROS 2 package around the node: its description, what it installs, and its launch file, with
stand-ins for ROS 2's modules.
"""

import configparser
import importlib
import runpy
import shutil
import subprocess
import sys
import tomllib
import types
import zipfile

import pytest
from catkin_pkg.package import parse_package

from tests.examples import EXAMPLES, ROS2, example

NODE = "grasp_node"


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """The wheel that pip makes of the package."""
    folder = tmp_path_factory.mktemp("wheel")
    source = shutil.copytree(ROS2, folder / "source")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", str(folder)]
    subprocess.run([*command, str(source)], check=True, timeout=300)
    return zipfile.ZipFile(next(folder.glob("*.whl")))


def test_package_xml_is_valid_and_of_this_version():
    package = parse_package(str(ROS2))
    project = tomllib.loads((EXAMPLES.parent / "pyproject.toml").read_text())["project"]
    package.validate()
    assert package.package_format == 3 and package.get_build_type() == "ament_python"
    assert package.version == project["version"]
    bus = example("congrasp_ros2.bus")
    messages = {kind.partition("/")[0] for kind in (*bus.INPUTS.values(), *bus.OUTPUTS.values())}
    messages.add(bus.CLOUD.partition("/")[0])
    assert {*messages, "rclpy", "launch", "launch_ros"} == {d.name for d in package.exec_depends}


def test_package_installs_the_node_and_the_files_that_ros_2_looks_for(archive):
    entries = configparser.ConfigParser()
    (name,) = [name for name in archive.namelist() if name.endswith("/entry_points.txt")]
    entries.read_string(archive.read(name).decode())
    module, _, function = entries["console_scripts"][NODE].partition(":")
    assert callable(getattr(example(module), function))
    installed = {name.partition(".data/data/")[2] for name in archive.namelist()}
    assert {
        "share/ament_index/resource_index/packages/congrasp_ros2",
        "share/congrasp_ros2/package.xml",
        "share/congrasp_ros2/launch/grasp.launch.py",
    } <= installed


def test_node_ignores_the_arguments_of_ros():
    node = example("congrasp_ros2.node")
    words = ["mug:7", "--ros-args", "-r", "__ns:=/left", "--", "--lift", "0.1"]
    assert node.without_ros_arguments(words) == ["mug:7", "--lift", "0.1"]
    assert node.without_ros_arguments(["mug:7", "--ros-args", "-r", "a:=b"]) == ["mug:7"]


class Argument(str):
    """A launch argument, which has the value of the context."""

    def perform(self, context):
        return context[str(self)]


def stand_ins(monkeypatch, nodes):
    """Modules of ROS 2's launch system, as far as the launch file uses them."""

    def module(name, **values):
        stand_in = types.ModuleType(name)
        vars(stand_in).update(values)
        monkeypatch.setitem(sys.modules, name, stand_in)

    module("launch", LaunchContext=dict, LaunchDescription=list)
    module(
        "launch.actions",
        DeclareLaunchArgument=lambda name, default_value, description: (name, default_value),
        OpaqueFunction=lambda function: function,
    )
    module("launch.substitutions", LaunchConfiguration=Argument)
    module("launch_ros")
    module("launch_ros.actions", Node=lambda **values: nodes.append(values))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"object": "mug:7", "options": "--box '0 0 1 1 1 1'"}, ["mug:7", "--box", "0 0 1 1 1 1"]),
        ({"options": "--cloud-topic /points"}, ["--cloud-topic", "/points"]),
    ],
)
def test_launch_file_starts_the_node_with_options_that_it_has(monkeypatch, changes, words):
    nodes = []
    stand_ins(monkeypatch, nodes)
    launch_file = runpy.run_path(str(ROS2 / "launch" / "grasp.launch.py"))
    *declared, start = launch_file["generate_launch_description"]()
    start({**dict(declared), **changes})
    (node,) = nodes
    assert (node["package"], node["executable"]) == ("congrasp_ros2", NODE)
    assert [word for word in node["arguments"] if word in words] == words
    module = importlib.import_module("congrasp_ros2.node")
    arguments = module.tyro.cli(module.Arguments, args=node["arguments"])
    assert (arguments.object, arguments.hand) == (changes.get("object", ""), "allegro")
