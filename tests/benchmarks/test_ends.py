"""Processes that benchmarks start end with them, even when they are killed."""

import ast
import pathlib
import re
import sys

import psutil
import pytest

from tests.children import python
from tests.waits import eventually

STARTED = {
    "shapes": "with shapes._busy_processes(2):",
    "cluster": "Cluster(pathlib.Path(folder)).start_learner()\nif True:",
    "replacements": "Cluster(pathlib.Path(folder)).start_actor()\nif True:",
}
"""Statements that start processes."""
KILLED = """
import os, pathlib, psutil, signal, sys
from tests.benchmarks import shapes
from tests.cluster import Cluster
folder = sys.argv[1]
{statement}
    children = psutil.Process().children()
    print(*[child.pid for child in children], flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="uses prctl")
@pytest.mark.parametrize("name", STARTED)
def test_processes_end_with_a_killed_benchmark(tmp_path, name):
    done = python("-c", KILLED.format(statement=STARTED[name]), tmp_path)
    numbers = [int(number) for number in done.stdout.split()]
    assert numbers, done.stderr
    eventually(lambda: not any(map(psutil.pid_exists, numbers)))


def test_every_process_of_a_benchmark_follows_it():
    """The robot's node is an example for users; it ends when its topics are silent."""
    unbound = set()
    for path in pathlib.Path(__file__).parent.glob("*.py"):
        calls = [node for node in ast.walk(ast.parse(path.read_text())) if type(node) is ast.Call]
        starts = [call for call in map(ast.unparse, calls) if re.match(r"\w+\.Popen\(", call)]
        if not all("env=following(" in start for start in starts):
            unbound.add(path.name)
    assert unbound == {"robot.py"}
