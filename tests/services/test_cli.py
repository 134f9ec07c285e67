"""The command line as a user meets it: help, and one clear line for bad input."""

import re
import subprocess
import sys

import pytest

from services.cli.main import COMMANDS, load


def congrasp(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs the command line in a process of its own."""
    command = [sys.executable, "-m", "services.cli.main", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_help_names_every_command_and_every_command_exists():
    done = congrasp("--help")
    assert done.returncode == 0
    for name in COMMANDS:
        assert name in done.stdout
        load(name)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["levitate"], "no command 'levitate'"),
        (["train", "--preset", "nonsense"], "no preset 'nonsense'"),
        (["train", "--task.hand", "paw"], "no hand 'paw'"),
        (["train", "--resume", "--run-dir", "/nonexistent-run"], "is not a run directory"),
        (["train", "--physics", "warp", "--run-dir", "/nonexistent-run"], "NVIDIA GPU"),
        (["evaluate", "--policy", "/nonexistent.safetensors"], "cannot be read"),
        (["serve", "--hand", "paw"], "no hand 'paw'"),
        (["serve", "--policy", "/nonexistent.safetensors"], "cannot be read"),
        (["serve", "--policy", "a.safetensors", "--connect", "tcp/127.0.0.1:1"], "either a.safetensors or"),
        (["actor", "--connect", "nonsense"], "endpoint"),
        (["query", "--connect", "tcp/127.0.0.1:1", "--repeat", "2"], "127.0.0.1:1"),
        (["plot", "/nonexistent-run"], "nonexistent-run"),
    ],
)
def test_bad_input_is_one_line_and_a_non_zero_exit(arguments, words):
    done = congrasp(*arguments)
    assert done.returncode not in (0, 1), done.stderr
    assert "Traceback" not in done.stderr
    assert re.search(words, done.stderr), done.stderr


def test_the_client_needs_neither_jax_nor_mujoco():
    code = (
        "import sys\n"
        "for name in ('jax', 'flax', 'mujoco', 'scipy', 'trimesh', 'mcap', 'tyro', 'rich', 'dacite'):\n"
        "    sys.modules[name] = None\n"
        "import services.client\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
