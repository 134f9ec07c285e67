"""The same commands on a system without fcntl, resource limits, forks, /proc, symbolic links and
most signals, see `sitecustomize`.
"""

import contextlib
import json
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from congrasp.common.transport.ports import local_url
from tests.base_install import BASE_INSTALL, steady_server

ROOT = pathlib.Path(__file__).resolve().parents[2]
LACKING = pathlib.Path(__file__).parent
MUG = ROOT / "examples" / "mug.obj"


def _environment(tmp_path: pathlib.Path) -> dict[str, str]:
    """Environment of a process on the other system; `missed` reads what it has missed."""
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(LACKING), str(ROOT)]),
        "PYTHONWARNDEFAULTENCODING": "1",
        "TRACE_LACKS": str(tmp_path / "lacks.txt"),
    }


def missed(tmp_path: pathlib.Path) -> set[str]:
    """Names that congrasp's modules looked for, and the other system lacks."""
    return set((tmp_path / "lacks.txt").read_text().split("\n"))


def run(tmp_path: pathlib.Path, *arguments: object, timeout: float = 300) -> str:
    """Runs Python on the other system; returns what it printed, and prints a failure."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=_environment(tmp_path),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    print(f"$ {' '.join(map(str, arguments))[:200]}\n{done.stdout}{done.stderr}")
    assert done.returncode == 0, done.stderr
    return done.stdout


@contextlib.contextmanager
def serving(tmp_path: pathlib.Path, policy: pathlib.Path) -> Iterator[str]:
    """URL of a server on the other system."""
    url = local_url()
    command = [sys.executable, "-m", "congrasp", "serve", "--policy", policy, "--listen", url]
    with subprocess.Popen(
        command, env=_environment(tmp_path), stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as server:
        try:
            yield url
        finally:
            server.terminate()
            print(server.communicate(timeout=30)[0].decode())


def test_a_client_needs_numpy_and_zenoh_alone(tmp_path):
    code = """
import congrasp
with congrasp.PolicyClient("tcp/127.0.0.1:PORT", hand="allegro", wait=30.0) as policy:
    print(len(policy.metadata()["open_pose"]))
"""
    with steady_server() as port:
        printed = run(tmp_path, "-c", BASE_INSTALL + code.replace("PORT", str(port)))
    assert printed.split() == ["16"]
    assert {"resource", "os.register_at_fork"} <= missed(tmp_path)


FILES = """
import pathlib, operator
import numpy as np
from congrasp.common.runtime.parallel import parallel_map
from congrasp.learner.checkpoint import Checkpoints
from congrasp.learner.run_directory import exclusive

notices = []
folder = pathlib.Path("run")
folder.mkdir()
with exclusive(folder, notices.append) as check:
    for version in range(5):
        check()
        Checkpoints(folder / "checkpoints").save({"x": np.full(3, version)}, {}, version)
print(notices[0].partition(":")[2])
print((folder / "checkpoints" / "latest").read_text().strip())
if __name__ == "__main__":
    print(sum(parallel_map(operator.sub, range(200), [1] * 200)))
"""


def test_files_and_workers(tmp_path):
    """Locks are claims, links are files, and workers do not import the script."""
    script = tmp_path / "script.py"
    script.write_text(FILES)
    lines = run(tmp_path, script).splitlines()
    assert lines == [
        " claim stands in for one.",
        "checkpoint_000000004.safetensors",
        str(sum(range(200)) - 200),
    ]
    assert {"fcntl", "symlink", "os.O_DIRECTORY", "os.sched_getaffinity"} <= missed(tmp_path)


CONFINED = """
import json, logging, pathlib, sys, tempfile, time
from congrasp.common.runtime.confinement import Limits
from congrasp.services.assets.confined import OutOfResources, call_confined
from tests.other_system import greedy

records = []
handler = logging.Handler()
handler.emit = records.append
logging.getLogger("congrasp").addHandler(handler)
logging.getLogger("congrasp").setLevel("INFO")
limits = Limits(memory=300 << 20, processor_s=2.0, patience_s=50.0)
for function in (greedy.allocate, greedy.compute):
    began = time.monotonic()
    try:
        call_confined(function, pathlib.Path(tempfile.mkdtemp()), {}, limits)
    except OutOfResources as error:
        print(error)
print(len(records))
"""


def test_confined_processes_are_watched(tmp_path):
    lines = run(tmp_path, "-c", CONFINED).splitlines()
    assert lines == [
        "took more than 0.314573 GB of memory",
        "took longer than 2 s of processor time",
        "1",
    ]


CHILD = """
from congrasp.services.ops.lifetime import follow_parent, on_signal

follow_parent()
with on_signal() as stop:
    print("ready", flush=True)
    stop.wait(60)
print(stop.reason, flush=True)
"""
PARENT = f"""
import os, subprocess, sys

environment = {{**os.environ, "CONGRASP_PARENT": str(os.getpid())}}
subprocess.run([sys.executable, "-c", {CHILD!r}], env=environment)
"""


def test_a_child_ends_with_its_parent(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", PARENT],
        env=_environment(tmp_path),
        stdout=subprocess.PIPE,
        text=True,
    ) as parent:
        assert parent.stdout.readline() == "ready\n"
        parent.kill()
        assert parent.stdout.readline() == "stopped by SIGTERM\n"


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_an_object_is_imported_and_grasped(tmp_path):
    run(tmp_path, "-m", "congrasp", "objects", "import", MUG, "--out", "objects", "--unit", "m")
    assert (tmp_path / "objects").is_dir()
    options = ("--attempts", "4", "--physics", "native", "--out", "grasps")
    run(tmp_path, "-m", "congrasp", "grasp", MUG, *options, timeout=470)
    (result,) = (tmp_path / "grasps").rglob("result.json")
    assert json.loads(result.read_text(encoding="utf-8"))["attempts"]


@pytest.mark.timeout(900)
@pytest.mark.slow
def test_a_policy_is_trained_and_served(tmp_path):
    run(
        tmp_path,
        *("-m", "congrasp", "train", "--preset", "check", "--actors", "1", "--run-dir", "run"),
        timeout=470,
    )
    policy = tmp_path / "run" / "policy.safetensors"
    with serving(tmp_path, policy) as url:
        deadline = time.monotonic() + 200
        while time.monotonic() < deadline:
            with contextlib.suppress(AssertionError):
                run(tmp_path, *("-m", "congrasp", "query", "--connect", url, "--health"))
                break
        run(tmp_path, *("-m", "congrasp", "query", "--connect", url))
    assert {"fcntl", "resource", "symlink"} <= missed(tmp_path)
