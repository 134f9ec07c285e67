"""Commands own their process: variables, signals and folders left over from other programs change
nothing.
"""

import functools
import pathlib
import signal
import subprocess
import sys

import pytest

from congrasp.common.transport.ports import local_url
from tests.children import following, python

NAMES = ("random", "json", "types", "logging", "numpy", "jax", "mujoco", "trimesh", "rich", "tyro")
"""Modules that a user's folder may have, too."""
CHILD = """
import pathlib
from congrasp.services.ops.lifetime import Child
child = Child("list", ["hands", "list"], pathlib.Path("list.log"))
child.start()
child.process.wait(100)
print(child.code, child.log.read_text())
"""


def output(*arguments: str, env: dict[str, str] | None = None, **options) -> str:
    """Standard output of a command."""
    done = python(*arguments, env={"COLUMNS": "80", **(env or {})}, **options)
    assert done.returncode == 0, done.stderr
    return done.stdout


@functools.cache
def plain(*arguments: str) -> str:
    """Standard output of a command without leftovers."""
    text = output("-m", "congrasp", *arguments)
    assert text.count("\n") > 4
    return text


LEFTOVERS = [
    {"COLUMNS": "1", "LINES": "0"},
    {"COLUMNS": "wide"},
    {"MUJOCO_GL": "osmesa"},
    {"MUJOCO_GL": "foo"},
    {"MPLBACKEND": "module://matplotlib_inline.backend_inline"},
    {"PYTHONOPTIMIZE": "2"},
    {"PYTHONINSPECT": "1"},
    {"PYTHONWARNINGS": "error"},
    {"JAX_ENABLE_X64": "1", "JAX_NUMPY_RANK_PROMOTION": "raise", "JAX_DISABLE_JIT": "1"},
    {"LC_ALL": "POSIX"},
]
TOGETHER = {
    "COLUMNS": "0",
    "MUJOCO_GL": "osmesa",
    "MPLBACKEND": "module://absent",
    "PYTHONOPTIMIZE": "2",
    "PYTHONINSPECT": "1",
    "PYTHONWARNINGS": "error",
    "JAX_ENABLE_X64": "1",
    "JAX_NUMPY_RANK_PROMOTION": "raise",
}


@pytest.mark.parametrize(
    "variables",
    [TOGETHER, *[pytest.param(one, marks=pytest.mark.slow) for one in LEFTOVERS]],
    ids=lambda variables: "-".join(variables),
)
def test_variables_change_no_command(variables):
    assert output("-m", "congrasp", "hands", "list", env=variables) == plain("hands", "list")


@pytest.mark.parametrize("command", ["hands", "grasp", "export"])
def test_help_without_docstrings_is_the_same(command):
    variables = {"PYTHONOPTIMIZE": "2"}
    assert output("-m", "congrasp", command, "--help", env=variables) == plain(command, "--help")


def test_an_interactive_end_keeps_the_exit_code():
    done = python("-m", "congrasp", "levitate", env={"PYTHONINSPECT": "1"})
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr


INHERITED = """
import os, signal, sys
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
"""
"""Starts Python with settings of signals as some programs leave them to those that they start."""
EXIT_CODE = """
import subprocess, sys
from congrasp.services.cli.process import restore_signals
restore_signals()
print(subprocess.run([sys.executable, "-c", "raise SystemExit(3)"]).returncode)
"""


def test_exit_codes_of_children_are_not_lost():
    assert output("-c", INHERITED, "-c", EXIT_CODE) == "3\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_blocked_signals_stop_a_command(number):
    url = local_url()
    command = [sys.executable, "-c", INHERITED, "-m", "congrasp", "actor", "--connect", url]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=following()
    ) as process:
        for line in process.stdout:
            if url in line:
                break
        process.send_signal(number)
        process.communicate(timeout=60)
    assert process.returncode == 128 + number


def test_variables_do_not_reach_libraries():
    code = "from congrasp.services.cli.main import run; run(['hands', 'list'])\n"
    code += "import jax, matplotlib, mujoco, os\n"
    code += "print(jax.config.jax_enable_x64, matplotlib.get_backend(), os.environ['MUJOCO_GL'])"
    variables = {"JAX_ENABLE_X64": "1", "MPLBACKEND": "module://absent", "MUJOCO_GL": "osmesa"}
    assert output("-c", code, env=variables).splitlines()[-1] == "False Agg disable"


@pytest.fixture
def folder(tmp_path) -> pathlib.Path:
    """A folder whose modules have names of Python's."""
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text("raise SystemExit('a module of the user')\n")
    return tmp_path


def test_modules_of_the_folder_are_not_imported(folder):
    assert output("-m", "congrasp", "hands", "list", cwd=folder) == plain("hands", "list")


def test_children_do_not_import_modules_of_the_folder(folder):
    text = output("-P", "-c", CHILD, cwd=folder)
    assert text.startswith("0 ")
    assert plain("hands", "list") in text
