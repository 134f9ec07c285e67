"""Descriptions of commands that tyro writes into completion scripts: their options and
subcommands.
"""

import ast
import contextlib
import io
import re
from collections.abc import Callable
from typing import Any

Parse = Callable[[list[str]], Any]
"""Parser of a command's arguments."""
SPEC = re.compile(r"^COMPLETION_SPEC = (.*)$", re.MULTILINE)
"""Line of tyro's scripts that holds the options and subcommands, as a literal of Python."""


def spec_of(parse: Parse) -> dict[str, Any]:
    """Returns the options and subcommands of a command, as tyro describes them to shells."""
    return spec_in(printed(parse, "bash"))


def printed(parse: Callable[[list[str]], Any], shell: str) -> str:
    """Returns the script that a parser prints for a shell."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        parse(["--tyro-print-completion", shell])
    return text.getvalue()


def spec_in(text: str) -> dict[str, Any]:
    """Returns the description in a script."""
    match = SPEC.search(text)
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
