"""Words of a command line that are not what the user means: home folders that the shell has not
expanded, and the dashes and quotation marks of typeset text.
"""

import os
import re
from collections.abc import Sequence

from congrasp.common.errors import CongraspError

_HOME = re.compile(r"(--[\w.-]+=)?(~[^/]*(?:/.*)?)", re.DOTALL)
"""An option's name, if a path is glued to it, and the path."""
_DASHES = "\u2010\u2011\u2012\u2013\u2014\u2015\u2212"
_TYPESET_OPTION = re.compile(rf"-?[{_DASHES}]+-?([A-Za-z][\w.-]*)")
_TYPESET_QUOTES = ("\u2018", "\u2019", "\u201c", "\u201d", "\u00ab", "\u00bb")


def expand_homes(arguments: Sequence[str]) -> list[str]:
    """Returns words with the home folder in place of a leading `~`.

    Shells expand a word that begins with `~`, but bash leaves `--out=~/grasps`, for which a folder
    named `~` would be created. A file of this name can be written as `./~`.
    """
    expanded = []
    for argument in arguments:
        path = _HOME.fullmatch(argument)
        if path:
            argument = f"{path[1] or ''}{os.path.expanduser(path[2])}"
        expanded.append(argument)
    return expanded


def check_typography(arguments: Sequence[str]) -> None:
    """Raises a CongraspError for a word with a typeset dash or quotation mark, unless it is a file.

    Such words are copied from texts. They would be taken as names of objects.
    """
    for argument in arguments:
        if os.path.lexists(argument):
            continue
        option = _TYPESET_OPTION.match(argument)
        if option:
            raise CongraspError(
                f"'{argument}' begins with a dash of typeset text.", f"Type --{option[1]}."
            )
        if argument.startswith(_TYPESET_QUOTES) or argument.endswith(_TYPESET_QUOTES):
            raise CongraspError(
                f"{argument} has a quotation mark of typeset text.", "Type \" or ' instead."
            )
