"""Work spread over processes, as scripts of users have it."""

import operator
import os
import pathlib
import signal
import subprocess
import sys
import time

import psutil
import pytest

import congrasp
from congrasp.common.runtime import parallel
from congrasp.common.runtime.parallel import parallel_map
from congrasp.common.runtime.resources import cores
from tests.children import python

_ROOT = pathlib.Path(congrasp.__file__).parents[1]
_SPREAD = """
import time
from congrasp.common.runtime.parallel import parallel_map
parallel_map(time.sleep, [60.0] * 200)
"""
_SCRIPTS = {
    "make_vec": """
        import congrasp
        envs = congrasp.make_vec(num_envs=2)
        print("RESULT", envs.num_envs)
        envs.close()
    """,
    "grasp": """
        import congrasp
        found = congrasp.grasp("mug:7", heading=(0, 0, -1), attempts=2)
        print("RESULT", found.attempts)
    """,
    "evaluate": """
        from congrasp.services.cli.main import run
        code = run("evaluate --table objects --episodes 2 --physics native".split())
        print("RESULT", 2 - code)
    """,
    "thread": """
        import threading
        from congrasp.common.objects.procedural import generate_many
        thread = threading.Thread(target=lambda: print("RESULT", len(generate_many(64, 0))))
        thread.start()
        thread.join()
    """,
    "a class of the script": """
        from congrasp.common.runtime.parallel import parallel_map
        class Mass:
            def __abs__(self):
                return 2
        print("RESULT", sum(parallel_map(abs, [Mass() for _ in range(64)])) // 64)
    """,
}
_INTERRUPTED = f"""
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job may ignore it
try:
    {_SPREAD.strip().replace(chr(10), chr(10) + "    ")}
except KeyboardInterrupt:
    pass
"""
_UNTOUCHED = """
import logging, os, signal
import gymnasium, jax, mujoco, trimesh  # some set variables themselves

def state():
    root = logging.getLogger()
    handlers = [signal.getsignal(number) for number in signal.valid_signals()]
    return dict(os.environ), list(root.handlers), root.level, handlers, signal.set_wakeup_fd(-1)

before = state()
import congrasp
for name in congrasp.__all__:
    getattr(congrasp, name)
after = state()
print([(a, b) for a, b in zip(before, after) if a != b])
"""

two_cores = pytest.mark.skipif(cores() < 2, reason="one core: nothing is spread")


@pytest.mark.parametrize("count", [3, 200])
def test_results_are_those_of_map(count, monkeypatch):
    monkeypatch.setattr(parallel.os, "sched_getaffinity", lambda pid: {0, 1})
    assert parallel_map(operator.sub, range(count), [1] * count) == [i - 1 for i in range(count)]


@two_cores
def test_an_error_of_a_call_is_raised_as_by_map():
    with pytest.raises(ZeroDivisionError):
        parallel_map(operator.truediv, [1] * 80, [*range(1, 80), 0])


@two_cores
def test_workers_compute_with_one_thread():
    script = """
import os
from congrasp.common.runtime.parallel import parallel_map
print(set(parallel_map(os.getenv, ["OMP_NUM_THREADS"] * 64)))
"""
    done = python("-c", script, env={"OMP_NUM_THREADS": "4"})
    assert done.stdout == "{'1'}\n", done.stderr


@two_cores
def test_helper_survives_a_request_that_it_cannot_run(tmp_path):
    """A request from a folder that is gone runs in the caller, the next one in the same helper,
    whose session the workers share.
    """
    script = """
import os, sys
from congrasp.common.runtime.parallel import parallel_map
before = parallel_map(os.getsid, [0] * 64)
current_folder = os.getcwd
os.getcwd = lambda: sys.argv[1]
in_caller = parallel_map(os.getsid, [0] * 64)
os.getcwd = current_folder
after = parallel_map(os.getsid, [0] * 64)
print(set(in_caller) == {os.getsid(0)}, before == after, os.getsid(0) in before)
"""
    done = python("-c", script, tmp_path / "absent")
    assert done.stdout == "True True False\n", done.stderr


@two_cores
@pytest.mark.parametrize(
    ("kind", "by"),
    [
        *(
            pytest.param(kind, by, marks=pytest.mark.slow)
            for kind, by in (  # compile
                ("make_vec", "file"),
                ("grasp", "file"),
                ("grasp", "stdin"),
                ("evaluate", "stdin"),
            )
        ),
        ("thread", "file"),
        ("thread", "stdin"),
        ("thread", "interpreter"),
        ("a class of the script", "file"),
    ],
)
def test_a_script_without_a_guard_runs_once(kind, by, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(f'print("started", __name__)\n{_dedented(_SCRIPTS[kind])}')
    command = [sys.executable, {"file": script, "stdin": "-", "interpreter": "-i"}[by]]
    with script.open() as stdin:
        done = subprocess.run(
            command, stdin=stdin, capture_output=True, text=True, cwd=_ROOT, timeout=600
        )
    lines = [line for line in done.stdout.splitlines() if line.startswith(("started", "RESULT"))]
    assert lines == ["started __main__", f"RESULT {64 if kind == 'thread' else 2}"], done.stderr
    assert done.returncode == 0
    assert "Traceback" not in done.stderr


def _dedented(text):
    return "\n".join(line.removeprefix(" " * 8) for line in text.splitlines())


def test_the_public_names_change_neither_environment_nor_logging_nor_signals():
    done = python("-c", _UNTOUCHED)
    assert done.stdout == "[]\n", done.stderr


@two_cores
def test_workers_end_with_a_killed_parent(tmp_path):
    script = tmp_path / "spread.py"
    script.write_text(_SPREAD)
    parent = subprocess.Popen([sys.executable, script], cwd=_ROOT)
    try:
        deadline = time.monotonic() + 60
        workers: list[psutil.Process] = []
        while len(workers) < 3 and time.monotonic() < deadline:  # the helper and two workers
            time.sleep(0.1)
            workers = psutil.Process(parent.pid).children(recursive=True)
        assert len(workers) >= 3
        time.sleep(1.0)  # they have begun
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        _, alive = psutil.wait_procs(workers, timeout=15)
        assert not alive
    finally:
        parent.kill()


@two_cores
def test_interrupted_workers_print_nothing(tmp_path):
    script = tmp_path / "spread.py"
    script.write_text(_INTERRUPTED)
    command = [sys.executable, script]
    parent = subprocess.Popen(
        command, cwd=_ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        deadline = time.monotonic() + 60
        workers: list[psutil.Process] = []
        while len(workers) < 3 and time.monotonic() < deadline:
            time.sleep(0.1)
            workers = psutil.Process(parent.pid).children(recursive=True)
        os.killpg(parent.pid, signal.SIGINT)  # as a terminal does
        _, error = parent.communicate(timeout=30)
        _, alive = psutil.wait_procs(workers, timeout=15)
        assert not alive
        assert error == ""
    finally:
        parent.kill()
