"""The documentation: it builds without a warning, its commands parse, and the tutorials' commands run."""

import os
import pathlib
import re
import shlex
import shutil
import subprocess
import sys

import pytest

from actors.env import episode_fields
from common.config import TaskConfig
from common.task.constraints import CONSTRAINTS
from services.cli import main

ROOT = pathlib.Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "deploy" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.M | re.S)
PLACEHOLDERS = re.compile(r"…|\.\.\.|[A-Z]*FOLDER|<\w+>")


def blocks(page, *languages):
    return [text for language, text in BLOCK.findall(page.read_text()) if language in languages]


def command_lines():
    for page in PAGES:
        for block in blocks(page, "sh", "text", "console"):
            for line in block.replace("\\\n", " ").splitlines():
                if found := re.match(r"^(?:\$ )?(?:\.venv/bin/)?congrasp (.*)", line):
                    yield pytest.param(found[1], id=f"{page.stem}: {found[1][:60]}")


@pytest.mark.parametrize("line", list(command_lines()))
def test_every_command_line_parses(line):
    """Names of commands and options are right, and values have the right form; nothing is run."""
    words = shlex.split(PLACEHOLDERS.sub("x", line), comments=True)
    for stop in ("|", "&&", "&", ">"):
        words = words[: words.index(stop)] if stop in words else words
    assert words[0] in main.COMMANDS
    if len(words) > 1 and words[1] != "--help":
        main._parsed(words[0], main.load(words[0]), words[1:])


def test_the_site_builds_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "docs", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    commands = (tmp_path / "reference" / "commands.html").read_text()
    assert all(f"congrasp {name}" in commands for name in main.COMMANDS)
    assert "--ppo.learning-rate" in (tmp_path / "reference" / "configuration.html").read_text()


def test_metrics_of_episodes_are_documented():
    page = (ROOT / "docs" / "reference" / "metrics.md").read_text()
    known = set(re.findall(r"`([^`]+)`", page))
    for name in episode_fields(TaskConfig(constraints=tuple(constraint.name for constraint in CONSTRAINTS))):
        assert name in known or name.startswith(("episode/mask_", "term/")), name


@pytest.mark.timeout(600)
def test_the_commands_of_the_tutorials_run(tmp_path):
    """A stranger's first ten minutes, in an empty folder; what takes minutes is marked as text there."""
    pages = [ROOT / "docs" / "tutorials" / f"{name}.md" for name in ("my-object", "constraints")]
    (python,) = blocks(pages[0], "python")
    binaries = pathlib.Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{binaries}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    assert shutil.which("congrasp", path=environment["PATH"]), "the package is not installed beside this Python"
    lines = [
        shlex.join([sys.executable, "-c", python]),
        *"".join(text for page in pages for text in blocks(page, "sh")).splitlines(),
    ]
    for line in lines:
        done = subprocess.run(
            line,
            shell=True,
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=280,
        )
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    for name in ("grasp.npz", "grasp.mcap", "object.png", "grasp.mp4"):
        assert (tmp_path / "grasps" / "can" / name).stat().st_size > 1000
    assert (tmp_path / "mug.png").stat().st_size > 1000
