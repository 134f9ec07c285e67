"""Fixtures of the actors' tests."""

import pytest

from congrasp.actors.physics.native import NativePhysics
from tests.task import HAND, TASK


@pytest.fixture
def native():
    """Makes native engines of objects for the suite's hand, and closes them."""
    made = []

    def make(objects, task=TASK, threads=1):
        made.append(NativePhysics(HAND, task, objects, threads))
        return made[-1]

    yield make
    for engine in made:
        engine.close()
