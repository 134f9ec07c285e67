"""Settings of the caller's process: results are those without them, and the settings remain."""

import functools

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


def results(setting: str, policy: str, environment: dict[str, str] | None = None) -> list[str]:
    """Lines of a process with this setting."""
    done = python("-m", "tests.settings_process", setting, policy, env=environment, timeout=400)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@functools.cache
def plain_results(policy: str) -> list[str]:
    """Lines of a process without settings."""
    lines = results("plain", policy)
    assert [line.split()[0] for line in lines] == [*ENTRIES, "changed"]
    assert lines[-1] == "changed []"
    return lines


@pytest.mark.parametrize(
    "setting",
    [
        pytest.param(name, marks=[] if name == "everything" else pytest.mark.slow)
        for name in SETTINGS
        if name != "plain"
    ],
)
def test_entries_ignore_settings_of_the_caller(setting, paper_policy):
    assert results(setting, str(paper_policy)) == plain_results(str(paper_policy))


def test_entries_ignore_variables_of_the_environment(paper_policy):
    lines = results("plain", str(paper_policy), ENVIRONMENT)
    assert lines == plain_results(str(paper_policy))
