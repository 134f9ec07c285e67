"""Fixtures of the services' tests."""

import contextlib
import logging
import os
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import numpy as np
import pytest


@pytest.fixture
def exit_code_of(monkeypatch: pytest.MonkeyPatch) -> Callable[[list[str]], Any]:
    """Runs the command line in this process, and returns the code with which it would end: starting
    a process and importing JAX takes seconds.
    """
    from congrasp.services.cli import main as cli

    def run(arguments: list[str]) -> Any:
        # Roles add a handler that stays
        monkeypatch.setattr(logging.getLogger(), "handlers", [*logging.getLogger().handlers])
        with mock.patch.dict(os.environ), pytest.raises(SystemExit) as end:
            cli.main(arguments)
        return end.value.code

    return run


@pytest.fixture(scope="session")
def example() -> Any:
    """The start of an episode of the human hand, whose request has a heading."""
    from congrasp.services.serve.load import example_episode

    return example_episode(1_000_000)


@pytest.fixture(scope="session")
def constraint_sets() -> Any:
    """Constraint sets of the suite's objects."""
    from congrasp.common.task.sampling.sets import make_sets
    from tests.task import HAND, OBJECTS, TASK, kept_banks

    with kept_banks():
        return make_sets(HAND, TASK, OBJECTS, 0)


@contextlib.contextmanager
def quick_imports() -> Iterator[None]:
    """Imports a mesh as its hull and two plain halves, whose errors count as zero, and a hand after
    a shorter search for its poses.

    Decomposition, errors, halves that a hand can hold and poses take most of an import's time.
    """
    from congrasp.services.assets.hands import poses
    from congrasp.services.assets.objects import assembly, collision
    from congrasp.services.assets.objects.decompose import Decomposition
    from congrasp.services.assets.objects.fidelity import Fidelity

    def hull(vertices: np.ndarray, faces: np.ndarray, **options: object) -> Decomposition:
        return Decomposition([np.asarray(vertices)], "hull", [])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collision, "decompose", hull)
        patch.setattr(collision, "fidelity", lambda *_: Fidelity(0.0, 0.0))
        patch.setattr(assembly, "cut_to_hold", lambda obj: obj)
        patch.setattr(poses, "RANDOM_STARTS", 0)
        yield


@pytest.fixture
def quick_import() -> Iterator[None]:
    """Quick imports in one test."""
    with quick_imports():
        yield
