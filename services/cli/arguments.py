"""Values of options before a command line is parsed, for defaults that depend on them."""

from collections.abc import Sequence


def option_value(option: str, arguments: Sequence[str]) -> str:
    """Returns the value of an option on a command line; empty if it is absent."""
    for word, following in zip(arguments, [*arguments[1:], ""], strict=True):
        name, _, value = word.partition("=")
        if name == option:
            return value or following
    return ""
