"""`congrasp audit`: the outcome of every rollout of a run."""

import pathlib
from typing import Annotated

import tyro


def audit(run_dir: Annotated[pathlib.Path, tyro.conf.Positional], journals: tuple[pathlib.Path, ...] = ()) -> int:
    """Compares the journals of a run's actors and of its learner: was every accepted rollout used once, and whole?

    Exits with 1 if one was lost, duplicated, corrupted or unmatched.

    Args:
      run_dir: Directory of the run.
      journals: Journals of actors on other machines (`congrasp actor --audit FILE`).
    """
    from rich.console import Console
    from rich.table import Table

    from services.ops.audit import FAULTS, audit

    report = audit(run_dir, journals)
    console = Console()
    table = Table("rollouts", "number", title=f"Audit of {run_dir}")
    for name, value in report.counts.items():
        table.add_row(name, str(value), style="bold red" if name in FAULTS and value else "")
    console.print(table)
    console.print(f"Lag: mean {report.lag_mean:.2f}, at most {report.lag_max} of {report.max_staleness} versions.")
    if report.holes:
        console.print(f"A full disk kept {report.holes} line(s) out of the journals.")
    for line in report.faults[:20]:
        console.print(line)
    return 1 if report.faults else 0


COMMAND = audit
