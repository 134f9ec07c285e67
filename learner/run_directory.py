"""The directory of a run.

It holds `config.json`, `initial.safetensors` where training does not begin with random weights, `checkpoints/`,
`policy.safetensors` (that of the newest checkpoint), `logs/`, `audit/` (the outcome of every rollout), `version` (the
newest version that was ever published, so that versions rise over a crash, too) and, after an update that was not
finite, `failure/`.
"""

import dataclasses
import os
import pathlib

from common.config import RunConfig, run_config_from_json, to_json
from common.errors import CongraspError
from common.files import write_atomically
from common.policy import bundle as bundles
from common.policy.bundle import PolicyBundle

POLICY_FILE = "policy.safetensors"
INITIAL_FILE = "initial.safetensors"
CONFIG_FILE = "config.json"
LOGS = "logs"
_VERSION_FILE = "version"
CHANGEABLE = ("updates", "checkpoint_every", "collapse_patience", "physics", "ppo")
"""Fields of the configuration that a run may go on with other values of; actors that are there do not use them."""


def create_run(run_dir: pathlib.Path, config: RunConfig, initial: PolicyBundle | None = None) -> None:
    """Makes a run directory.

    Args:
      run_dir: where.
      config: the run.
      initial: a policy to begin with instead of random weights: its networks and normalisers.

    Raises:
      CongraspError: there is a run in it already, or the initial policy does not fit the run.
    """
    if (run_dir / CONFIG_FILE).exists():
        raise CongraspError(
            f"{run_dir} holds a run already.", "Choose another --run-dir, or continue it with --resume."
        )
    if initial is not None:
        bundles.policy_spec(config.task, config.network).require(initial.spec, "to begin with")
        run_dir.mkdir(parents=True, exist_ok=True)
        bundles.save(initial, run_dir / INITIAL_FILE)
    write_atomically(run_dir / CONFIG_FILE, to_json(config).encode())
    (run_dir / LOGS).mkdir(exist_ok=True)


def open_run(run_dir: pathlib.Path) -> RunConfig:
    """The configuration of a run directory; a CongraspError if it is not one."""
    try:
        text = (run_dir / CONFIG_FILE).read_bytes()
    except OSError:
        raise CongraspError(
            f"{run_dir} is not a run directory: it has no {CONFIG_FILE}.", "Name one made by 'congrasp train'."
        ) from None
    return run_config_from_json(text)


def continue_run(run_dir: pathlib.Path, config: RunConfig) -> None:
    """Keeps the configuration with which a run goes on.

    Args:
      run_dir: the run's directory.
      config: that of `open_run`, with what is to be different from now on.

    Raises:
      CongraspError: something differs that must not, or this is no run directory.
    """
    before = open_run(run_dir)
    for field in dataclasses.fields(config):
        if field.name not in CHANGEABLE and getattr(config, field.name) != getattr(before, field.name):
            raise CongraspError(
                f"A run goes on with the '{field.name}' that it began with.",
                f"Begin another run with --initial {run_dir / POLICY_FILE}.",
            )
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
    """The version of `note_version`; -1 if there is none."""
    try:
        return int((run_dir / _VERSION_FILE).read_text())
    except (OSError, ValueError):
        return -1
