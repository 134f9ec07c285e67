"""Console output of commands: tables on standard output, progress bars and errors on standard error."""

import contextlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from congrasp.common.errors import CongraspError

Track = Callable[[str, int | None], Callable[[int], None]]
"""(what is done, its total if known) -> what to call with the amount done."""


def at_least(least: float, **counts: float) -> None:
    """Raises a CongraspError for the first option, by its name, that is less."""
    for name, value in counts.items():
        if value < least:
            raise CongraspError(f"--{name} is {value}.", f"It must be at least {least:g}.")


def at_most(most: float, unit: str, **amounts: float) -> None:
    """Raises a CongraspError for the first option, by its name, that is negative or more."""
    for name, value in amounts.items():
        if not 0 <= value <= most:
            raise CongraspError(f"--{name} is {value}.", f"It is from 0 to {most:g} {unit}.")


def show_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Prints rows under the names of their columns."""
    table = Table(*columns)
    for row in rows:
        table.add_row(*row)
    Console(markup=False, highlight=False).print(table)


def show_facts(facts: Mapping[str, str]) -> None:
    """Prints names and what belongs to each."""
    table = Table(show_header=False, box=None)
    for name, text in facts.items():
        table.add_row(name, text)
    Console(markup=False, highlight=False).print(table)


def report_error(error: CongraspError) -> None:
    """Prints an error that does not end the command, as `services.cli.main` prints those that do."""
    print(f"congrasp: error: {error}", file=sys.stderr)


def bars() -> Progress:
    """A line for each task: what is done, a bar, counts, time; nothing of it is left on the screen in the end."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=Console(stderr=True), transient=True)


@contextlib.contextmanager
def tracked() -> Iterator[Track]:
    """Bars for work that reports the amount done."""
    with bars() as progress:

        def track(text: str, total: int | None) -> Callable[[int], None]:
            """A new bar."""
            task = progress.add_task(text, total=total)
            return lambda done: progress.update(task, completed=done)

        yield track
