"""Fixtures of the actors' tests."""

import pytest

from congrasp.actors.physics import make_physics
from congrasp.actors.physics.native import NativePhysics
from tests.task import HAND, TASK


@pytest.fixture
def native():
    """Makes native engines of objects for the suite's hand, and closes them."""
    engines = []

    def make(objects, task=TASK, threads=1):
        engines.append(NativePhysics(HAND, task, objects, threads))
        return engines[-1]

    yield make
    for engine in engines:
        engine.close()


@pytest.fixture(params=["native", "physx"])
def on_cpu(request):
    """Makes engines of either kind that steps on the CPU, for the suite's hand, and closes them."""
    if request.param == "physx":
        pytest.importorskip("sapien", reason="PhysX needs sapien: pip install 'congrasp[physx]'")
    engines = []

    def make(objects, task=TASK, threads=1):
        engines.append(make_physics(request.param, HAND, task, objects, threads=threads))
        return engines[-1]

    yield make
    for engine in engines:
        engine.close()
