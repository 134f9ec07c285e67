"""Python in a process of its own."""

import os
import subprocess
import sys
from typing import Any

from tests.examples import EXAMPLES


def python(
    *arguments: object, env: dict[str, str] | None = None, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Runs Python with these arguments and further variables; its modules may be those of the
    tests.
    """
    options = {"capture_output": True, "text": True, "timeout": 120, **options}
    environment = {**os.environ, "PYTHONPATH": str(EXAMPLES.parent), **(env or {})}
    return subprocess.run([sys.executable, *map(str, arguments)], env=environment, **options)
