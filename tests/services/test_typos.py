"""Mistyped commands, options and numbers, and completion in a shell."""

import shlex
import subprocess

import pytest

from congrasp.common.shell import shell_command
from congrasp.services.cli import completion
from congrasp.services.cli.suggestions import command_remedy, nearest_option, plain_error
from tests.printed import errors

COMMANDS = ["train", "learner", "evaluate", "objects"]


@pytest.mark.parametrize(
    ("line", "meant"),
    [
        ("--hlep", "congrasp --help"),
        ("--verison", "congrasp --version"),
        ("help", "congrasp --help"),
        ("hepl", "congrasp --help"),
        ("help trian", "congrasp train --help"),
        ("version", "congrasp --version"),
        ("-V", "congrasp --version"),
        ("Train", "congrasp train"),
        ("evalute", "congrasp evaluate"),
        ("xyzzy", "train, learner"),
    ],
)
def test_remedy_of_unknown_command(line, meant):
    assert meant in command_remedy(line.split(), COMMANDS)


@pytest.mark.parametrize(
    ("option", "meant"),
    [
        ("--task.reward.heigth", "--task.reward.height"),
        ("--task.rewrad.height", "--task.reward.height"),
        ("--hlep", "--help"),
        ("--Updates", "--updates"),
        ("--zzzzzz", ""),
    ],
)
def test_nearest_option(option, meant):
    names = ["--task.reward.height", "--task.reward.force", "--help", "--updates"]
    assert nearest_option(option, names) == meant


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        (
            "Error parsing --updates: invalid literal for int() with base 10: '1e3'",
            "--updates is '1e3', which is not a whole number",
        ),
        (
            "Error parsing --a.b: could not convert string to float: '1,5'",
            "--a.b is '1,5', which is not a number",
        ),
        ("Missing --connect", "Missing --connect"),
    ],
)
def test_plain_error(text, plain):
    assert plain_error(text) == plain


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--hlep", ["'--hlep'", "--help"]),
        ("help", ["'help'", "--help"]),
        ("query --repaet 3", ["--repaet", "--repeat"]),
        ("query --hlep", ["--help"]),
        ("query --repeat 2.5", ["--repeat", "'2.5'"]),
        ("query --rate nan", ["--rate", "nan"]),
        ("objects lst", ["lst", "list"]),
        ("train --actors two", ["--actors", "'two'", "whole number"]),
        ("train --ppo.learning-rat 1", ["--ppo.learning-rate"]),
        ("train --ppo.learning-rate nan", ["--ppo.learning-rate", "nan"]),
        ("grasp mug:0 --size 720p", ["--size", "--video"]),
        ("grasp mug:0 --fps 30", ["--fps", "--video"]),
    ],
)
def test_typo_is_one_line(line, words, exit_code_of, capfd):
    assert exit_code_of(line.split()) == 2
    (error,) = errors(capfd.readouterr().err)
    assert all(word in error for word in words)
    assert "literal" not in error


@pytest.fixture(scope="module")
def bash_script(tmp_path_factory):
    """File of the completion script for bash."""
    path = tmp_path_factory.mktemp("completion") / "congrasp.bash"
    path.write_text(completion.script("bash"))
    return path


def completed(script, line):
    """Completions of the last word of a line in bash."""
    words = line.split(" ")
    code = (
        f"source {shlex.quote(str(script))}; COMP_WORDS=({shlex.join(words)}); "
        f"COMP_CWORD={len(words) - 1}; "
        "$(complete -p congrasp | sed 's/.*-F \\([^ ]*\\) .*/\\1/'); printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_bash_accepts_the_script(bash_script):
    subprocess.run(["bash", "-n", bash_script], check=True)
    done = subprocess.run(["bash", bash_script], capture_output=True, text=True, check=True)
    assert done.stdout == ""
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("line", "completions"),
    [
        ("congrasp eval", {"evaluate"}),
        ("congrasp co", {"constraints", "completion"}),
        ("congrasp query --rep", {"--repeat"}),
        ("congrasp objects im", {"import"}),
        ("congrasp objects import --mat", {"--material"}),
        ("congrasp train --ppo.learning-rate-", {"--ppo.learning-rate-range"}),
    ],
)
def test_bash_completes(bash_script, line, completions):
    assert set(completed(bash_script, line)) == completions


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_script_has_all_commands(shell):
    text = completion.script(shell)
    assert "'evaluate'" in text
    assert "--repeat" in text
    assert "Examples:" not in text


@pytest.mark.parametrize("path", ["runs/a", "my runs/try [lr=0.1] a", "it's", "$HOME"])
def test_shell_command_is_read_back(path):
    command = shell_command("congrasp", "view", path)
    done = subprocess.run(
        ["bash", "-c", f"printf '%s\\n' {command}"], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines() == ["congrasp", "view", path]
