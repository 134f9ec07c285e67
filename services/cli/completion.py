"""`congrasp completion`: completion of commands and options in a shell."""

import ast
import contextlib
import io
import re
from collections.abc import Callable
from typing import Annotated, Any, Literal

import tyro

Shell = Literal["bash", "zsh", "fish"]
_SPEC = re.compile(r"^COMPLETION_SPEC = (.*)$", re.MULTILINE)
"""Line of tyro's scripts that holds the options and subcommands, as a literal of Python."""


def completion(shell: Annotated[Shell, tyro.conf.Positional]) -> int:
    """Print the script with which a shell completes the commands and options of congrasp.

    Args:
      shell: The shell.

    Examples:
      congrasp completion bash > ~/.local/share/bash-completion/completions/congrasp
      congrasp completion zsh > ~/.zfunc/_congrasp
      congrasp completion fish > ~/.config/fish/completions/congrasp.fish
    """
    print(script(shell))
    return 0


def script(shell: Shell) -> str:
    """Returns the completion script of all commands."""
    from congrasp.services.cli.main import COMMANDS

    subcommands = {}
    for name, description in COMMANDS.items():
        subcommands[name] = {"description": description, **spec_of(name)}
    empty = _printed(lambda words: tyro.cli(_nothing, prog="congrasp", args=words), shell)
    spec = {**_spec_in(empty), "prog": "congrasp", "subcommands": subcommands}
    return _SPEC.sub(lambda _: f"COMPLETION_SPEC = {spec!r}", empty)


def spec_of(name: str) -> dict[str, Any]:
    """Returns the options and subcommands of a command, as tyro describes them to shells."""
    from congrasp.services.cli.main import load

    return _spec_in(_printed(load(name), "bash"))


def _nothing() -> None:
    """A command without options, whose script is the frame of the others."""


def _printed(parse: Callable[[list[str]], Any], shell: Shell) -> str:
    """Returns the script that a parser prints for a shell."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        parse(["--tyro-print-completion", shell])
    return text.getvalue()


def _spec_in(text: str) -> dict[str, Any]:
    """Returns the description in a script."""
    match = _SPEC.search(text)
    if match is None:
        raise RuntimeError("The completion script of tyro has another form.")
    spec: dict[str, Any] = ast.literal_eval(match[1])
    return _on_one_line(spec)


def _on_one_line(spec: Any) -> Any:
    """Returns a description without line ends, at which shells would split it."""
    if isinstance(spec, dict):
        return {key: _on_one_line(value) for key, value in spec.items()}
    if isinstance(spec, list):
        return [_on_one_line(value) for value in spec]
    if isinstance(spec, str):
        return " ".join(spec.split())
    return spec


COMMAND = completion
