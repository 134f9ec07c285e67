"""The directory of a run.

It holds `config.json`, `initial.safetensors` (unless training starts from random weights),
`checkpoints/`, `policy.safetensors` (that of the newest checkpoint), `logs/`, `audit/` (the outcome
of every rollout), `accepted/` (rollouts that no checkpoint holds yet), `version` (the newest
version ever published, so that versions increase across a crash), `endpoint` (address of its
learner, while it runs), `lock` (held by the process of its learner) and, after an update that was
not finite, `failure/`. Files that a resume could not read, or does not continue from, are renamed
to `*.aside`.
"""

import contextlib
import dataclasses
import errno
import fcntl
import os
import pathlib
from collections.abc import Callable, Iterator
from typing import BinaryIO

from congrasp.common import named_inputs
from congrasp.common.config import NamedInput, RunConfig, run_config_from_json, to_json
from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.io.files import write_atomically
from congrasp.common.io.inputs import read_file
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.learner.checkpoint import Checkpoints, set_aside
from congrasp.learner.hub.used_rollouts import journalled_version

POLICY_FILE = "policy.safetensors"
INITIAL_FILE = "initial.safetensors"
CONFIG_FILE = "config.json"
LOGS = "logs"
CHECKPOINTS = "checkpoints"
_VERSION_FILE = "version"
_ENDPOINT_FILE = "endpoint"
_LOCK_FILE = "lock"
_MAX_VERSION = 1 << 53
_MAX_CONFIG = 1 << 20
_MAX_ENDPOINT = 1 << 10
CHANGEABLE = (
    "updates",
    "checkpoint_every",
    "write_ahead",
    "collapse_patience",
    "physics",
    "ppo",
    "distill",
)
"""Fields of the configuration that a resumed run may change; running actors do not use them."""


def create_run(
    run_dir: pathlib.Path, config: RunConfig, initial: PolicyBundle | None = None
) -> None:
    """Creates a run directory.

    Args:
      run_dir: path of the directory.
      config: the run.
      initial: initial policy instead of random weights: its networks and normalisers. Inputs of the
        state and of the critic that it lacks get zero weight.

    Raises:
      CongraspError: the directory already has a run, or remains of one; or the initial policy does
        not match the run.
    """
    if (run_dir / CONFIG_FILE).exists():
        raise CongraspError(
            f"{run_dir} already has a run.", "Pass another --run-dir, or --resume to continue it."
        )
    if remains := _remains(run_dir):
        raise CongraspError(
            f"{run_dir} has {remains[0].name} of a run, but no {CONFIG_FILE}.",
            "Restore that file and pass --resume, or pass another --run-dir.",
        )
    if initial is not None:
        spec = bundles.policy_spec(config.task, config.network)
        begun = bundles.with_inputs_of(spec, config.task, initial)
        bundles.save(begun, run_dir / INITIAL_FILE)
    write_atomically(run_dir / CONFIG_FILE, to_json(config).encode())
    (run_dir / LOGS).mkdir(exist_ok=True)


def open_run(run_dir: pathlib.Path) -> RunConfig:
    """Returns the configuration of a run directory; raises a CongraspError if it is not one, or the
    file is damaged.
    """
    path = run_dir / CONFIG_FILE
    if not path.exists():
        raise CongraspError(
            f"{run_dir} is not a run directory: it has no {CONFIG_FILE}.",
            "Pass one created by 'congrasp train'.",
        )
    text = read_file(path, _MAX_CONFIG)
    try:
        return run_config_from_json(text)
    except CongraspError as error:
        raise CongraspError(f"{path} is not valid: {error}") from None


@contextlib.contextmanager
def exclusive(
    run_dir: pathlib.Path, notify: Callable[[str], None] = lambda text: None
) -> Iterator[Callable[[], None]]:
    """Context that locks a run directory; the lock ends with the process.

    Args:
      run_dir: directory of the run.
      notify: called if the file system has no locks.

    Yields:
      A function that locks the directory again if the lock's file was removed; it raises a
      CongraspError if another process has taken the directory since.

    Raises:
      CongraspError: another process holds the lock.
    """
    path = run_dir / _LOCK_FILE
    with contextlib.ExitStack() as stack:
        held = stack.enter_context(_locked(run_dir, notify))

        def check() -> None:
            nonlocal held
            try:
                intact = os.path.samestat(os.fstat(held.fileno()), path.stat())
            except FileNotFoundError:
                intact = False
            if not intact:
                held = stack.enter_context(_locked(run_dir, notify))

        yield check


def _locked(run_dir: pathlib.Path, notify: Callable[[str], None]) -> BinaryIO:
    """The locked file of a run directory, see `exclusive`."""
    # A lock by `lockf` belongs to the process: forked children do not inherit it.
    file = open(run_dir / _LOCK_FILE, "a+b", 0)  # noqa: SIM115  the lock ends when it closes
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            file.seek(0)
            holder = f"process {file.read(32).decode(errors='replace')}"
            file.close()
            url = learner_url(run_dir)
            raise CongraspError(
                f"{run_dir} is in use by {holder}{f', which listens at {url}' if url else ''}.",
                "Stop it first, or choose another --run-dir.",
            ) from None
        notify(
            f"{run_dir} is on a file system without locks: a second learner would not be detected."
        )
    else:
        with contextlib.suppress(
            OSError
        ):  # a full disk only removes the number from another process's error
            file.truncate(0)
            file.write(f"{os.getpid()}".encode())
    return file


@contextlib.contextmanager
def listening(run_dir: pathlib.Path, url: str) -> Iterator[None]:
    """Context that stores the learner's address in a run directory; a killed learner's remains."""
    path = run_dir / _ENDPOINT_FILE
    write_atomically(path, url.encode())
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def learner_url(run_dir: pathlib.Path) -> str:
    """Address stored by `listening`; empty if there is none. It may be that of a killed learner."""
    try:
        return read_file(run_dir / _ENDPOINT_FILE, _MAX_ENDPOINT).decode(errors="replace")
    except CongraspError:
        return ""


def has_checkpoints(run_dir: pathlib.Path) -> bool:
    """True if a run has a checkpoint to resume from; False before its first one.

    Raises:
      CongraspError: the run had checkpoints that are gone; restarting it here would overwrite the
        rest.
    """
    if Checkpoints(run_dir / CHECKPOINTS).files():
        return True
    if remains := _remains(run_dir):
        policy = run_dir / POLICY_FILE
        begin = f" with --initial {policy}" if policy.exists() else ""
        raise CongraspError(
            f"{run_dir} has no checkpoint to resume from, although {remains[0].name} shows that it "
            f"had one.",
            f"Start again in another --run-dir{begin}.",
        )
    return False


def _remains(run_dir: pathlib.Path) -> list[pathlib.Path]:
    """Files that only a run with a checkpoint leaves behind."""
    found = [path for path in (run_dir / CHECKPOINTS).glob("*") if not path.name.startswith(".")]
    return sorted(found) + [path for path in [run_dir / POLICY_FILE] if path.exists()]


def continue_run(
    run_dir: pathlib.Path, config: RunConfig, initial: pathlib.Path | None = None
) -> RunConfig:
    """Stores the configuration with which a run continues, and returns it.

    Objects, constraint sets and teacher may have moved, but have the content that they had when the
    run began.

    Args:
      run_dir: directory of the run.
      config: that of `open_run`, with changed settings.
      initial: initial policy named on the command line, which must be that of the run.

    Raises:
      CongraspError: a setting differs that may not, as does the content of a file or folder that
        the run names, this is not a run directory, or a learner is using it.
    """
    before = open_run(run_dir)
    restart = f"Start another run with --initial {run_dir / POLICY_FILE}."
    restore = f"Restore it, or start another run with --initial {run_dir / POLICY_FILE}."
    config = named_inputs.with_absolute_paths(config)
    inputs = _continued_inputs(before, config, restore)
    if initial is not None:
        _check_initial(run_dir, before, initial)
    earlier = named_inputs.with_absolute_paths(before)
    comparable = named_inputs.with_paths_of(config, earlier) if before.inputs else config
    for field in dataclasses.fields(config):
        if field.name in (*CHANGEABLE, "inputs"):
            continue
        if getattr(comparable, field.name) != getattr(earlier, field.name):
            raise CongraspError(f"A run cannot change '{field.name}' when it is resumed.", restart)
    config = dataclasses.replace(config, inputs=inputs)
    with exclusive(run_dir):
        if config != before:
            write_atomically(run_dir / CONFIG_FILE, to_json(config).encode())
    return config


def _continued_inputs(before: RunConfig, config: RunConfig, remedy: str) -> tuple[NamedInput, ...]:
    """Checks the content of what a run names, and returns its records with the current paths."""
    if not before.inputs:  # of an earlier version of congrasp, or nothing is named
        return named_inputs.identified(config).inputs
    paths = named_inputs.paths_of(config)
    inputs: list[NamedInput] = []
    for each in before.inputs:
        path = paths.get(each.kind)
        if path is not None:
            named_inputs.check_input(each, path, remedy)
            each = dataclasses.replace(each, path=str(path))
        inputs.append(each)
    return tuple(inputs)


def _check_initial(run_dir: pathlib.Path, before: RunConfig, initial: pathlib.Path) -> None:
    """Raises a CongraspError if a run did not begin with this policy."""
    remedy = "Leave out --initial, or pass it to a new run in another --run-dir."
    records = [each for each in before.inputs if each.kind == named_inputs.INITIAL]
    for each in records:
        named_inputs.check_input(each, initial, remedy)
    if not records and not (run_dir / INITIAL_FILE).exists():
        raise CongraspError(f"{run_dir} did not begin with the policy {initial}.", remedy)


def note_version(run_dir: pathlib.Path, version: int) -> None:
    """Stores the newest published version.

    The file is overwritten in place, which needs no space on a full disk, and not flushed: it must
    survive the process, and a power failure loses at most a version.

    Raises:
      CongraspError: it could not be written.
    """
    path = run_dir / _VERSION_FILE
    how = os.O_WRONLY | os.O_CREAT
    with (
        os_errors_as(f"{path} could not be written"),
        open(os.open(path, how, 0o644), "wb", 0) as file,
    ):
        file.write(f"{version:020d}\n".encode())


def published_version(run_dir: pathlib.Path) -> int:
    """Newest version known to the run directory, from `version`, the policy or the journals; -1 if
    there is none.
    """
    try:
        noted = int((run_dir / _VERSION_FILE).read_text())
    except (OSError, ValueError):
        noted = -1
    policy = _policy_version(run_dir)
    known = (noted, -1 if policy is None else policy, journalled_version(run_dir))
    return max((version for version in known if version < _MAX_VERSION), default=-1)


def keep_policy(run_dir: pathlib.Path, version: int, on_event: Callable[[str, str], None]) -> None:
    """Renames a policy file that is newer than the checkpoint of a resume, or cannot be read.

    Args:
      run_dir: directory of the run.
      version: version of the checkpoint.
      on_event: called with (level, text) if a file is renamed.

    Raises:
      CongraspError: it cannot be renamed.
    """
    path = run_dir / POLICY_FILE
    found = _policy_version(run_dir)
    if os.path.lexists(path) and (found is None or found > version):
        what = (
            "cannot be read" if found is None else f"has version {found}, newer than the checkpoint"
        )
        on_event("warning", f"{path} {what}; it is kept as {set_aside(path)}.")


def _policy_version(run_dir: pathlib.Path) -> int | None:
    """Version of the run's policy file; None if it is missing or damaged."""
    try:
        return bundles.load(run_dir / POLICY_FILE).version
    except CongraspError:
        return None
