"""Benchmarks that inject faults, attack or compare with peers: `python -m tests.benchmarks NAME` in
the repository. Those of a user's machine are in the package, as `congrasp bench`.
"""

import importlib
import sys

from congrasp.common.errors import CongraspError
from congrasp.services.cli.parser import of_group

NAMES = (
    *("pieces", "shapes", "gallery", "screens", "speeds", "measures", "dexgraspbench"),
    *(
        "robot",
        "sensors",
        "attacks",
        "crowding",
        "stages",
        "transport",
        "faults",
        "replacements",
        "ceiling",
        "wide_area",
    ),
)
"""Each is a module of this folder with a function of its name."""

if __name__ == "__main__":
    # Benchmarks need packages of their own, so that only the requested one is imported.
    requested = [name for name in NAMES if name in sys.argv[1:2]] or NAMES
    commands = {
        name: getattr(importlib.import_module(f"tests.benchmarks.{name}"), name)
        for name in requested
    }
    try:
        sys.exit(of_group(commands, "python -m tests.benchmarks", __doc__)(sys.argv[1:])())
    except CongraspError as error:
        sys.exit(f"error: {error}")
