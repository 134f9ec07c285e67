"""`congrasp audit`: the outcome of every rollout of a run."""

import pathlib
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from congrasp.services.ops.audit import EXIT_CODES, FAULTS, UNJUDGED, compare


def audit(run_dir: Annotated[pathlib.Path, tyro.conf.Positional], journals: tuple[pathlib.Path, ...] = ()) -> int:
    """Compares the journals of a run's actors and of its learner: was every accepted rollout used once, and unchanged?

    Exits with 1 if a rollout was lost, else with 5 for a surplus (a rollout used twice, or made by no actor), else
    with 6 if a rollout or a journal is damaged, else with 7 if something cannot be judged, for lines are missing.

    Args:
      run_dir: Directory of the run.
      journals: Journals of actors on other machines (`congrasp actor --audit FILE`).

    Examples:
      congrasp audit runs/mine
      congrasp audit runs/mine --journals actor.1 actor.2
    """
    report = compare(run_dir, journals)
    console = Console()
    table = Table("rollouts", "number", "kind", title=f"Audit of {run_dir}")
    for name, value in report.counts.items():
        style = "bold red" if name in FAULTS and value else ""
        table.add_row(name, str(value), FAULTS.get(name, ""), style=style)
    table.add_section()
    table.add_row("damaged lines", str(report.damaged), "damage", style="bold red" if report.damaged else "")
    table.add_row("lines of older versions", str(report.unchecked), "unchecked" if report.unchecked else "")
    console.print(table)
    console.print(f"Lag: mean {report.lag_mean:.2f}, maximum {report.lag_max} of {report.max_staleness} versions.")
    if report.holes:
        console.print(f"{report.holes} line(s) are missing in the journals: the disk was full, or their end was cut.")
    if report.missing:
        console.print(f"Lines are missing at {report.missing} place(s) of the journals: they were emptied or cut.")
    if report.exit_code == EXIT_CODES["unjudged"]:
        count, accepted = report.counts.get(UNJUDGED, 0), report.counts.get("accepted", 0)
        console.print(f"The run cannot be judged: {count} of {accepted} accepted rollouts are {UNJUDGED}.")
    for line in report.faults[:20]:
        console.print(line)
    return report.exit_code


COMMAND = audit
