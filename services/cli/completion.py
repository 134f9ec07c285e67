"""`congrasp completion`: completion of commands and options in a shell."""

from typing import Annotated, Literal

import tyro

from congrasp.services.cli import main
from congrasp.services.cli.shell_specs import SPEC, printed, spec_in, spec_of

Shell = Literal["bash", "zsh", "fish"]


def completion(shell: Annotated[Shell, tyro.conf.Positional]) -> int:
    """Print the script with which a shell completes the commands and options of congrasp.

    Write it to a file that the shell reads: ~/.local/share/bash-completion/completions/congrasp,
    ~/.zfunc/_congrasp or ~/.config/fish/completions/congrasp.fish.

    Args:
      shell: The shell.

    Examples:
      congrasp completion bash
      congrasp completion zsh
      congrasp completion fish
    """
    print(script(shell))
    return 0


def script(shell: Shell) -> str:
    """Returns the completion script of all commands."""
    subcommands = {}
    for name, description in main.COMMANDS.items():
        subcommands[name] = {"description": description, **spec_of(main.load(name))}
    empty = printed(lambda words: tyro.cli(_nothing, prog="congrasp", args=words), shell)
    spec = {**spec_in(empty), "prog": "congrasp", "subcommands": subcommands}
    return SPEC.sub(lambda _: f"COMPLETION_SPEC = {spec!r}", empty)


def _nothing() -> None:
    """A command without options, whose script is the frame of the others."""


COMMAND = completion
