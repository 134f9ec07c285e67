"""Settings of the caller's process: results are those without them, and the settings remain."""

import functools
import pathlib

import pytest

from tests.children import python
from tests.settings_process import ENTRIES, SETTINGS

ENVIRONMENT = {
    "JAX_ENABLE_X64": "1",
    "JAX_NUMPY_DTYPE_PROMOTION": "strict",
    "MUJOCO_GL": "osmesa",
    "MPLBACKEND": "module://not_installed",
    "PYTHONOPTIMIZE": "2",
}
"""Variables left over from other programs."""


def results(
    policy: pathlib.Path, *settings: str, environment: dict[str, str] | None = None
) -> list[str]:
    """Lines of a process that computes under one setting after the other."""
    command = ("-m", "tests.settings_process", policy, *settings)
    done = python(*command, env=environment, timeout=400)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_entries_ignore_all_settings_at_once(short_policy):
    """The results without them are those of the same process, whose programs are compiled once."""
    lines = results(short_policy, "everything", "plain", environment=ENVIRONMENT)
    count = len(ENTRIES) + 1
    assert [line.split()[0] for line in lines] == 2 * [*ENTRIES, "changed"]
    assert lines[:count] == lines[count:]
    assert lines[-1] == "changed []"


@functools.cache
def plain_results(policy: pathlib.Path) -> list[str]:
    """Lines of a process without settings."""
    return results(policy, "plain")


@pytest.mark.slow
@pytest.mark.parametrize("setting", [name for name in SETTINGS if name != "plain"])
def test_entries_ignore_a_setting(setting, paper_policy):
    assert results(paper_policy, setting) == plain_results(paper_policy)


@pytest.mark.slow
def test_entries_ignore_variables_of_the_environment(paper_policy):
    lines = results(paper_policy, "plain", environment=ENVIRONMENT)
    assert lines == plain_results(paper_policy)
