"""The ament_python package; `pip install examples/congrasp_ros2` installs the node without ROS 2,
too.
"""

from setuptools import setup

PACKAGE = "congrasp_ros2"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="A ROS 2 node between a congrasp policy server and a robot hand",
    author="The congrasp authors",
    license="Apache-2.0",
    packages=[PACKAGE],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", ["launch/grasp.launch.py"]),
    ],
    install_requires=["congrasp[train]"],
    entry_points={"console_scripts": [f"grasp_node = {PACKAGE}.node:main"]},
)
