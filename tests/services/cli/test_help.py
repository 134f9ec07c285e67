"""Help that loads only what it shows."""

import json

import pytest

from congrasp.services.cli.main import COMMANDS, module_of
from tests.children import python

SLOW_PACKAGES = ("jax", "mujoco", "scipy", "trimesh")
PROGRAM = f"""
import contextlib, json, sys
from congrasp.services.cli.main import run
for words in json.loads(sys.argv[1]):
    with contextlib.suppress(SystemExit):
        run([*words, "--help"])
print([name for name in {SLOW_PACKAGES} if name in sys.modules])
"""


@pytest.mark.parametrize("command", COMMANDS)
def test_help_imports_no_slow_package(command):
    lines = [[command]]
    for part in getattr(module_of(command), "COMMANDS", {}):
        lines.append([command, part])
    done = python("-c", PROGRAM, json.dumps(lines))
    assert done.returncode == 0, done.stderr
    *printed, slow_packages = done.stdout.splitlines()
    assert slow_packages == "[]"
    for words in lines:
        assert any(line.startswith(f"usage: congrasp {' '.join(words)}") for line in printed), words
