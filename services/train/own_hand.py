"""The flow of `congrasp hands train`: self-check, training, evaluation, and one report about a
hand.

Each stage is a separate command in a separate process, so that it has the whole GPU memory. Results
are in one folder, and repeating the command runs only the missing stages.
"""

import dataclasses
import pathlib
import time
from collections.abc import Callable, Sequence

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

HAND, CHECK, REPORT = "hand.json", "check.json", "report.html"
_ROWS = "report.json"
_LARGEST = 1 << 24  # limit of a file of rows in bytes
_PATIENCE = 1800.0  # deadline of a check or a report, s
_LINE_SECONDS = 10.0
_UPDATES = 560  # updates of the full task: with check and report, some 15 minutes of one H200
_RATE = 350_000  # trained steps per second of one H200


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
        note(_what_a_gpu_would_take(request))
    policy = finished_policy(request.run_dir)
    if policy is None:
        policy = _train(request, note)
    _install(request, policy, note)
    _report(request, policy, note)
    return policy


def _begin(request: Request) -> None:
    """Creates the folder for this hand; raises a CongraspError if it holds the training of
    another.
    """
    file, text = request.out / HAND, hand_text(request.hand).encode()
    if file.exists() and file.read_bytes() == text:
        return
    if any(request.out.glob(f"*/{CONFIG_FILE}")):
        raise CongraspError(
            f"{request.out} holds the training of another hand, or of an earlier version of this "
            f"one.",
            "Pass another --out, or remove the folder.",
        )
    (request.out / CHECK).unlink(missing_ok=True)
    write_atomically(file, text)


def _check(request: Request, note: Callable[[str], None]) -> None:
    """Runs the self-check, unless it exists."""
    file = request.out / CHECK
    if not file.exists():
        arguments = command(
            "hands", "check", request.reference, json=file, png=file.with_suffix(".png")
        )
        _run(request, "check", arguments, (0, 1), {"JAX_PLATFORMS": "cpu"})
    findings: list[Finding] = read_findings(file)
    for finding in findings:
        note(str(finding))
    if any(finding.verdict == "failed" for finding in findings) and not request.anyway:
        raise CongraspError(
            f"The hand '{request.hand.name}' failed its self-check ({file.with_suffix('.png')}).",
            "Repair its file as the lines say, or pass --anyway to train it regardless.",
        )


def _train(request: Request, note: Callable[[str], None]) -> pathlib.Path:
    """Runs the training, or resumes it."""
    chosen = command(preset=FULL if request.full else "quickstart", hand=request.reference)
    log = request.run_dir.with_name(f"{request.run_dir.name}.log")
    note(f"Training {request.hand.name} in {request.run_dir} (log: {log})")
    said, told = time.monotonic(), ""

    def progress(line: str) -> None:
        """Notes a line periodically."""
        nonlocal said, told
        if line != told and time.monotonic() - said > _LINE_SECONDS:
            said, told = time.monotonic(), line
            note(f"  {line}")

    options = [
        *(command(physics=request.physics, updates=_UPDATES) if request.full else []),
        *request.options,
    ]
    train_in_background(
        request.run_dir, chosen, options, patience=request.patience, progress=progress
    )
    return request.run_dir / POLICY_FILE


def _install(request: Request, policy: pathlib.Path, note: Callable[[str], None]) -> None:
    """Installs the policy for `--hand`, unless there is one of this hand with more experience."""
    hand, own = request.hand, own_policy_file(request.hand.name)
    if not hand.text and hand.name in pretrained_hands():
        note(f"--hand {hand.name} remains the package's policy; this one is --policy {policy}.")
        return
    if own.exists():
        there, fresh = bundles.load(own), bundles.load(policy)
        if there.spec.hand == hand.reference and there.transitions > fresh.transitions:
            note(
                f"{own} has more training ({there.transitions:,} steps) and remains; this one is "
                f"--policy {policy}."
            )
            return
    write_atomically(own, policy.read_bytes())
    note(f"The policy of --hand {hand.name} is {own}.")


def _report(request: Request, policy: pathlib.Path, note: Callable[[str], None]) -> None:
    """Runs evaluation and report, unless they exist for this policy."""
    rows, page = request.out / _ROWS, request.out / REPORT
    about = {
        "content": bundles.content_hash(policy.read_bytes()),
        "episodes": request.episodes,
        "pool": request.pool,
    }
    if not (page.exists() and rows.exists() and about.items() <= read_json(rows, _LARGEST).items()):
        note(f"Evaluating {request.episodes} episodes of each constraint …")
        measured = {"physics": request.physics, "episodes": request.episodes, "pool": request.pool}
        check = request.out / CHECK
        arguments = command("report", request.run_dir, out=page, json=rows, check=check, **measured)
        _run(request, "report", arguments, (0,), {})
    for row in read_json(rows, _LARGEST)["rows"]:
        note(f"  {row['constraint']:22s} success {100 * row['success']:5.1f} %")
    took = training_seconds(request.run_dir)
    note(f"The report is {page}" + (f"; the training took {took / 60:.1f} min." if took else "."))


def _run(
    request: Request,
    name: str,
    arguments: list[str],
    fine: tuple[int, ...],
    environment: dict[str, str],
) -> None:
    """Runs a stage; raises a CongraspError unless it ends with one of the exit codes."""
    child = Child(name, arguments, request.out / f"{name}.log", environment)
    code = run_child(child, _PATIENCE)
    if code not in fine:
        why = (
            f"was ended after {_PATIENCE / 60:.0f} min"
            if code is None
            else f"failed: {child.cause()}"
        )
        raise CongraspError(
            f"The {name} of '{request.hand.name}' {why}", f"Its log is {child.log}."
        )


def _what_a_gpu_would_take(request: Request) -> str:
    """Describes what the short training omits."""
    full = get_preset(FULL, request.reference)
    steps = _UPDATES * full.environments * full.rollout_steps * full.rollouts_per_update
    return (
        "This machine has no GPU: a short training of an easier task follows, whose policy grasps "
        "from above at "
        f"best. On a GPU the same command trains the full task: {steps / 1e6:.0f} million steps, "
        f"about "
        f"{steps / _RATE / 60:.0f} minutes of one H200 and five minutes for start and report."
    )
