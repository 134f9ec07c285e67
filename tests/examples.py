"""The programs of `examples/`, as modules."""

import importlib
import pathlib
import sys
from typing import Any
from unittest import mock

EXAMPLES = pathlib.Path(__file__).resolve().parents[1] / "examples"
ROS2 = EXAMPLES / "congrasp_ros2"
"""Folders of the programs.

Not by way of `tests.conftest`, whose settings of JAX are for tests: benchmarks import this
module.
"""


def example(name: str) -> Any:
    """Imports a program, which finds those next to it."""
    with mock.patch.object(sys, "path", [str(EXAMPLES), str(ROS2), *sys.path]):
        return importlib.import_module(name)
