"""Trains the policies of a reproduction that are missing, one after the other, each in a run of its own."""

import functools
import json
import pathlib
import shutil
import time
from collections.abc import Callable, Sequence

from common.errors import CongraspError
from common.files import write_atomically
from common.inputs import read_json
from learner.run_directory import CONFIG_FILE, POLICY_FILE, has_checkpoints
from services.reproduce.plan import Policy
from services.train.presets import FULL
from services.train.processes import Child, end_all

_TRAINED = "trained.json"
_POLL = 0.5
_LARGEST = 1 << 16


def trained(folder: pathlib.Path, policy: Policy) -> pathlib.Path | None:
    """The policy file of a run that came to its end, in the folder of all runs; None if there is none."""
    run_dir = folder / policy.name
    return run_dir / POLICY_FILE if (run_dir / _TRAINED).exists() and (run_dir / POLICY_FILE).exists() else None


def seconds(folder: pathlib.Path, policy: Policy) -> float | None:
    """How long its training took; of a resumed one the last session."""
    try:
        return float(read_json(folder / policy.name / _TRAINED, _LARGEST)["seconds"])
    except (OSError, LookupError, TypeError, ValueError, CongraspError):
        return None


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
        try:
            _train(folder / policy.name, policy, options, patience, functools.partial(progress, policy))
        except CongraspError as error:
            failures[policy] = str(error)
    return failures


def command(run_dir: pathlib.Path, policy: Policy, options: Sequence[str]) -> list[str]:
    """The command line of a training, without the program's name."""
    chosen = ["--preset", FULL, "--hand", policy.hand]
    chosen += ["--method", policy.method] if policy.method != "ours" else []
    return ["train", *chosen, "--run-dir", str(run_dir), "--evaluation", "0", *options]


def _train(
    run_dir: pathlib.Path, policy: Policy, options: Sequence[str], patience: float, progress: Callable[[str], None]
) -> None:
    """Trains one policy.

    Raises:
      CongraspError: it failed, or took too long.
    """
    arguments = command(run_dir, policy, options)
    if has_checkpoints(run_dir):
        arguments = ["train", "--resume", "--run-dir", str(run_dir), "--evaluation", "0", *options]
    elif (run_dir / CONFIG_FILE).exists():
        shutil.rmtree(run_dir)  # it ended before its first checkpoint
    run_dir.parent.mkdir(parents=True, exist_ok=True)
    child = Child(policy.name, arguments, run_dir.with_name(f"{policy.name}.log"))
    began = time.monotonic()
    try:
        child.start()
        assert child.process is not None
        while (code := child.process.poll()) is None and time.monotonic() - began < patience:
            progress(child.last_line())
            time.sleep(_POLL)
    finally:
        end_all([child])
    if code is None:
        raise CongraspError(
            f"The training of {policy.name} was ended after {patience / 60:.0f} min.",
            "The same command goes on with it; --patience gives it more time.",
        )
    if code or not (run_dir / POLICY_FILE).exists():
        raise CongraspError(f"The training of {policy.name} failed: {child.last_line()}", f"Its log is {child.log}.")
    write_atomically(run_dir / _TRAINED, json.dumps({"seconds": round(time.monotonic() - began, 1)}).encode())
