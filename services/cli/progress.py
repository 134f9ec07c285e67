"""How far a command has got, on standard error; nothing of it is left on the screen in the end."""

import contextlib
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

Track = Callable[[str, int | None], Callable[[int], None]]
"""(what is done, its total if known) -> what to call with the amount done."""


def bars(console: Console | None = None) -> Progress:
    """A line for each task: what is done, a bar, counts, time; on standard error unless on this console."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=console or Console(stderr=True), transient=True)


@contextlib.contextmanager
def tracked() -> Iterator[Track]:
    """Bars for work that reports the amount done."""
    with bars() as progress:

        def track(text: str, total: int | None) -> Callable[[int], None]:
            task = progress.add_task(text, total=total)
            return lambda done: progress.update(task, completed=done)

        yield track
