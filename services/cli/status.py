"""`congrasp status`: a live run."""

import pathlib
from typing import Annotated

import tyro

from congrasp.common.transport.ports import LEARNER_URL

_RUN = "quickstart"


def status(
    run_dir: Annotated[pathlib.Path | None, tyro.conf.Positional] = None,
    connect: str = LEARNER_URL,
    run: str = _RUN,
    watch: bool = False,
    every: float = 1.0,
    certs: pathlib.Path | None = None,
    json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Show the processes and the state of a run: versions, lag, rates, and the outcomes of tickets and rollouts.

    The exit code is 1 if there are warnings: counters are inconsistent, or no checkpoint can be written.

    Args:
      run_dir: Folder of a run whose learner runs on this machine, in place of --connect and --run.
      connect: The learner's endpoint.
      run: Name of the run.
      watch: Continue until Ctrl-C, also while the learner is disconnected.
      every: Seconds between two queries with --watch.
      certs: Folder of an observer's certificate (congrasp certs).
      json: Print JSON instead of tables; with --watch one object a line, and null while the learner is disconnected.

    Examples:
      congrasp status runs/mine --watch
      congrasp status --connect tcp/10.0.0.5:7447 --run human --json
    """
    import json as json_module

    from rich.console import Console
    from rich.live import Live

    from congrasp.common.errors import CongraspError
    from congrasp.common.transport import urls
    from congrasp.learner.run_directory import learner_url, open_run
    from congrasp.services.ops.status import ask, follow, tables

    if run_dir is not None:
        if (connect, run) != (LEARNER_URL, _RUN):
            raise CongraspError(
                f"The folder {run_dir} is in place of --connect and --run.", "Give either the folder or these."
            )
        connect, run = learner_url(run_dir), open_run(run_dir).name
        if not connect:
            raise CongraspError(
                f"No learner is running in {run_dir}.", f"Draw its recordings with 'congrasp plot {run_dir}'."
            )
    with urls.connect(connect, "observer", certs=certs, run=run) as transport:
        found = ask(transport, run)
        if not watch:
            if json:
                print(json_module.dumps(found))
            else:
                Console().print(tables(found))
        elif json:
            for now in follow(transport, run, every):
                print(json_module.dumps(now), flush=True)
        else:
            with Live(tables(found), auto_refresh=False) as live:
                for now in follow(transport, run, every):
                    live.update(tables(now) if now else f"The learner of '{run}' is disconnected …", refresh=True)
        return 1 if found["warnings"] else 0


COMMAND = status
