"""Parsing of a command line with errors of one line, in place of the parser's box."""

import contextlib
import io
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.services.cli import suggestions
from congrasp.services.cli.shell_specs import spec_of

_BORDER = "│"
_RULE = "─"
_SUGGESTS = "Perhaps you meant:"
"""Line of the box before similar options."""


class _Box(NamedTuple):
    """The parser's report of an error."""

    cause: str
    similar_options: list[str]


def parse(
    name: str, parser: Callable[[list[str]], Callable[[], Any]], arguments: list[str]
) -> Callable[[], Any]:
    """Returns the requested call of a command.

    Args:
      name: name of the command.
      parser: function from the arguments to the requested call.
      arguments: words after the command's name.

    Raises:
      CongraspError: the arguments are not those of the command.
      SystemExit: the help was requested, and is printed.
    """
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed):
            return parser(arguments)
    except SystemExit as end:
        if not end.code:
            raise
    box = _read_box(printed.getvalue())
    similar: Sequence[str] = box.similar_options
    mistyped = suggestions.unrecognized(box.cause)
    if mistyped and not similar:
        similar = suggestions.similar_words(mistyped, arguments, spec_of(parser))
    remedy = f"See 'congrasp {name} --help'."
    if similar:
        remedy = f"Perhaps you meant {' or '.join(similar)}. {remedy}"
    raise CongraspError(f"{suggestions.plain_error(box.cause)}.", remedy)


def _read_box(text: str) -> _Box:
    """Reads the cause, above the first rule in the box, and similar options, below it."""
    lines = [line.strip(f"{_BORDER} ") for line in text.splitlines() if line.startswith(_BORDER)]
    end_of_cause = len(lines)
    for index, line in enumerate(lines):
        if line.startswith(_RULE):
            end_of_cause = index
            break
    cause = " ".join(lines[:end_of_cause]).rstrip(".")
    rest = lines[end_of_cause:]
    options = []
    if _SUGGESTS in rest:
        options = [line.split()[0].rstrip(",") for line in rest if line.startswith("--")]
    return _Box(cause, options)
