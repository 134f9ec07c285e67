"""The directory of a run.

It holds `config.json`, its checksum `config.sha256`, `launch.json` (`services.train.launch`),
`initial.safetensors` (unless training starts from random weights),
`checkpoints/`, `policy.safetensors` (that of the newest checkpoint), `logs/`, `audit/` (the outcome
of every rollout), `accepted/` (rollouts that no checkpoint holds yet), `version` (the newest
version ever published, so that versions increase across a crash), `endpoint` (address of its
learner, while it runs), `lock` (held by the process of its learner), `launch.lock` (held by the
`congrasp train` that starts its processes), `claim` and `launch.claim` (in their place on a file
system without locks) and, after an update that was not finite, `failure/`. Files that a resume
could not read, or does not continue from, are renamed to `*.aside`.
"""

import codecs
import contextlib
import dataclasses
import hashlib
import os
import pathlib
import shlex
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

from congrasp.common import named_inputs
from congrasp.common.config import NamedInput, RunConfig, run_config_from_json, to_json
from congrasp.common.errors import CongraspError, os_errors_as
from congrasp.common.io.claims import Claim
from congrasp.common.io.files import check_output, write_atomically
from congrasp.common.io.inputs import read_file
from congrasp.common.io.locks import FIRST_READABLE, NoLocksError, try_lock
from congrasp.common.io.opening import open_to_update
from congrasp.common.io.spelling import check_spelling
from congrasp.common.runtime.lazy_module import LazyModule
from congrasp.learner.checkpoint import Checkpoints, read_checkpoint, set_aside
from congrasp.learner.hub.used_rollouts import journalled_version

if TYPE_CHECKING:
    from congrasp.common.policy import bundle as bundles
    from congrasp.common.policy.bundle import PolicyBundle
else:
    bundles = LazyModule("congrasp.common.policy.bundle")  # imports JAX

POLICY_FILE = "policy.safetensors"
INITIAL_FILE = "initial.safetensors"
CONFIG_FILE = "config.json"
CHECKSUM_FILE = "config.sha256"
LOGS = "logs"
CHECKPOINTS = "checkpoints"
_VERSION_FILE = "version"
_ENDPOINT_FILE = "endpoint"
_MAX_VERSION = 1 << 53
_MAX_CONFIG_BYTES = 1 << 20
_MAX_LINE_BYTES = 1 << 10
"""Limit of files with one line: checksum, endpoint, version."""
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


class _LockFiles(NamedTuple):
    """Names of a lock and of the claim that replaces it on a file system without locks."""

    lock: str
    claim: str


_LEARNER_LOCK = _LockFiles("lock", "claim")
_LAUNCH_LOCK = _LockFiles("launch.lock", "launch.claim")


def create_run(
    run_dir: pathlib.Path, config: RunConfig, initial: "PolicyBundle | None" = None
) -> None:
    """Creates a run directory.

    Args:
      run_dir: path of the directory.
      config: the run.
      initial: initial policy instead of random weights: its networks and normalisers. Inputs of the
        state and of the critic that it lacks get zero weight. A policy without a critic gets a new
        one.

    Raises:
      CongraspError: the directory cannot be created, already has a run or remains of one, or the
        initial policy does not match the run.
    """
    check_output("--run-dir", run_dir, is_folder=True)
    check_spelling(run_dir)
    if (run_dir / CONFIG_FILE).exists():
        raise CongraspError(
            f"{run_dir} already contains a run.",
            "Pass another --run-dir, or --resume to resume the run.",
        )
    if remains := _remains(run_dir):
        raise CongraspError(
            f"{run_dir} has {remains[0].name} of a run, but no {CONFIG_FILE}.",
            "Restore that file and pass --resume, or pass another --run-dir.",
        )
    if initial is not None:
        spec = bundles.policy_spec(config.task, config.network)
        begun = bundles.with_inputs_of(spec, config.task, initial)
        if not begun.has_critic:
            begun = bundles.with_new_critic(begun, config.seed)
        bundles.save(begun, run_dir / INITIAL_FILE)
    store_config(run_dir, config)
    (run_dir / LOGS).mkdir(exist_ok=True)


def initial_notes(initial: "PolicyBundle", config: RunConfig, file: pathlib.Path) -> Iterator[str]:
    """Yields a line on each part of a run's networks that the initial policy does not determine.

    Args:
      initial: the initial policy of `create_run`.
      config: the run.
      file: file of the policy, for the lines.
    """
    spec = bundles.policy_spec(config.task, config.network)
    if not initial.has_critic:
        yield f"{file} has no critic; a new one starts with random weights."
    same_critic = not initial.has_critic or initial.spec.privileged == spec.privileged
    if initial.spec.layout != spec.layout or not same_critic:
        yield (
            f"{file} has other inputs than this run's policy or critic; the new ones start at "
            f"zero weight."
        )


def store_config(run_dir: pathlib.Path, config: RunConfig) -> None:
    """Writes a run's configuration, with its checksum before it.

    A process that is killed between the two leaves the configuration of the newest checkpoint.
    """
    text = to_json(config).encode()
    write_atomically(run_dir / CHECKSUM_FILE, f"{config_checksum(text)}\n".encode())
    write_atomically(run_dir / CONFIG_FILE, text)


def config_checksum(text: bytes) -> str:
    """SHA-256 of a run's configuration as JSON, which its checkpoints keep.

    An editor's mark at the beginning, and its line ends, make no difference.
    """
    plain = text.removeprefix(codecs.BOM_UTF8).replace(b"\r\n", b"\n").strip()
    return hashlib.sha256(plain).hexdigest()


def check_config_unchanged(run_dir: pathlib.Path, kept: str) -> None:
    """Raises a CongraspError if the configuration file was changed by something else than congrasp.

    Args:
      run_dir: directory of the run.
      kept: checksum in the checkpoint from which it resumes; empty in one of an older version.
    """
    try:
        line = read_file(run_dir / CHECKSUM_FILE, _MAX_LINE_BYTES)
        stored = line.decode(errors="replace").strip()
    except CongraspError:
        stored = ""
    expected = {kept, stored} - {""}
    actual = config_checksum(read_file(run_dir / CONFIG_FILE, _MAX_CONFIG_BYTES))
    if expected and actual not in expected:
        raise CongraspError(
            f"{run_dir / CONFIG_FILE} is damaged or was edited: its checksum is neither that of "
            f"the checkpoint nor that in {CHECKSUM_FILE}.",
            f"Restore it from a copy. To change a setting, pass it as an option with --resume, or "
            f"{_another_run(run_dir)}.",
        )


def _another_run(run_dir: pathlib.Path) -> str:
    """Remedy: another run, which starts from the policy of this run if there is one."""
    policy = run_dir / POLICY_FILE
    if not policy.exists():
        return "start another run"
    return f"start another run with --initial {shlex.quote(str(policy))}"


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
    text = read_file(path, _MAX_CONFIG_BYTES)
    try:
        return run_config_from_json(text)
    except CongraspError as error:
        raise CongraspError(f"{path} is not valid: {error}") from None


@contextlib.contextmanager
def exclusive(
    run_dir: pathlib.Path,
    notify: Callable[[str], None] = lambda text: None,
    files: _LockFiles = _LEARNER_LOCK,
) -> Iterator[Callable[[], None]]:
    """Context that locks a run directory for its learner; the lock ends with the process.

    Args:
      run_dir: directory of the run.
      notify: called if the file system has no locks; a claim (`common.io.claims`) replaces them.
      files: names of the lock's files.

    Yields:
      A function that locks the directory again if the lock's file was removed; it raises a
      CongraspError if another process has taken the directory since.

    Raises:
      CongraspError: another process holds the lock.
    """
    path = run_dir / files.lock
    with contextlib.ExitStack() as stack:
        try:
            held = stack.enter_context(_open_locked(path))
        except NoLocksError:
            notify(f"{run_dir} is on a file system without locks: {files.claim} stands in for one.")
            claim = Claim(run_dir / files.claim)
            stack.callback(claim.close)
            yield claim.check
            return

        def check() -> None:
            nonlocal held
            try:
                intact = os.path.samestat(os.fstat(held.fileno()), path.stat())
            except FileNotFoundError:
                intact = False
            if not intact:
                held = stack.enter_context(_open_locked(path))

        yield check


@contextlib.contextmanager
def supervised(
    run_dir: pathlib.Path, notify: Callable[[str], None] = lambda text: None
) -> Iterator[None]:
    """Context that reserves a run directory for the process that starts and restarts its learner.

    The directory is also reserved while the learner does not run. See `exclusive` for the
    arguments and errors.
    """
    with exclusive(run_dir, notify, _LAUNCH_LOCK):
        yield


def _open_locked(path: pathlib.Path) -> BinaryIO:
    """Opens and locks a file of a run directory (`exclusive`); closing the file unlocks it."""
    with os_errors_as(f"{path} cannot be opened", "Choose another --run-dir."):
        file = open_to_update(path)
    with contextlib.ExitStack() as stack:
        stack.enter_context(file)
        if not try_lock(file):
            file.seek(FIRST_READABLE)
            raise _in_use(path.parent, file.read(32).decode(errors="replace").strip())
        stack.pop_all()
    # A full disk only removes the number from another process's error.
    with contextlib.suppress(OSError):
        file.truncate(0)
        file.write(f"{' ' * FIRST_READABLE}{os.getpid()}".encode())
    return file


def _in_use(run_dir: pathlib.Path, process: str) -> CongraspError:
    """Error of a run directory that another process has locked."""
    url = learner_url(run_dir)
    address = f", which listens at {url}" if url else ""
    return CongraspError(
        f"{run_dir} is in use by process {process}{address}.",
        "Stop it first, or choose another --run-dir.",
    )


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
        return read_file(run_dir / _ENDPOINT_FILE, _MAX_LINE_BYTES).decode(errors="replace")
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
        raise CongraspError(
            f"{run_dir} has no checkpoint to resume from, although {remains[0].name} shows that it "
            f"had one.",
            f"In another --run-dir, {_another_run(run_dir)}.",
        )
    return False


def _remains(run_dir: pathlib.Path) -> list[pathlib.Path]:
    """Files that only a run with a checkpoint leaves behind."""
    entries = (run_dir / CHECKPOINTS).glob("*")
    remains = sorted(path for path in entries if not path.name.startswith("."))
    policy = run_dir / POLICY_FILE
    if policy.exists():
        remains.append(policy)
    return remains


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
    check_config_unchanged(run_dir, _kept_checksum(run_dir))
    another = _another_run(run_dir)
    restart = f"{another[0].upper()}{another[1:]}."
    restore = f"Restore it, or {another}."
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
            store_config(run_dir, config)
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
        raise CongraspError(f"{run_dir} did not start from the policy {initial}.", remedy)


def _kept_checksum(run_dir: pathlib.Path) -> str:
    """Checksum of the configuration in the newest intact checkpoint; empty if there is none."""
    checkpoints = Checkpoints(run_dir / CHECKPOINTS)
    for path in checkpoints.files():
        with contextlib.suppress(CongraspError):
            _, meta = read_checkpoint(path)
            return str(meta.get("config", ""))
    return ""


def note_version(run_dir: pathlib.Path, version: int) -> None:
    """Stores the newest published version.

    The file is overwritten in place, which needs no space on a full disk, and not flushed: it must
    survive the process, and a power failure loses at most a version.

    Raises:
      CongraspError: it could not be written.
    """
    path = run_dir / _VERSION_FILE
    with os_errors_as(f"{path} could not be written"), open_to_update(path) as file:
        file.write(f"{version:020d}\n".encode())


def published_version(run_dir: pathlib.Path) -> int:
    """Newest version known to the run directory, from `version`, the policy or the journals; -1 if
    there is none.
    """
    return max(version_of_files(run_dir), _possible(journalled_version(run_dir)))


def version_of_files(run_dir: pathlib.Path) -> int:
    """Newest version known to the run directory without its journals: from `version`, the policy
    or the newest checkpoint; -1 if there is none.
    """
    try:
        noted = int(read_file(run_dir / _VERSION_FILE, _MAX_LINE_BYTES))
    except (CongraspError, ValueError):
        noted = -1
    of_policy = _policy_version(run_dir)
    if of_policy is None:
        of_policy = -1
    of_checkpoint = Checkpoints(run_dir / CHECKPOINTS).newest()
    return max(_possible(noted), _possible(of_policy), _possible(of_checkpoint))


def _possible(version: int) -> int:
    """The version; -1 for a damaged one."""
    if version < _MAX_VERSION:
        return version
    return -1


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
    if not os.path.lexists(path):
        return
    policy_version = _policy_version(run_dir)
    if policy_version is None:
        problem = "cannot be read"
    elif policy_version > version:
        problem = f"has version {policy_version}, newer than the checkpoint"
    else:
        return
    on_event("warning", f"{path} {problem}; it is kept as {set_aside(path)}.")


def _policy_version(run_dir: pathlib.Path) -> int | None:
    """Version of the run's policy file; None if it is missing or damaged."""
    try:
        return bundles.load(run_dir / POLICY_FILE).version
    except CongraspError:
        return None
