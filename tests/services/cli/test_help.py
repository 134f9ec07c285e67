"""Help that loads only what it shows."""

import itertools
import json

import pytest

from congrasp.services.cli.main import COMMANDS, module_of
from tests.children import python

SLOW_PACKAGES = ("jax", "mujoco", "scipy", "trimesh")
PROGRAM = f"""
import contextlib, io, json, sys
from congrasp.services.cli.main import run
results = {{}}
for words in json.loads(sys.argv[1]):
    printed = io.StringIO()
    loaded = set(sys.modules)
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(printed):
        run([*words, "--help"])
    slow = [name for name in {SLOW_PACKAGES} if name in sys.modules and name not in loaded]
    results[" ".join(words)] = printed.getvalue(), slow
print(json.dumps(results))
"""


def lines_of(command: str) -> list[list[str]]:
    """Words of a command and of its subcommands."""
    parts = getattr(module_of(command), "COMMANDS", {})
    return [[command], *([command, part] for part in parts)]


@pytest.fixture(scope="module")
def results() -> dict[str, tuple[str, list[str]]]:
    """Help of every command, and the slow packages that it is the first to import, all in one
    process that starts without them.
    """
    lines = list(itertools.chain.from_iterable(map(lines_of, COMMANDS)))
    done = python("-c", PROGRAM, json.dumps(lines))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_imports_no_slow_package(command, results):
    for words in lines_of(command):
        line = " ".join(words)
        text, slow_packages = results[line]
        assert text.startswith(f"usage: congrasp {line}"), line
        assert slow_packages == [], line
