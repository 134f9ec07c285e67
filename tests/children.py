"""Python in a process of its own."""

import os
import subprocess
import sys
from typing import Any

from congrasp.services.ops.lifetime import PARENT_VARIABLE
from tests.examples import EXAMPLES

BUSY = """
from congrasp.services.ops.lifetime import follow_parent
follow_parent()
while True:
    pass
"""
"""A program that keeps a core busy."""


def following(**variables: str) -> dict[str, str]:
    """Environment of a process that ends when this one is killed, if it is a command of congrasp or
    calls `follow_parent`.

    Args:
      **variables: further variables.
    """
    return {**os.environ, PARENT_VARIABLE: str(os.getpid()), **variables}


def python_path() -> str:
    """`PYTHONPATH` with the repository before what it has."""
    paths = [str(EXAMPLES.parent), os.environ.get("PYTHONPATH", "")]
    return os.pathsep.join(filter(None, paths))


def python(
    *arguments: object, env: dict[str, str] | None = None, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Runs Python with these arguments and further variables; its modules may be those of the
    tests.
    """
    options = {"capture_output": True, "text": True, "timeout": 120, **options}
    environment = {**os.environ, "PYTHONPATH": python_path(), **(env or {})}
    return subprocess.run([sys.executable, *map(str, arguments)], env=environment, **options)
