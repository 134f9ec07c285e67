"""The documentation: it builds without a warning, its commands parse, and the tutorials' commands
run.
"""

import importlib
import inspect
import itertools
import os
import pathlib
import re
import runpy
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
import trimesh
import tyro

import congrasp
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.metrics import episode_fields
from congrasp.services.cli import main, parse_errors, parser
from congrasp.services.viz.metric_titles import TITLES
from tests.base_install import run_in_base_install, steady_server

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
                if match := re.match(r"^(?:\$ )?(?:\.venv/bin/)?congrasp (.*)", line):
                    yield pytest.param(match[1], id=f"{page.stem}: {match[1][:60]}")


def commands_of_modules():
    for name in main.COMMANDS:
        module = main.module_of(name)
        for below, function in (getattr(module, "COMMANDS", None) or {"": module.COMMAND}).items():
            yield pytest.param((name, function), id=f"{name} {below}".strip())


@pytest.mark.parametrize("line", list(command_lines()))
def test_every_command_line_parses(line):
    """Names of commands and options are right, values have the right form, and examples exist;
    nothing is run.
    """
    for name in re.findall(r"\bexamples/[\w.-]+", line):
        assert (ROOT / name).is_file(), name
    words = shlex.split(PLACEHOLDERS.sub("x", line), comments=True)
    for stop in ("|", "&&", "&", ">"):
        words = words[: words.index(stop)] if stop in words else words
    assert words[0] in main.COMMANDS
    if len(words) > 1 and words[1] != "--help":
        parse_errors.parse(words[0], main.load(words[0]), words[1:])


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-b",
        "html",
        "docs",
        str(tmp_path),
    ]
    environment = {**os.environ, "CONGRASP_REPOSITORY": "https://example.org/congrasp/"}
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=200, env=environment
    )
    assert done.returncode == 0, done.stderr
    questions = (tmp_path / "faq.html").read_text()
    assert 'href="https://example.org/congrasp/edit/main/docs/faq.md"' in questions
    assert f"congrasp {congrasp.__version__}" in questions
    assert 'action="search.html"' in questions
    assert "afford" in (tmp_path / "searchindex.js").read_text()
    commands = (tmp_path / "reference" / "commands.html").read_text()
    assert all(f"congrasp {name}" in commands for name in main.COMMANDS)
    assert "tall.glb" in (tmp_path / "files.html").read_text()
    assert "--ppo.learning-rate" in (tmp_path / "reference" / "configuration.html").read_text()


def test_metrics_of_episodes_are_documented():
    for name in episode_fields(
        TaskConfig(constraints=tuple(constraint.name for constraint in CONSTRAINTS))
    ):
        assert name in TITLES or name.startswith("term/"), name


@pytest.mark.parametrize("command", list(commands_of_modules()))
def test_every_help_page_ends_with_examples_that_parse(command):
    """Two for a command that takes anything, one for others."""
    _, function = command
    lines = parser.examples(function)
    assert len(lines) >= (2 if inspect.signature(function).parameters else 1)
    for line in lines:
        program, name, *rest = shlex.split(line)
        assert program == "congrasp"
        parse_errors.parse(name, main.load(name), rest)


def test_help_pages_show_no_parser_internals(capsys):
    """Of every command, its options as they are typed: nothing of the parser's own types and
    headings.
    """
    for name in main.COMMANDS:
        for words in (
            [name],
            *([name, below] for below in getattr(main.module_of(name), "COMMANDS", ())),
        ):
            with pytest.raises(SystemExit):
                main.load(name)([*words[1:], "--help"])
            page = capsys.readouterr().out
            assert f"\n  congrasp {' '.join(words)}" in page, words
            for noise in (
                "{None}",
                "None}",
                "options options",
                "[[",
                "(default: )",
                "(default: None)",
            ):
                assert noise not in page, (words, noise)


def test_the_example_mug_equals_the_output_of_its_code(tmp_path):
    runpy.run_path(str(ROOT / "examples" / "make_mug.py"))["main"](tmp_path)
    for name in ("mug.obj", "handle.obj"):
        generated, shipped = (
            trimesh.load(folder / name) for folder in (tmp_path, ROOT / "examples")
        )
        assert (ROOT / "examples" / name).stat().st_size < 200_000
        assert shipped.is_watertight
        np.testing.assert_allclose(generated.vertices, shipped.vertices, atol=2e-5)
        np.testing.assert_array_equal(generated.faces, shipped.faces)


@pytest.mark.timeout(600)
@pytest.mark.slow
def test_the_commands_of_the_tutorials_run(tmp_path, monkeypatch):
    """A stranger's first ten minutes, in a folder with the examples; what takes minutes is marked
    as text there.

    The script is there and starts; the commands themselves run in this process, which has its
    libraries already.
    """
    script = shutil.which("congrasp", path=pathlib.Path(sys.executable).parent)
    assert script, "the package is not installed beside this Python"
    assert subprocess.run([script, "--help"], capture_output=True, timeout=60, check=True).stdout
    for name in (
        "JAX_COMPILATION_CACHE_DIR",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
        "MUJOCO_GL",
    ):
        monkeypatch.setenv(name, os.environ.get(name, {"MUJOCO_GL": "disable"}.get(name, "0")))
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    pages = [ROOT / "docs" / "tutorials" / f"{name}.md" for name in ("my-object", "constraints")]
    text = "".join(itertools.chain.from_iterable(blocks(page, "sh") for page in pages))
    lines = text.splitlines()
    assert len(lines) == 4
    for line in lines:
        program, *arguments = shlex.split(line, comments=True)
        assert program == "congrasp"
        assert main.run(arguments) == 0, line
    for name in ("grasp.npz", "grasp.mcap", "object.png", "grasp.mp4"):
        assert (tmp_path / "grasps" / "mug" / name).stat().st_size > 1000
    for name in ("mug.glb", "mug.png"):
        assert (tmp_path / name).stat().st_size > 1000


def test_the_loop_of_the_robots_page_runs_as_printed_with_numpy_and_zenoh_alone():
    """Against a policy that wants every joint at zero; only the port is another."""
    code = "\n".join(blocks(ROOT / "docs" / "robots.md", "python"))
    with steady_server() as port:
        done = run_in_base_install(code.replace("127.0.0.1:7457", f"127.0.0.1:{port}"))
    assert done.returncode == 0, done.stderr
    counted = dict(re.findall(r"(\w+)=(\d+)", done.stdout))
    assert done.stdout.startswith("open Counters(")
    assert counted["steps"] == "251"
    assert int(counted["follow"]) >= 200
    assert int(counted["fallback"]) == 1


def example_lines():
    pages = (ROOT / "docs" / name for name in ("robots.md", "ros2.md"))
    text = "".join(itertools.chain.from_iterable(blocks(page, "sh") for page in pages))
    text = text.replace("\\\n", " ")
    return [line for line in text.splitlines() if line.startswith("python examples/")]


@pytest.mark.parametrize("line", example_lines())
def test_the_examples_of_the_robots_pages_take_their_options(line, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples")
    _, script, *words = shlex.split(line, comments=True)
    tyro.cli(importlib.import_module(pathlib.Path(script).stem).Arguments, args=words)
