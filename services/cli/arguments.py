"""Values of options before a command line is parsed, for defaults that depend on them."""

import itertools
from collections.abc import Sequence


def has_option(option: str, arguments: Sequence[str]) -> bool:
    """Returns True if an option is on a command line, with or without a value."""
    return any(word.partition("=")[0] == option for word in arguments)


def option_value(option: str, arguments: Sequence[str]) -> str:
    """Returns the value of an option on a command line; empty if it is absent. The last of several
    counts, as for the parser.
    """
    value = ""
    for word, following in itertools.zip_longest(arguments, arguments[1:], fillvalue=""):
        name, equals_sign, attached = word.partition("=")
        if name == option:
            value = attached if equals_sign else following
    return value
