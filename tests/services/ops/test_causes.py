"""Causes of a process's end, from logs of real deaths."""

import subprocess
import sys

import pytest

from congrasp.services.ops.causes import end_of
from congrasp.services.ops.lifetime import Child

PIPE = "Traceback (most recent call last):\n  File 'x'\nBrokenPipeError: [Errno 32] Broken pipe\n"
TRACE = "Traceback (most recent call last):\n  File 'x'\n"
CASES = {
    "gpu": ("E0101 10:00:00.1 7 x.cc:3] CUDA_ERROR_OUT_OF_MEMORY: out of memory\n", "GPU memory"),
    "xla": (f"{TRACE}XlaRuntimeError: RESOURCE_EXHAUSTED: Out of memory: 8 bytes.\n", "memory"),
    "python": (f"{TRACE}MemoryError\n", "out of memory"),
    "numpy": (f"{TRACE}numpy._ArrayMemoryError: Unable to allocate 9 GiB\n", "out of memory"),
    "c++": ("terminate called after throwing an instance of 'std::bad_alloc'\n", "out of memory"),
    "rust": ("memory allocation of 4096 bytes failed\n", "out of memory"),
    "errno": (f"{TRACE}OSError: [Errno 12] Cannot allocate memory\n", "out of memory"),
    "thread": (f"{TRACE}RuntimeError: can't start new thread\n", "out of threads or memory"),
    "import": (f"{TRACE}ImportError: libcudart.so.12: no such file\n", "libcudart.so.12"),
    "module": (f"{TRACE}ModuleNotFoundError: No module named 'warp'\n", "'warp'"),
    "command": ("congrasp: error: The disk of runs is full.\n", "The disk of runs is full"),
}


LIMITED = "import resource; resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30)); "


@pytest.mark.parametrize("code", [1, -6])
@pytest.mark.parametrize("after", ["", PIPE, "info: The actor actor-0 left.\n"])
@pytest.mark.parametrize(("log", "cause"), CASES.values(), ids=CASES)
def test_first_fatal_error_is_the_cause(log, cause, after, code):
    end = end_of("learner", code, f"info: Update 3.\n{log}{after}")
    assert cause in end
    assert "Broken pipe" not in end
    assert "\n" not in end
    assert end.startswith("The learner ")


def test_allocator_that_tries_again_is_no_cause():
    line = "W x] Allocator ran out of memory. The caller indicates that this is not a failure\n"
    assert "out of memory" not in end_of("actor", 1, f"{line}congrasp: error: It ended.\n")


def test_kill_by_the_kernel_is_named():
    assert "out of memory" in end_of("actor", -9, "", kernel_killed=True)
    assert end_of("actor", -9, "info: Update 3.") == "The actor was killed by SIGKILL."


class Program(Child):
    @property
    def program(self):
        return [sys.executable, "-c", self.arguments[0]]


DEATHS = {
    "bytes": (f"{LIMITED}bytes(4 << 30)", "out of memory"),
    "import": ("import no_such_module", "no_such_module"),
    "chained": (
        "import os\ntry:\n import no_such_module\nfinally:\n raise BrokenPipeError('pipe')",
        "no_such_module",
    ),
}


@pytest.mark.parametrize(("code", "cause"), DEATHS.values(), ids=DEATHS)
def test_death_of_a_process_names_its_cause(tmp_path, code, cause):
    child = Program("learner", [code], tmp_path / "learner.log")
    child.start()
    child.process.wait(60)
    assert cause in child.death()
    assert cause in child.cause()


def test_children_import_no_module_of_the_working_folder(tmp_path):
    (tmp_path / "random.py").write_text("raise SystemExit('a user wrote this')")
    program = Child("x", ["--version"], tmp_path / "log").program
    done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
