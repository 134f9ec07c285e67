"""Fixtures of the services' tests."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest


@pytest.fixture(scope="session")
def example() -> Any:
    """The start of an episode of the human hand, whose request has a heading."""
    from congrasp.services.serve.load import example_episode

    return example_episode(1_000_000)


@pytest.fixture(scope="session")
def constraint_sets() -> Any:
    """Constraint sets of the suite's objects."""
    from congrasp.common.task.sampling.sets import make_sets
    from tests.task import HAND, OBJECTS, TASK

    return make_sets(HAND, TASK, OBJECTS, 0)


@contextlib.contextmanager
def quick_imports() -> Iterator[None]:
    """Imports a mesh as its hull and two plain halves; the pieces' errors count as zero.

    Decomposition, errors and halves that a hand can hold take most of an import's time.
    """
    from congrasp.services.assets.objects import assembly, collision
    from congrasp.services.assets.objects.decompose import Decomposition
    from congrasp.services.assets.objects.fidelity import Fidelity

    def hull(vertices: np.ndarray, faces: np.ndarray, **options: object) -> Decomposition:
        return Decomposition([np.asarray(vertices)], "hull", [])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(collision, "decompose", hull)
        patch.setattr(collision, "fidelity", lambda *_: Fidelity(0.0, 0.0))
        patch.setattr(assembly, "cut_to_hold", lambda obj: obj)
        yield


@pytest.fixture
def quick_import() -> Iterator[None]:
    """Quick imports in one test."""
    with quick_imports():
        yield
