"""Commands in processes of their own, which nobody watches; a training resumes from its last checkpoint."""

import json
import pathlib
import shutil
import time
from collections.abc import Callable, Sequence

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_json
from congrasp.learner.run_directory import CONFIG_FILE, POLICY_FILE, has_checkpoints
from congrasp.services.train.processes import Child, end_all

_TRAINED = "trained.json"
_POLL = 0.5
_LARGEST = 1 << 16


def trained(run_dir: pathlib.Path) -> pathlib.Path | None:
    """The policy file of a run that came to its end; None if it did not."""
    policy = run_dir / POLICY_FILE
    return policy if (run_dir / _TRAINED).exists() and policy.exists() else None


def seconds(run_dir: pathlib.Path) -> float | None:
    """How long its training took; of a resumed one the last session."""
    try:
        return float(read_json(run_dir / _TRAINED, _LARGEST)["seconds"])
    except (OSError, LookupError, TypeError, ValueError, CongraspError):
        return None


def run_child(child: Child, patience: float, progress: Callable[[str], None] = lambda line: None) -> int | None:
    """Runs a command in a process of its own; whatever happens, it is over then.

    Args:
      child: not started yet.
      patience: seconds after which it is ended.
      progress: is given the last line that it printed, some times a second.

    Returns:
      Its exit code; None if it was ended.
    """
    began = time.monotonic()
    try:
        child.start()
        assert child.process is not None
        while (code := child.process.poll()) is None and time.monotonic() - began < patience:
            progress(child.last_line())
            time.sleep(_POLL)
    finally:
        end_all([child])
    return code


def train_in_background(
    run_dir: pathlib.Path,
    chosen: Sequence[str],
    options: Sequence[str] = (),
    *,
    patience: float,
    progress: Callable[[str], None] = lambda line: None,
) -> None:
    """Trains until the run's end; what it prints is in a log beside the run's folder.

    Args:
      run_dir: the run, which may have begun; one without a checkpoint begins anew.
      chosen: options of `congrasp train` that make a new run, as `--preset`.
      options: further options, also of one that goes on.
      patience: seconds after which the training is ended, to be resumed another time.
      progress: is given the last line that it printed.

    Raises:
      CongraspError: it failed, or took too long.
    """
    name = run_dir.name
    arguments = ["train", *chosen, "--run-dir", str(run_dir), "--evaluation", "0", *options]
    if has_checkpoints(run_dir):
        arguments = ["train", "--resume", "--run-dir", str(run_dir), "--evaluation", "0", *options]
    elif (run_dir / CONFIG_FILE).exists():
        shutil.rmtree(run_dir)  # it ended before its first checkpoint
    run_dir.parent.mkdir(parents=True, exist_ok=True)
    child = Child(name, arguments, run_dir.with_name(f"{name}.log"))
    began = time.monotonic()
    code = run_child(child, patience, progress)
    if code is None:
        raise CongraspError(
            f"The training of {name} was ended after {patience / 60:.0f} min.",
            "The same command goes on with it; --patience gives it more time.",
        )
    if code or not (run_dir / POLICY_FILE).exists():
        raise CongraspError(f"The training of {name} failed: {child.last_line()}", f"Its log is {child.log}.")
    write_atomically(run_dir / _TRAINED, json.dumps({"seconds": round(time.monotonic() - began, 1)}).encode())
