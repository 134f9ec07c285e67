"""Progress of long work, such as an import or a grasp."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called with the current activity, the number of completed steps and that of all its steps, which
may grow; 0 of 0 if the activity has no steps to count."""


def ignore_progress(activity: str, done: int, total: int) -> None:
    """Progress that is not shown."""
