"""Trains the policies of a reproduction that are missing, one after the other, each in a run of its own."""

import functools
import pathlib
from collections.abc import Callable, Sequence

from congrasp.common.errors import CongraspError
from congrasp.services.reproduce.plan import Policy
from congrasp.services.train import unattended
from congrasp.services.train.presets import FULL


def trained(folder: pathlib.Path, policy: Policy) -> pathlib.Path | None:
    """The policy file of a run that came to its end, in the folder of all runs; None if there is none."""
    return unattended.trained(folder / policy.name)


def seconds(folder: pathlib.Path, policy: Policy) -> float | None:
    """How long its training took; of a resumed one the last session."""
    return unattended.seconds(folder / policy.name)


def train_all(
    folder: pathlib.Path,
    wanted: Sequence[Policy],
    *,
    options: Sequence[str] = (),
    patience: float,
    progress: Callable[[Policy, str], None] = lambda policy, line: None,
) -> dict[Policy, str]:
    """Trains policies, from the last checkpoint where there is one.

    Args:
      folder: of all runs.
      wanted: what is trained, in this order; none that is `trained` already.
      options: further options of `congrasp train`.
      patience: seconds after which a training is ended, to be resumed another time.
      progress: is given the last line that a training printed.

    Returns:
      Why a policy was not trained, for those that failed; the others were trained all the same.
    """
    failures: dict[Policy, str] = {}
    for policy in wanted:
        told = functools.partial(progress, policy)
        try:
            unattended.train_in_background(
                folder / policy.name, chosen(policy), options, patience=patience, progress=told
            )
        except CongraspError as error:
            failures[policy] = str(error)
    return failures


def chosen(policy: Policy) -> list[str]:
    """The options of `congrasp train` that make the policy's run."""
    method = ["--method", policy.method] if policy.method != "ours" else []
    return ["--preset", FULL, "--hand", policy.hand, *method]
