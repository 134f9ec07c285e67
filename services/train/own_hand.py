"""The flow of `congrasp hands train`: self-check, training, evaluation, and one report about a
hand.

Each stage is a separate command in a separate process, so that it has the whole GPU memory. Results
are in one folder, and repeating the command runs only the missing stages.
"""

import dataclasses
import pathlib
import time
import types
from collections.abc import Callable, Mapping, Sequence

from congrasp.common.errors import CongraspError, need_package
from congrasp.common.hands.files import hand_text
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_json
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import own_policy_file, pretrained_hands
from congrasp.common.runtime.engines import PhysicsName
from congrasp.learner.run_directory import CONFIG_FILE, POLICY_FILE
from congrasp.services.assets.hands.findings import Finding, read_findings
from congrasp.services.ops.lifetime import Child, command, run_child
from congrasp.services.train.background import (
    finished_policy,
    train_in_background,
    training_seconds,
)
from congrasp.services.train.presets import FULL, get_preset

HAND = "hand.json"
CHECK = "check.json"
REPORT = "report.html"
_ROWS = "report.json"
_MAX_REPORT_BYTES = 1 << 24
_STAGE_TIMEOUT_S = 1800.0
"""Deadline of a check or a report."""
_LINE_INTERVAL_S = 10.0
"""Time between two lines about the training's progress."""
_FULL_TASK_UPDATES = 560
"""With check and report, some 20 minutes of one H200."""
_H200_STEPS_PER_S = 350_000
"""Trained steps per second of one H200."""


@dataclasses.dataclass(frozen=True)
class Request:
    """Request to train a hand."""

    hand: Hand
    reference: str
    """Name of the hand in commands, or the path of its file."""
    out: pathlib.Path
    full: bool
    """Trains the full task; otherwise the short training of a machine without a GPU."""
    anyway: bool
    """Trains the hand although its self-check failed."""
    physics: PhysicsName
    episodes: int
    """Episodes of each row of the report."""
    pool: int
    """Objects of the report."""
    options: Sequence[str]
    """Further options of `congrasp train`."""
    patience: float
    """Limit of the training, s."""

    @property
    def run_dir(self) -> pathlib.Path:
        """Folder of the training."""
        return self.out / ("full" if self.full else "short")


def train_hand(request: Request, note: Callable[[str], None]) -> pathlib.Path:
    """Runs the missing stages of a hand's self-check, training and report.

    Args:
      request: the request.
      note: called with messages for the user.

    Returns:
      File of the trained policy in the run's folder.

    Raises:
      CongraspError: the self-check failed, a stage failed, or the folder holds the training of
        another hand.
    """
    need_package("The report", "jinja2")
    _begin(request)
    _check(request, note)
    if not request.full:
        note(_short_training_note(request))
    policy = finished_policy(request.run_dir)
    if policy is None:
        policy = _train(request, note)
    _install(request, policy, note)
    write_report(request, policy, note)
    return policy


def _begin(request: Request) -> None:
    """Creates the folder for this hand; raises a CongraspError if it holds the training of
    another.
    """
    file = request.out / HAND
    text = hand_text(request.hand).encode()
    if file.exists() and file.read_bytes() == text:
        return
    if any(request.out.glob(f"*/{CONFIG_FILE}")):
        raise CongraspError(
            f"{request.out} contains the training of another hand, or of an earlier version of "
            f"this hand.",
            "Pass another --out, or remove the folder.",
        )
    (request.out / CHECK).unlink(missing_ok=True)
    write_atomically(file, text)


def _check(request: Request, note: Callable[[str], None]) -> None:
    """Runs the self-check, unless its result exists; raises a CongraspError if the hand fails it.

    Its command ends with 0 or, for a hand that fails, with 1.
    """
    file = request.out / CHECK
    picture = file.with_suffix(".png")
    if not file.exists():
        arguments = command("hands", "check", request.reference, json=file, png=picture)
        _run(request, "check", arguments, exit_codes=(0, 1), environment={"JAX_PLATFORMS": "cpu"})
    findings: list[Finding] = read_findings(file)
    for finding in findings:
        note(str(finding))
    if any(finding.verdict == "failed" for finding in findings) and not request.anyway:
        raise CongraspError(
            f"The hand '{request.hand.name}' failed its self-check ({picture}).",
            "Correct its file as the remedies say, or pass --anyway to train it regardless.",
        )


def _train(request: Request, note: Callable[[str], None]) -> pathlib.Path:
    """Runs the training, or resumes it."""
    preset = FULL if request.full else "quickstart"
    new_run = command(preset=preset, hand=request.reference)
    log = request.run_dir.with_name(f"{request.run_dir.name}.log")
    note(f"Training {request.hand.name} in {request.run_dir} (log: {log})")
    noted_at = time.monotonic()
    noted_line = ""

    def progress(line: str) -> None:
        """Notes a new line periodically."""
        nonlocal noted_at, noted_line
        if line != noted_line and time.monotonic() - noted_at > _LINE_INTERVAL_S:
            noted_at = time.monotonic()
            noted_line = line
            note(f"  {line}")

    options = list(request.options)
    if request.full:
        options = command(physics=request.physics, updates=_FULL_TASK_UPDATES) + options
    train_in_background(
        request.run_dir, new_run, options, patience=request.patience, progress=progress
    )
    return request.run_dir / POLICY_FILE


def _install(request: Request, policy: pathlib.Path, note: Callable[[str], None]) -> None:
    """Installs the policy for `--hand`, unless there is one of this hand with more experience."""
    hand = request.hand
    installed_file = own_policy_file(hand.name)
    if not hand.text and hand.name in pretrained_hands():
        note(f"--hand {hand.name} remains the package's policy; this one is --policy {policy}.")
        return
    if installed_file.exists():
        installed = bundles.load(installed_file)
        trained = bundles.load(policy)
        has_more_training = installed.transitions > trained.transitions
        if installed.spec.hand == hand.reference and has_more_training:
            note(
                f"{installed_file} has more training ({installed.transitions:,} steps) and "
                f"remains; this one is --policy {policy}."
            )
            return
    write_atomically(installed_file, policy.read_bytes())
    note(f"The policy of --hand {hand.name} is {installed_file}.")


def write_report(request: Request, policy: pathlib.Path, note: Callable[[str], None]) -> None:
    """Evaluates a policy and writes its report, unless they exist for this policy.

    Args:
      request: folder, episodes and pool of the evaluation.
      policy: file of the policy.
      note: called with one line on the progress.
    """
    rows = request.out / _ROWS
    page = request.out / REPORT
    measurement = {
        "content": bundles.content_hash(policy.read_bytes()),
        "episodes": request.episodes,
        "pool": request.pool,
    }
    is_current = False
    if page.exists() and rows.exists():
        is_current = measurement.items() <= read_json(rows, _MAX_REPORT_BYTES).items()
    if not is_current:
        note(f"Evaluating {request.episodes} episodes of each constraint …")
        arguments = command(
            "report",
            request.run_dir,
            out=page,
            json=rows,
            check=request.out / CHECK,
            physics=request.physics,
            episodes=request.episodes,
            pool=request.pool,
        )
        _run(request, "report", arguments, exit_codes=(0,))
    for row in read_json(rows, _MAX_REPORT_BYTES)["rows"]:
        note(f"  {row['constraint']:22s} success {100 * row['success']:5.1f} %")
    seconds = training_seconds(request.run_dir)
    duration = f"; the training took {seconds / 60:.1f} min" if seconds else ""
    note(f"The report is {page}{duration}.")


def _run(
    request: Request,
    name: str,
    arguments: list[str],
    *,
    exit_codes: tuple[int, ...],
    environment: Mapping[str, str] = types.MappingProxyType({}),
) -> None:
    """Runs a stage; raises a CongraspError unless it ends with one of the exit codes."""
    child = Child(name, arguments, request.out / f"{name}.log", dict(environment))
    code = run_child(child, _STAGE_TIMEOUT_S)
    if code in exit_codes:
        return
    if code is None:
        end = f"was ended after {_STAGE_TIMEOUT_S / 60:.0f} min"
    else:
        end = f"failed: {child.cause()}"
    raise CongraspError(f"The {name} of '{request.hand.name}' {end}", f"Read its log, {child.log}.")


def _short_training_note(request: Request) -> str:
    """Text about the short training, and about the full one on a GPU."""
    full = get_preset(FULL, request.reference)
    steps = _FULL_TASK_UPDATES * full.environments * full.rollout_steps * full.rollouts_per_update
    minutes = steps / _H200_STEPS_PER_S / 60
    return (
        "This machine has no GPU: a short training of an easier task follows, whose policy grasps "
        "from above at best. On a GPU the same command trains the full task: "
        f"{steps / 1e6:.0f} million steps, about {minutes:.0f} minutes of one H200 and five "
        "minutes for start and report."
    )
