"""`congrasp status`: queries the status of a live run, checks its counters, and formats them as
tables.
"""

import dataclasses
import json
import pathlib
import time
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import tyro
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from congrasp.common.errors import CongraspError, TransportError
from congrasp.common.shell import shell_command
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import LEARNER_URL
from congrasp.common.wire.codec import Message

_TIMEOUT_S = 5.0
_SUMS = {
    "granted": ("running", "redeemed", "returned", "expired"),
    "accepted": ("consumed", "dropped", "queued"),
}
"""Counters that must be the sum of others, if no ticket and no accepted rollout is lost."""
_TEXT_COLUMNS = ("role", "name", "incar-\nnation")
_NUMBER_COLUMNS = ("version", "lag", "rollouts", "rollouts\nper s", "steps\nper s")
"""Titles of at most eight characters a line: all columns fit into 80."""
_MAX_ROWS = 100
"""Most processes in a table."""
_DEFAULT_RUN = "quickstart"


def ask(transport: Transport, run: str) -> dict[str, Any]:
    """Queries the status of a run from its learner, and adds its `warnings` (see this function).

    Raises:
      TransportError: no learner of this run responds.
    """
    reply = transport.query(Keys(run).status, Message({}, {}), timeout=_TIMEOUT_S)
    status = dict(reply.meta)
    return {**status, "warnings": warnings(status)}


def follow(transport: Transport, run: str, every: float) -> Iterator[dict[str, Any] | None]:
    """Yields the status every `every` seconds; None while the learner is disconnected."""
    while True:
        start = time.monotonic()
        try:
            yield ask(transport, run)
        except TransportError:
            yield None
        time.sleep(max(0.0, start + every - time.monotonic()))


def warnings(status: Mapping[str, Any]) -> list[str]:
    """Inconsistencies of a learner's status, and checkpoints that fail, one line each."""
    counters = status["counters"]
    queue = status["queue"]
    texts: list[str] = []
    for total, addends in _SUMS.items():
        if counters[total] != sum(counters[name] for name in addends):
            terms = " + ".join(f"{name} {counters[name]}" for name in addends)
            texts.append(
                f"The counters are inconsistent: {total} {counters[total]} is not {terms}."
            )
    if counters["queued"] != queue["length"]:
        texts.append(
            f"{counters['queued']} rollouts are counted as queued, but the queue holds "
            f"{queue['length']}."
        )
    trouble = status.get("trouble")  # a learner of an earlier version has no such entry
    if trouble:
        texts.append(trouble)
    return texts


def tables(status: Mapping[str, Any]) -> Group:
    """Formats the status for a terminal."""
    rates = status["rates"]
    queue = status["queue"]
    line = (
        f"{rates['rollouts_per_second']:.2f} rollouts/s, {rates['steps_per_second']:.0f} steps/s; "
        f"{queue['length']} rollout(s) of at most {queue['limit']} waiting"
    )
    sections: list[Table | Text] = [_roles_table(status)]
    more = len(status["roles"][_MAX_ROWS:]) + status["unlisted"]
    if more:
        sections.append(Text(f"{more} more live process(es)."))
    sections.append(_counters_table(status["counters"]))
    sections.append(Text(line))
    for warning in status["warnings"]:
        sections.append(Text(f"Warning: {warning}", style="yellow"))
    return Group(*sections)


def _roles_table(status: Mapping[str, Any]) -> Table:
    """Table of the processes, with a column of refused rollouts if there are any."""
    ended = ", finished" if status["finished"] else ""
    table = Table(
        title=f"{status['run']}, version {status['version']}, run id {status['run_id']}{ended}"
    )
    for column in _TEXT_COLUMNS:
        table.add_column(column, overflow="fold")
    for column in _NUMBER_COLUMNS:
        table.add_column(column, justify="right")
    some_refused = any(role.get("refused") for role in status["roles"])
    if some_refused:
        table.add_column("refused", justify="right")
    for role in status["roles"][:_MAX_ROWS]:
        names = [_cell(role[name]) for name in ("role", "id", "incarnation")]
        numbers = _role_numbers(role, status["version"])
        if some_refused:
            numbers.append(str(role.get("refused", "")))
        table.add_row(*names, *numbers)
    return table


def _cell(name: str) -> Text:
    """Cell with the beginning of a name. Other processes choose it, so that it may contain any
    characters.
    """
    return Text(ascii(name)[1:70].rstrip("'"))


def _role_numbers(role: Mapping[str, Any], learner_version: int) -> list[str]:
    """Cells of a process's version, lag, rollouts and rates; empty where it has none."""
    version = learner_version if role["role"] == "learner" else role.get("version", "")
    cells = [str(version), str(role.get("lag", "")), str(role.get("rollouts", ""))]
    for rate, decimals in (("rollouts_per_second", 2), ("steps_per_second", 0)):
        cells.append(f"{role[rate]:.{decimals}f}" if rate in role else "")
    return cells


def _counters_table(counters: Mapping[str, int]) -> Table:
    """Table of the counters, with the addends of those that are sums."""
    table = Table(title="Counters: tickets and rollouts")
    table.add_column("count")
    table.add_column("number", justify="right")
    table.add_column("which is")
    for name, value in counters.items():
        table.add_row(name, str(value), " + ".join(_SUMS.get(name, ())))
    return table


@dataclasses.dataclass(frozen=True)
class Status:
    """Show the processes and the state of a run: versions, lag, rates, and the outcomes of tickets
    and rollouts.

    The exit code is 1 if there are warnings: counters are inconsistent, or no checkpoint can be
    written.

    Examples:
      congrasp status runs/mine --watch
      congrasp status --connect tcp/10.0.0.5:7447 --run human --json
    """

    run_dir: Annotated[pathlib.Path | None, tyro.conf.Positional] = None
    """Folder of a run whose learner runs on this machine. It replaces --connect and --run."""
    connect: str = LEARNER_URL
    """Endpoint of the learner."""
    run: str = _DEFAULT_RUN
    """Name of the run."""
    watch: bool = False
    """Update the status until Ctrl-C, also while the learner is disconnected."""
    every: float = 1.0
    """Seconds between two queries with --watch."""
    certs: pathlib.Path | None = None
    """Folder of an observer's certificate (congrasp certs)."""
    json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print JSON instead of tables. With --watch this is one object per line, and null while the
    learner is disconnected.
    """

    def __call__(self) -> int:
        """Prints the status, and returns the exit code."""
        connect = self.connect
        run = self.run
        if self.run_dir is not None:
            connect, run = self._of_folder(self.run_dir)
        with urls.connect(connect, "observer", certs=self.certs, run=run) as transport:
            status = ask(transport, run)
            if self.watch:
                self._watch(transport, run, status)
            elif self.json:
                print(json.dumps(status))
            else:
                Console(markup=False).print(tables(status))
            return 1 if status["warnings"] else 0

    def _watch(self, transport: Transport, run: str, status: dict[str, Any]) -> None:
        """Prints the status periodically, beginning with this one."""
        if self.json:
            for newest in follow(transport, run, self.every):
                print(json.dumps(newest), flush=True)
            return
        console = Console(markup=False)
        with Live(tables(status), console=console, auto_refresh=False) as live:
            for newest in follow(transport, run, self.every):
                content: Group | str = f"The learner of '{run}' is disconnected …"
                if newest is not None:
                    content = tables(newest)
                live.update(content, refresh=True)

    def _of_folder(self, run_dir: pathlib.Path) -> tuple[str, str]:
        """Endpoint and name of the run of a folder."""
        from congrasp.learner.run_directory import learner_url, open_run

        if (self.connect, self.run) != (LEARNER_URL, _DEFAULT_RUN):
            raise CongraspError(
                f"The folder {run_dir} cannot be combined with --connect or --run.",
                "Pass either the folder or these options.",
            )
        run = open_run(run_dir).name
        connect = learner_url(run_dir)
        if not connect:
            raise CongraspError(
                f"No learner is running in {run_dir}.",
                f"Draw its recordings with '{shell_command('congrasp', 'plot', run_dir)}'.",
            )
        return connect, run


COMMAND = Status
