"""Options that have an effect only together with another one."""

from collections.abc import Sequence
from typing import Any

from congrasp.common.errors import CongraspError


def check_together(command: Any, options: Sequence[str], needed: str) -> None:
    """Raises a CongraspError if one of some options differs from its default, but the one that it
    belongs to is not given.

    Args:
      command: a command whose fields are its options.
      options: names of the options.
      needed: name of the option that gives them their effect.
    """
    if getattr(command, needed):
        return
    for name in options:
        value = getattr(command, name)
        if value == getattr(type(command), name):
            continue
        option = name.replace("_", "-")
        raise CongraspError(
            f"--{option} has no effect without --{needed}.", f"Add --{needed} or leave it out."
        )
