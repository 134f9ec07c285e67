"""`congrasp audit`: the outcome of every rollout of a run."""

import pathlib
from typing import Annotated

import tyro
from rich.console import Console

_MAX_FAULTS = 20
"""Faults that are printed."""


def audit(
    run_dir: Annotated[pathlib.Path, tyro.conf.Positional], journals: tuple[pathlib.Path, ...] = ()
) -> int:
    """Compares the journals of a run's actors and of its learner: was every accepted rollout used
    once, and unchanged?

    Exits with 1 if a rollout was lost, else with 5 for a surplus (a rollout used twice, or made by
    no actor), else with 6 if a rollout or a journal is damaged, else with 7 if something cannot be
    judged because lines are missing.

    Args:
      run_dir: Directory of the run.
      journals: Journals of actors on other machines (`congrasp actor --audit FILE`).

    Examples:
      congrasp audit runs/mine
      congrasp audit runs/mine --journals actor.1 actor.2
    """
    from congrasp.services.ops.audit import compare, outcome_table, remarks

    report = compare(run_dir, journals)
    console = Console(markup=False)
    console.print(outcome_table(run_dir, report))
    for line in remarks(report):
        console.print(line)
    for line in report.faults[:_MAX_FAULTS]:
        console.print(line)
    return report.exit_code


COMMAND = audit
