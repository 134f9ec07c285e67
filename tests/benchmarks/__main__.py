"""Benchmarks that inject faults, attack or compare with peers: `python -m tests.benchmarks NAME` in
the repository.
"""

import importlib
import sys

from congrasp.common.errors import CongraspError
from congrasp.services.cli.parser import of_group

NAMES = (
    *("pieces", "gallery", "screens", "speeds", "measures", "dexgraspbench"),
    *("robot", "sensors", "attacks", "crowding", "transport", "faults", "ceiling"),
)
"""Each is a module of this folder with a function of its name."""

if __name__ == "__main__":
    commands = {
        name: getattr(importlib.import_module(f"tests.benchmarks.{name}"), name) for name in NAMES
    }
    try:
        sys.exit(of_group(commands, "python -m tests.benchmarks", __doc__)(sys.argv[1:])())
    except CongraspError as error:
        sys.exit(f"error: {error}")
