"""What commands print, less what only a busy machine makes them print."""


def errors(printed: str) -> list[str]:
    """Lines of standard error, without empty ones and those that say for how long the command works
    already.
    """
    return [line for line in printed.splitlines() if line and not line.endswith(" s so far.")]
