"""Console output of commands: tables on standard output, progress bars and errors on standard
error.
"""

import contextlib
import functools
import math
import pathlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table
from rich.text import Text

from congrasp.common.errors import CongraspError, printable
from congrasp.services.ops.interrupts import check_stopped
from congrasp.services.ops.logs import announce_progress

Track = Callable[[str, int | None], Callable[[int], None]]
"""Function that adds a bar with a label and a total, None if that is unknown. It returns a function
to call with the number of completed steps."""


def in_range(least: float, most: float = math.inf, unit: str = "", **options: float) -> None:
    """Raises a CongraspError for the first option that is outside of a range.

    Args:
      least: smallest valid value.
      most: greatest valid value.
      unit: unit of the values, for the message.
      options: values by the names of their options.
    """
    for name, value in options.items():
        if not least <= value <= most:
            bounds = f"at least {least:g}"
            if most < math.inf:
                bounds = f"between {least:g} and {most:g}"
            remedy = f"It must be {bounds} {unit}".rstrip()
            raise CongraspError(f"--{name.replace('_', '-')} is {value}.", f"{remedy}.")


def say(*lines: object) -> None:
    """Prints lines with control characters escaped, since names in them may be from a file."""
    for line in lines:
        print(printable(str(line)))


def show_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Prints rows under the names of their columns."""
    table = Table(*columns)
    for row in rows:
        table.add_row(*map(printable, row))
    Console(markup=False, highlight=False).print(table)


def show_facts(facts: Mapping[str, str]) -> None:
    """Prints names and values."""
    table = Table(show_header=False, box=None)
    for name, text in facts.items():
        table.add_row(name, printable(text))
    Console(markup=False, highlight=False).print(table)


def save_drawing(path: pathlib.Path, image: np.ndarray) -> None:
    """Writes a picture into the file of an option, and says so."""
    from congrasp.services.viz.sheets import save_png

    save_png(path, image)
    print(f"The picture is {path}.")


def report_error(error: CongraspError | str) -> None:
    """Prints an error that does not end the command, in the format of `services.cli.main`."""
    print(f"congrasp: error: {error}", file=sys.stderr)


@contextlib.contextmanager
def bars() -> Iterator[Progress]:
    """Progress display with a line for each task: text, bar, counts, time; it is erased at the end.

    Where standard error is not a terminal, a line every 10 s names the current task instead.
    """
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        Counts(),
        TimeElapsedColumn(),
    )
    console = Console(stderr=True)
    with (
        Progress(
            *columns, console=console, transient=True, disable=not console.is_terminal
        ) as progress,
        contextlib.ExitStack() as stack,
    ):
        if not console.is_terminal:
            activity = functools.partial(current_activity, progress)
            stack.enter_context(announce_progress(activity))
        yield progress


def current_activity(progress: Progress) -> str:
    """Returns the newest unfinished task, or else the newest one, and its counts, as a line for
    output without bars.
    """
    tasks = progress.tasks  # a copy: another thread may remove a task meanwhile
    if not tasks:
        return "Starting"
    task = tasks[-1]
    for other in tasks:
        if other.visible and not other.finished:
            task = other
    if not task.completed:
        return task.description
    if not task.total:
        return f"{task.description}, {task.completed:g}"
    return f"{task.description}, {task.completed:g} of {task.total:g}"


class Counts(MofNCompleteColumn):
    """Completed and total steps of a task; nothing before its first step."""

    def render(self, task: Task) -> Text:
        """Returns the counts, or an empty text."""
        if not task.completed:
            return Text()
        return super().render(task)


class PhaseBar:
    """A bar for work in phases, each of which counts its own steps.

    The current phase alone is shown. A phase without steps to count has no total.
    """

    def __init__(self, progress: Progress, phase: str):
        """Shows the first phase, which counts nothing yet."""
        self._progress = progress
        self._phase = phase
        self._task = progress.add_task(phase, total=None)

    def update(self, phase: str, done: int, total: int) -> None:
        """Shows that `done` of `total` steps of a phase are completed; 0 of 0 if it has no steps to
        count.
        """
        check_stopped()
        if phase != self._phase:
            self._progress.remove_task(self._task)
            self._phase = phase
            self._task = self._progress.add_task(phase, total=None)
        if done:
            self._progress.update(self._task, completed=done, total=total)


@contextlib.contextmanager
def tracked() -> Iterator[Track]:
    """Context with bars for work that reports its progress."""
    with bars() as progress:

        def track(text: str, total: int | None) -> Callable[[int], None]:
            """Adds a bar."""
            task = progress.add_task(text, total=total)

            def advance(done: int) -> None:
                check_stopped()
                progress.update(task, completed=done)

            return advance

        yield track
