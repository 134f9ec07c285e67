"""Start of a run: checks of what can fail cheaply, before anything is created, and the removal of
what a failed start created.
"""

import contextlib
import dataclasses
import pathlib
import shutil
from collections.abc import Iterator
from typing import NamedTuple

from congrasp.common.config import RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.objects.pool import load_pool
from congrasp.common.policy.bundle import policy_spec
from congrasp.common.ranges import network_faults, option_fault, run_faults
from congrasp.common.runtime import platforms
from congrasp.common.task.sampling.set_file import SUFFIX as SET_SUFFIX
from congrasp.common.task.sampling.set_file import load
from congrasp.common.transport.keys import Keys
from congrasp.learner.algorithms import make_algorithm
from congrasp.learner.checkpoint import Checkpoints
from congrasp.learner.run_directory import CHECKPOINTS, LOGS, published_version

_OUT_OF_RANGE = "Give a value in the range."


def check_ranges(config: RunConfig) -> None:
    """Raises a `CongraspError` that names the first setting out of its range."""
    for fault in run_faults(config):
        raise CongraspError(f"{fault}.", _OUT_OF_RANGE)


def check_config(config: RunConfig) -> None:
    """Raises a `CongraspError` for settings with which the run's processes would end at once: its
    name, ranges, algorithm and teacher, objects and constraint sets.
    """
    Keys(config.name)
    check_ranges(config)
    spec = policy_spec(config.task, config.network)
    inputs = (*spec.layout, *spec.privileged)
    for fault in network_faults(config.network, inputs, spec.action_size):
        raise CongraspError(f"{option_fault('network.', fault)}.", _OUT_OF_RANGE)
    make_algorithm(spec, config)
    load_pool(dataclasses.replace(config.objects, count=min(1, config.objects.count)))
    if config.objects.constraints:
        _check_sets(config)


def _check_sets(config: RunConfig) -> None:
    """Raises a `CongraspError` if there are no constraint sets, or the first is for another
    hand.
    """
    folder = pathlib.Path(config.objects.constraints)
    files = sorted(folder.glob(f"*{SET_SUFFIX}"))
    if not files:
        raise CongraspError(
            f"{folder} contains no constraint set.",
            "Make sets with 'congrasp constraints import' or 'congrasp constraints generate'.",
        )
    hand = get_hand(config.task.hand).name
    of_hand = load(files[0]).meta["hand"]
    if of_hand != hand:
        raise CongraspError(
            f"The constraint sets in {folder} are for the hand '{of_hand}'.",
            f"Generate them for '{hand}', or train that hand.",
        )


def can_resume(run_dir: pathlib.Path) -> bool:
    """True if a run has a checkpoint, the first of which precedes its first rollout."""
    return bool(Checkpoints(run_dir / CHECKPOINTS).files())


class Folder(NamedTuple):
    """Content of a run's folder before the run was created."""

    run_dir: pathlib.Path
    entries: frozenset[pathlib.Path]
    absent: tuple[pathlib.Path, ...]
    """The folder and those above it that did not exist, the innermost first."""

    @staticmethod
    def of(run_dir: pathlib.Path) -> "Folder":
        """Returns the current content."""
        entries: frozenset[pathlib.Path] = frozenset()
        if run_dir.is_dir():
            entries = frozenset(run_dir.iterdir())
        folders = (run_dir, *run_dir.parents)
        absent = tuple(each for each in folders if not each.exists())
        return Folder(run_dir, entries, absent)


@contextlib.contextmanager
def removed_without_checkpoint(before: Folder) -> Iterator[None]:
    """Context of a new run, entered once it is created: if it ends without a checkpoint or an
    update, what is new in its folder is removed.
    """
    try:
        yield
    finally:
        if not can_resume(before.run_dir) and published_version(before.run_dir) <= 0:
            _restore(before)


def kept_log(run_dir: pathlib.Path, log: pathlib.Path) -> pathlib.Path:
    """Moves a process's log out of the folder of a run that did not start; returns its new path."""
    target = run_dir.with_name(f"{run_dir.name}.failed.log")
    if log.parent != run_dir / LOGS:
        return log
    with contextlib.suppress(OSError):
        return platforms.replace(log, target)
    return log


def _restore(before: Folder) -> None:
    """Removes what is new in a folder, then the folders that did not exist."""
    if not before.run_dir.is_dir():
        return
    for path in set(before.run_dir.iterdir()) - before.entries:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    for folder in before.absent:
        with contextlib.suppress(OSError):
            folder.rmdir()
