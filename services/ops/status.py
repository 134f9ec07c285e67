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

_TIMEOUT = 5.0
_SUMS = {
    "granted": ("running", "redeemed", "returned", "expired"),
    "accepted": ("consumed", "dropped", "queued"),
}
"""Counters that are sums of others: no ticket and no accepted rollout is lost."""
_ROLE = ("role", "name", "incarnation", "version", "lag", "rollouts", "rollouts/s", "steps/s")
_SHOWN = 100  # most processes in a table
_RUN = "quickstart"


def ask(transport: Transport, run: str) -> dict[str, Any]:
    """Queries the status of a run from its learner, with `warnings` (see there).

    Raises:
      TransportError: no learner of this run responds.
    """
    found = dict(transport.query(Keys(run).status, Message({}, {}), timeout=_TIMEOUT).meta)
    return {**found, "warnings": warnings(found)}


def follow(transport: Transport, run: str, every: float) -> Iterator[dict[str, Any] | None]:
    """Yields the status periodically; None while the learner is disconnected."""
    while True:
        began = time.monotonic()
        try:
            yield ask(transport, run)
        except TransportError:
            yield None
        time.sleep(max(0.0, every - (time.monotonic() - began)))


def warnings(status: Mapping[str, Any]) -> list[str]:
    """Inconsistencies of a learner's status, and checkpoints that fail, one line each."""
    counters, queue = status["counters"], status["queue"]
    found = []
    for total, parts in _SUMS.items():
        if counters[total] != sum(counters[part] for part in parts):
            terms = " + ".join(f"{part} {counters[part]}" for part in parts)
            found.append(
                f"The counters are inconsistent: {total} {counters[total]} is not {terms}."
            )
    if counters["queued"] != queue["length"]:
        found.append(
            f"{counters['queued']} rollouts are counted as queued, but the queue holds "
            f"{queue['length']}."
        )
    # A learner of an earlier version tells none
    return [
        *found,
        *filter(None, [status.get("trouble")]),
    ]


def tables(status: Mapping[str, Any]) -> Group:
    """Formats the status for a terminal."""
    ended = ", finished" if status["finished"] else ""
    roles = Table(
        title=f"{status['run']}, version {status['version']}, run id {status['run_id']}{ended}"
    )
    refused = any(role.get("refused") for role in status["roles"])
    for column in (*_ROLE, "refused") if refused else _ROLE:
        roles.add_column(column, justify="left" if column in _ROLE[:3] else "right")
    for role in status["roles"][:_SHOWN]:
        version = status["version"] if role["role"] == "learner" else role.get("version", "")
        rates = (
            f"{role[rate]:.2f}" if rate in role else ""
            for rate in ("rollouts_per_second", "steps_per_second")
        )
        counts = (version, role.get("lag", ""), role.get("rollouts", ""), *rates)
        who = (Text(ascii(role[name])[1:70].rstrip("'")) for name in ("role", "id", "incarnation"))
        roles.add_row(*who, *map(str, counts), *([str(role.get("refused", ""))] if refused else []))
    counters = Table(title="Counters: tickets and rollouts")
    counters.add_column("count")
    counters.add_column("number", justify="right")
    counters.add_column("which is")
    for name, value in status["counters"].items():
        counters.add_row(name, str(value), " + ".join(_SUMS.get(name, ())))
    rates, queue = status["rates"], status["queue"]
    line = (
        f"{rates['rollouts_per_second']:.2f} rollouts/s, {rates['steps_per_second']:.0f} steps/s; "
        f"{queue['length']} rollout(s) of at most {queue['limit']} waiting"
    )
    more = len(status["roles"][_SHOWN:]) + status["unlisted"]
    others = [Text(f"{more} more live process(es).")] if more else []
    wrong = (Text(f"Warning: {text}", style="yellow") for text in status["warnings"])
    return Group(roles, *others, counters, Text(line), *wrong)


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
    """Folder of a run whose learner runs on this machine, in place of --connect and --run."""
    connect: str = LEARNER_URL
    """The learner's endpoint."""
    run: str = _RUN
    """Name of the run."""
    watch: bool = False
    """Continue until Ctrl-C, also while the learner is disconnected."""
    every: float = 1.0
    """Seconds between two queries with --watch."""
    certs: pathlib.Path | None = None
    """Folder of an observer's certificate (congrasp certs)."""
    json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print JSON instead of tables; with --watch one object a line, and null while the learner is
    disconnected.
    """

    def __call__(self) -> int:
        """Prints the status."""
        connect, run = (
            (self.connect, self.run) if self.run_dir is None else self._of_folder(self.run_dir)
        )
        with urls.connect(connect, "observer", certs=self.certs, run=run) as transport:
            found = ask(transport, run)
            if not self.watch:
                if self.json:
                    print(json.dumps(found))
                else:
                    Console(markup=False).print(tables(found))
            elif self.json:
                for now in follow(transport, run, self.every):
                    print(json.dumps(now), flush=True)
            else:
                with Live(tables(found), console=Console(markup=False), auto_refresh=False) as live:
                    for now in follow(transport, run, self.every):
                        live.update(
                            tables(now) if now else f"The learner of '{run}' is disconnected …",
                            refresh=True,
                        )
            return 1 if found["warnings"] else 0

    def _of_folder(self, run_dir: pathlib.Path) -> tuple[str, str]:
        """Endpoint and name of the run of a folder."""
        from congrasp.learner.run_directory import learner_url, open_run

        if (self.connect, self.run) != (LEARNER_URL, _RUN):
            raise CongraspError(
                f"The folder {run_dir} is in place of --connect and --run.",
                "Give either the folder or these.",
            )
        run, connect = open_run(run_dir).name, learner_url(run_dir)
        if not connect:
            raise CongraspError(
                f"No learner is running in {run_dir}.",
                f"Draw its recordings with '{shell_command('congrasp', 'plot', run_dir)}'.",
            )
        return connect, run


COMMAND = Status
