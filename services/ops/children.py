"""Child processes of congrasp: start and end, and trainings in them, which resume from their last checkpoint."""

import contextlib
import dataclasses
import json
import os
import pathlib
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_json
from congrasp.services.ops.shutdown import PARENT_VARIABLE, register_child

CHILD_GRACE = 2.0
"""Seconds for a child to drain; the rest of `GRACE` remains to kill it before this process must end."""
_TRAINED = "trained.json"
_POLL = 0.5
_LARGEST = 1 << 16


def command(*words: object, **options: object) -> list[str]:
    """Arguments of congrasp: words, then options by name; None and False leave one out, and a tuple has many values."""
    arguments = list(map(str, words))
    for name, value in options.items():
        if value is not None and value is not False:
            values = value if isinstance(value, tuple) else () if value is True else (value,)
            arguments += [f"--{name.replace('_', '-')}", *map(str, values)]
    return arguments


@dataclasses.dataclass
class Child:
    """A process of the run."""

    name: str
    arguments: list[str]
    log: pathlib.Path
    environment: dict[str, str] = dataclasses.field(default_factory=dict)
    process: subprocess.Popen[bytes] | None = None
    restarts: int = 0
    again_at: float = 0.0

    def start(self) -> int:
        """Starts it in a separate session, so that Ctrl-C reaches only the orchestrator; it dies with its parent."""
        # Unfiltered, so that the last line of the log is the error, and not JAX's note on filtered frames.
        jax = {"JAX_TRACEBACK_FILTERING": "off"}
        environment = {**jax, **os.environ, **self.environment, PARENT_VARIABLE: str(os.getpid())}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "congrasp", *self.arguments],
                stdout=log,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                env=environment,
                start_new_session=True,
            )
        register_child(self.process)
        return self.process.pid

    @property
    def code(self) -> int | None:
        """Its exit code; None before it starts and while it runs."""
        return self.process.poll() if self.process else None

    def last_line(self) -> str:
        """The last line of its log."""
        lines = self.log.read_text(errors="replace").strip().splitlines() if self.log.exists() else []
        return lines[-1].removeprefix("congrasp: error: ") if lines else "its log is empty"


def wait_for(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> None:
    """Waits until all have ended, for at most `seconds`."""
    deadline = time.monotonic() + seconds
    for process in processes:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(max(0.0, deadline - time.monotonic()))


def end_all(children: Sequence[Child]) -> None:
    """Sends SIGTERM to all, and SIGKILL to those that have not drained within `CHILD_GRACE` seconds."""
    running = [child.process for child in children if child.process and child.code is None]
    for process in running:
        process.terminate()
    wait_for(running, CHILD_GRACE)
    for process in running:
        if process.poll() is None:
            process.kill()
            process.wait()


def trained(run_dir: pathlib.Path) -> pathlib.Path | None:
    """Policy file of a finished run; None if it is not finished."""
    from congrasp.learner.run_directory import POLICY_FILE  # with JAX

    policy = run_dir / POLICY_FILE
    return policy if (run_dir / _TRAINED).exists() and policy.exists() else None


def training_seconds(run_dir: pathlib.Path) -> float | None:
    """Duration of its training in seconds; for a resumed one, that of the last session."""
    try:
        return float(read_json(run_dir / _TRAINED, _LARGEST)["seconds"])
    except (LookupError, TypeError, ValueError, CongraspError):
        return None


def run_child(child: Child, patience: float, progress: Callable[[str], None] = lambda line: None) -> int | None:
    """Runs a command in a separate process, which has ended on return in any case.

    Args:
      child: the command, not started yet.
      patience: seconds after which it is terminated.
      progress: called several times a second with its last line of output.

    Returns:
      Its exit code; None if it was terminated.
    """
    began = time.monotonic()
    try:
        child.start()
        while (code := child.code) is None and time.monotonic() - began < patience:
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
    from congrasp.learner.run_directory import CONFIG_FILE, POLICY_FILE, has_checkpoints

    name = run_dir.name
    resume = has_checkpoints(run_dir)
    if not resume and (run_dir / CONFIG_FILE).exists():
        shutil.rmtree(run_dir)  # it ended before its first checkpoint
    begin = command(resume=True) if resume else list(chosen)
    arguments = ["train", *begin, *command(run_dir=run_dir, evaluation=0), *options]
    run_dir.parent.mkdir(parents=True, exist_ok=True)
    child = Child(name, arguments, run_dir.with_name(f"{name}.log"))
    began = time.monotonic()
    code = run_child(child, patience, progress)
    if code is None:
        raise CongraspError(
            f"The training of {name} was stopped after {patience / 60:.0f} min.",
            "Repeat the command to resume it; --patience gives it more time.",
        )
    if code or not (run_dir / POLICY_FILE).exists():
        raise CongraspError(f"The training of {name} failed: {child.last_line()}", f"Its log is {child.log}.")
    write_atomically(run_dir / _TRAINED, json.dumps({"seconds": round(time.monotonic() - began, 1)}).encode())
