"""`congrasp status`: a live run."""

import dataclasses
import json
import pathlib
from typing import Annotated

import tyro
from rich.console import Console
from rich.live import Live

from congrasp.common.errors import CongraspError
from congrasp.common.transport import urls
from congrasp.common.transport.ports import LEARNER_URL
from congrasp.services.ops.status import ask, follow, tables

_RUN = "quickstart"


@dataclasses.dataclass(frozen=True)
class Status:
    """Show the processes and the state of a run: versions, lag, rates, and the outcomes of tickets and rollouts.

    The exit code is 1 if there are warnings: counters are inconsistent, or no checkpoint can be written.

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
    """Print JSON instead of tables; with --watch one object a line, and null while the learner is disconnected."""

    def __call__(self) -> int:
        """Prints the status."""
        connect, run = (self.connect, self.run) if self.run_dir is None else self._of_folder(self.run_dir)
        with urls.connect(connect, "observer", certs=self.certs, run=run) as transport:
            found = ask(transport, run)
            if not self.watch:
                if self.json:
                    print(json.dumps(found))
                else:
                    Console().print(tables(found))
            elif self.json:
                for now in follow(transport, run, self.every):
                    print(json.dumps(now), flush=True)
            else:
                with Live(tables(found), auto_refresh=False) as live:
                    for now in follow(transport, run, self.every):
                        live.update(tables(now) if now else f"The learner of '{run}' is disconnected …", refresh=True)
            return 1 if found["warnings"] else 0

    def _of_folder(self, run_dir: pathlib.Path) -> tuple[str, str]:
        """Endpoint and name of the run of a folder."""
        from congrasp.learner.run_directory import learner_url, open_run

        if (self.connect, self.run) != (LEARNER_URL, _RUN):
            raise CongraspError(
                f"The folder {run_dir} is in place of --connect and --run.", "Give either the folder or these."
            )
        run, connect = open_run(run_dir).name, learner_url(run_dir)
        if not connect:
            raise CongraspError(
                f"No learner is running in {run_dir}.", f"Draw its recordings with 'congrasp plot {run_dir}'."
            )
        return connect, run


COMMAND = Status
