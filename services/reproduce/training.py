"""Trains the missing policies of a reproduction in turn, each in a separate run."""

import functools
import pathlib
from collections.abc import Callable, Sequence

from congrasp.common.errors import CongraspError
from congrasp.services.reproduce.plan import RequiredPolicy
from congrasp.services.train import unattended
from congrasp.services.train.presets import FULL


def trained(folder: pathlib.Path, policy: RequiredPolicy) -> pathlib.Path | None:
    """Policy file of a finished run in the folder of all runs; None if there is none."""
    return unattended.trained(folder / policy.name)


def seconds(folder: pathlib.Path, policy: RequiredPolicy) -> float | None:
    """Duration of its training in seconds; for a resumed one, that of the last session."""
    return unattended.seconds(folder / policy.name)


def train_all(
    folder: pathlib.Path,
    wanted: Sequence[RequiredPolicy],
    *,
    options: Sequence[str] = (),
    patience: float,
    progress: Callable[[RequiredPolicy, str], None] = lambda policy, line: None,
) -> dict[RequiredPolicy, str]:
    """Trains policies, resuming from the last checkpoint if there is one.

    Args:
      folder: folder of all runs.
      wanted: policies to train, in this order, without those already `trained`.
      options: further options of `congrasp train`.
      patience: seconds after which a training is stopped, to be resumed later.
      progress: called with the last line that a training printed.

    Returns:
      Reasons for failed trainings; the others succeeded.
    """
    failures: dict[RequiredPolicy, str] = {}
    for policy in wanted:
        told = functools.partial(progress, policy)
        try:
            unattended.train_in_background(
                folder / policy.name, chosen(policy), options, patience=patience, progress=told
            )
        except CongraspError as error:
            failures[policy] = str(error)
    return failures


def chosen(policy: RequiredPolicy) -> list[str]:
    """Options of `congrasp train` for the policy's run."""
    method = ["--method", policy.method] if policy.method != "ours" else []
    return ["--preset", FULL, "--hand", policy.hand, *method]
