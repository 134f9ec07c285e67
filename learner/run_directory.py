"""The directory of a run.

It holds `config.json`, `initial.safetensors` where training does not begin with random weights, `checkpoints/`,
`policy.safetensors` (that of the newest checkpoint), `logs/`, `audit/` (the outcome of every rollout), `accepted/`
(rollouts that no checkpoint holds yet), `version` (the newest version that was ever published, so that versions rise
over a crash, too), `endpoint` (where its learner listens, while it runs), `lock`
(held by the process of its learner) and, after an update that was not finite,
`failure/`.
What a resume could not read, or does not go on from, is kept beside it as `*.aside`.
"""

import contextlib
import dataclasses
import errno
import fcntl
import os
import pathlib
from collections.abc import Callable, Iterator

from congrasp.common.config import RunConfig, run_config_from_json, to_json
from congrasp.common.errors import CongraspError
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
CHANGEABLE = ("updates", "checkpoint_every", "write_ahead", "collapse_patience", "physics", "ppo", "distill")
"""Fields of the configuration that a run may go on with other values of; actors that are there do not use them."""


def create_run(run_dir: pathlib.Path, config: RunConfig, initial: PolicyBundle | None = None) -> None:
    """Makes a run directory.

    Args:
      run_dir: where.
      config: the run.
      initial: a policy to begin with instead of random weights: its networks and normalisers. Privileged inputs that
        its critic lacks start at zero weight.

    Raises:
      CongraspError: there is a run in it already, or what is left of one, or the initial policy does not fit the run.
    """
    if (run_dir / CONFIG_FILE).exists():
        raise CongraspError(
            f"{run_dir} holds a run already.", "Choose another --run-dir, or continue it with --resume."
        )
    if remains := _remains(run_dir):
        raise CongraspError(
            f"{run_dir} holds {remains[0].name} of a run, but no {CONFIG_FILE}.",
            "Put that back and add --resume, or choose another --run-dir.",
        )
    if initial is not None:
        spec = bundles.policy_spec(config.task, config.network)
        spec.require(initial.spec, "to begin with")
        run_dir.mkdir(parents=True, exist_ok=True)
        bundles.save(bundles.with_critic_of(spec, initial), run_dir / INITIAL_FILE)
    write_atomically(run_dir / CONFIG_FILE, to_json(config).encode())
    (run_dir / LOGS).mkdir(exist_ok=True)


def open_run(run_dir: pathlib.Path) -> RunConfig:
    """The configuration of a run directory; a CongraspError if it is not one, or the file is damaged."""
    path = run_dir / CONFIG_FILE
    try:
        text = read_file(path, _MAX_CONFIG)
    except OSError:
        raise CongraspError(
            f"{run_dir} is not a run directory: it has no {CONFIG_FILE}.", "Name one made by 'congrasp train'."
        ) from None
    try:
        return run_config_from_json(text)
    except CongraspError as error:
        raise CongraspError(f"{path} cannot be used: {error}") from None


@contextlib.contextmanager
def exclusive(run_dir: pathlib.Path, notify: Callable[[str], None] = lambda text: None) -> Iterator[None]:
    """Keeps other processes out of a run directory while the block runs; a process that dies gives it up.

    Args:
      run_dir: the run's directory.
      notify: told where the file system has no locks.

    Raises:
      CongraspError: another process has it.
    """
    # A lock by `lockf` is the process's own: forked children do not inherit it.
    with open(run_dir / _LOCK_FILE, "a+b", 0) as file:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EAGAIN):
                file.seek(0)
                holder = f"process {file.read(32).decode(errors='replace')}"
                url = learner_url(run_dir)
                raise CongraspError(
                    f"{run_dir} is in use by {holder}{f', which listens at {url}' if url else ''}.",
                    "Stop it first, or choose another --run-dir.",
                ) from None
            notify(f"{run_dir} is on a file system without locks: a second learner would go unnoticed.")
        else:
            with contextlib.suppress(OSError):  # a disk that is full costs the number in another's error and no more
                file.truncate(0)
                file.write(f"{os.getpid()}".encode())
        yield


@contextlib.contextmanager
def listening(run_dir: pathlib.Path, url: str) -> Iterator[None]:
    """Keeps in a run directory where its learner listens, while the block runs; a killed learner's stays."""
    path = run_dir / _ENDPOINT_FILE
    write_atomically(path, url.encode())
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def learner_url(run_dir: pathlib.Path) -> str:
    """Where the learner of a run directory listens; empty where none runs."""
    try:
        return read_file(run_dir / _ENDPOINT_FILE, _MAX_ENDPOINT).decode(errors="replace")
    except OSError:
        return ""


def has_checkpoints(run_dir: pathlib.Path) -> bool:
    """Whether a run can go on from a checkpoint; false for one that has not come to its first.

    Raises:
      CongraspError: the run had checkpoints, and they are gone; to begin it anew here would overwrite what is left.
    """
    if Checkpoints(run_dir / CHECKPOINTS).files():
        return True
    if remains := _remains(run_dir):
        policy = run_dir / POLICY_FILE
        begin = f" with --initial {policy}" if policy.exists() else ""
        raise CongraspError(
            f"{run_dir} has no checkpoint to resume from, but had one: there is {remains[0].name}.",
            f"Start anew in another --run-dir{begin}.",
        )
    return False


def _remains(run_dir: pathlib.Path) -> list[pathlib.Path]:
    """What only a run that has come to a checkpoint leaves behind."""
    found = [path for path in (run_dir / CHECKPOINTS).glob("*") if not path.name.startswith(".")]
    return sorted(found) + [path for path in [run_dir / POLICY_FILE] if path.exists()]


def continue_run(run_dir: pathlib.Path, config: RunConfig) -> None:
    """Keeps the configuration with which a run goes on.

    Args:
      run_dir: the run's directory.
      config: that of `open_run`, with what is to be different from now on.

    Raises:
      CongraspError: something differs that must not, this is no run directory, or a learner works in it.
    """
    before = open_run(run_dir)
    for field in dataclasses.fields(config):
        if field.name not in CHANGEABLE and getattr(config, field.name) != getattr(before, field.name):
            raise CongraspError(
                f"A run goes on with the '{field.name}' that it began with.",
                f"Begin another run with --initial {run_dir / POLICY_FILE}.",
            )
    with exclusive(run_dir):
        if config != before:
            write_atomically(run_dir / CONFIG_FILE, to_json(config).encode())


def note_version(run_dir: pathlib.Path, version: int) -> None:
    """Notes the newest version that was published.

    The file is overwritten in place, which needs no space on a disk that is full, and not flushed: this must survive
    the process, and a power cut costs no more than a version.

    Raises:
      CongraspError: it could not be written.
    """
    path = run_dir / _VERSION_FILE
    try:
        with open(os.open(path, os.O_WRONLY | os.O_CREAT, 0o644), "wb", 0) as file:
            file.write(f"{version:020d}\n".encode())
    except OSError as error:
        raise CongraspError(f"{path} could not be written: {error.strerror}.") from None


def published_version(run_dir: pathlib.Path) -> int:
    """The newest version of which the run's folder knows: by `note_version`, the policy or the journals; -1 if none."""
    try:
        noted = int((run_dir / _VERSION_FILE).read_text())
    except (OSError, ValueError):
        noted = -1
    policy = _policy_version(run_dir)
    known = (noted, -1 if policy is None else policy, journalled_version(run_dir))
    return max((version for version in known if version < _MAX_VERSION), default=-1)


def keep_policy(run_dir: pathlib.Path, version: int, on_event: Callable[[str, str], None]) -> None:
    """Keeps a policy file that is newer than the checkpoint that a run resumes from, or that cannot be read.

    Args:
      run_dir: the run's directory.
      version: of the checkpoint.
      on_event: given (level, text) if a file is kept under another name.

    Raises:
      CongraspError: it cannot be renamed.
    """
    path = run_dir / POLICY_FILE
    found = _policy_version(run_dir)
    if os.path.lexists(path) and (found is None or found > version):
        what = "cannot be read" if found is None else f"is of version {found}, newer than the checkpoint"
        on_event("warning", f"{path} {what}; it is kept as {set_aside(path)}.")


def _policy_version(run_dir: pathlib.Path) -> int | None:
    """The version of the run's policy file; None if there is none, or it is damaged."""
    try:
        return bundles.load(run_dir / POLICY_FILE).version
    except CongraspError:
        return None
