"""Commands that are printed for the user to run."""

import shlex


def shell_command(*words: object) -> str:
    """Returns a command line as a shell reads it: words with blanks or brackets are quoted."""
    return shlex.join(map(str, words))
