"""Whole trainings in separate processes, for commands that train and then evaluate."""

import json
import pathlib
import shutil
import time
from collections.abc import Callable, Sequence

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_json
from congrasp.learner.run_directory import CONFIG_FILE, POLICY_FILE, has_checkpoints
from congrasp.services.ops.lifetime import Child, command, run_child

_FINISHED_FILE = "trained.json"
"""File in the folder of a finished run, with the duration of its training."""
_MAX_FILE_BYTES = 1 << 16


def train_in_background(
    run_dir: pathlib.Path,
    chosen: Sequence[str],
    options: Sequence[str] = (),
    *,
    patience: float,
    progress: Callable[[str], None] = lambda line: None,
) -> None:
    """Trains until the run's end; the output goes to a log next to the run's folder.

    Args:
      run_dir: the run, which is resumed; one without a checkpoint is restarted.
      chosen: options of `congrasp train` for a new run, such as `--preset`.
      options: further options, also for a resumed run.
      patience: seconds after which the training is stopped, to be resumed later.
      progress: called with its last line of output.

    Raises:
      CongraspError: it failed, or took too long.
    """
    name = run_dir.name
    resume = has_checkpoints(run_dir)
    if not resume and (run_dir / CONFIG_FILE).exists():
        shutil.rmtree(run_dir)  # it ended before its first checkpoint
    start = command(resume=True) if resume else list(chosen)
    arguments = ["train", *start, *command(run_dir=run_dir, evaluation=0), *options]
    run_dir.parent.mkdir(parents=True, exist_ok=True)
    child = Child(name, arguments, run_dir.with_name(f"{name}.log"))
    began = time.monotonic()
    code = run_child(child, patience, progress)
    if code is None:
        raise CongraspError(
            f"The training of {name} was stopped after {patience / 60:.0f} min.",
            "Repeat the command to resume it, with a larger --patience if it needs more time.",
        )
    if code or not (run_dir / POLICY_FILE).exists():
        raise CongraspError(
            f"The training of {name} failed: {child.cause()}", f"Read its log, {child.log}."
        )
    seconds = round(time.monotonic() - began, 1)
    write_atomically(run_dir / _FINISHED_FILE, json.dumps({"seconds": seconds}).encode())


def finished_policy(run_dir: pathlib.Path) -> pathlib.Path | None:
    """Policy file of a finished run; None if it is not finished."""
    policy = run_dir / POLICY_FILE
    is_finished = (run_dir / _FINISHED_FILE).exists() and policy.exists()
    return policy if is_finished else None


def training_seconds(run_dir: pathlib.Path) -> float | None:
    """Duration of a run's training in s; for a resumed run, the duration of its last session."""
    try:
        return float(read_json(run_dir / _FINISHED_FILE, _MAX_FILE_BYTES)["seconds"])
    except (LookupError, TypeError, ValueError, CongraspError):
        return None
