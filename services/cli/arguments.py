"""Values of options before a command line is parsed, for defaults that depend on them."""

from collections.abc import Sequence


def has_option(option: str, arguments: Sequence[str]) -> bool:
    """Returns True if an option is on a command line, with or without a value."""
    return any(word.partition("=")[0] == option for word in arguments)


def option_value(option: str, arguments: Sequence[str]) -> str:
    """Returns the value of an option on a command line; empty if it is absent."""
    for word, following in zip(arguments, [*arguments[1:], ""], strict=True):
        name, _, value = word.partition("=")
        if name == option:
            return value or following
    return ""
