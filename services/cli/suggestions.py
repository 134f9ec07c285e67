"""Suggestions for mistyped commands and options, and errors of the parser in plain words."""

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

_CUTOFF = 0.6
"""Least similarity of a suggestion."""
_NUMBER = re.compile(
    r"Error parsing (?P<option>\S+): "
    r"(?:no type matching .*Got errors:\s*- <class '(?:int|float)'>: )?"  # a number or none
    r"(?:invalid literal for int\(\) with base 10"
    r"|could not convert string to float): (?P<value>.*)",
    re.DOTALL,
)
_UNRECOGNIZED = re.compile(r"Unrecognized options: (?P<words>.*)", re.DOTALL)
_GLOBAL = ("--help", "--version")
"""Options without a command."""
_WORDS = {"help": "--help", "version": "--version", "-v": "--version", "-V": "--version"}
"""Commands and options of other programs, and their equivalents."""


def nearest(word: str, names: Iterable[str]) -> str:
    """Returns the name that is most similar to a word, without regard to case; empty if none is."""
    by_lower_case = {name.lower(): name for name in names}
    matches = difflib.get_close_matches(word.lower(), by_lower_case, 1, _CUTOFF)
    return by_lower_case[matches[0]] if matches else ""


def nearest_option(word: str, names: Sequence[str]) -> str:
    """Returns the option that a word resembles; empty if none does.

    The last part of a dotted word such as `--ppo.clipp` is first compared with the options of its
    group.
    """
    group, dot, last = word.rpartition(".")
    if dot:
        prefix = group + dot
        in_group = [name.removeprefix(prefix) for name in names if name.startswith(prefix)]
        similar = nearest(last, in_group)
        if similar:
            return prefix + similar
    return nearest(word, names)


def command_remedy(arguments: Sequence[str], commands: Sequence[str]) -> str:
    """Returns the remedy for a command line whose first word is not a command."""
    word, *rest = arguments
    if word in _WORDS:
        command = nearest(rest[0], commands) if rest else ""
        meant = f"{command} {_WORDS[word]}".strip()
    elif word.startswith("-"):
        meant = nearest(word, _GLOBAL)
    else:
        meant = nearest(word, [*commands, *_WORDS])
        meant = _WORDS.get(meant, meant)
    if meant:
        return f"Did you mean 'congrasp {meant}'?"
    return f"Choose one of: {', '.join(commands)}."


def plain_error(text: str) -> str:
    """Returns an error of the parser, without terms of Python if it is about a number."""
    match = _NUMBER.fullmatch(text)
    if match is None:
        return text
    kind = "a whole number" if "int()" in text else "a number"
    return f"{match['option']} is {match['value']}, which is not {kind}"


def unrecognized(text: str) -> list[str]:
    """Returns the words that an error of the parser lists as unrecognized."""
    match = _UNRECOGNIZED.fullmatch(text)
    return match["words"].split(", ") if match else []


def similar_words(
    words: Sequence[str], arguments: Sequence[str], spec: dict[str, Any]
) -> list[str]:
    """Returns the options and subcommands that mistyped words resemble.

    Args:
      words: the unrecognized words.
      arguments: arguments of the command.
      spec: options and subcommands of the command (`services.cli.shell_specs`).
    """
    while arguments and arguments[0] in spec["subcommands"]:
        spec = spec["subcommands"][arguments[0]]
        arguments = arguments[1:]
    similar = []
    for word in words:
        names = _flags(spec) if word.startswith("-") else spec["subcommands"]
        name = nearest_option(word.partition("=")[0].replace("_", "-"), list(names))
        if name and name not in similar:
            similar.append(name)
    return similar


def _flags(spec: dict[str, Any]) -> Iterator[str]:
    """Yields all options of a command."""
    for option in spec["options"]:
        yield from option["flags"]
