"""Fixtures of the learner's tests."""

import pytest

from tests.learner.hub_bench import Bench


@pytest.fixture
def bench():
    """Makes hubs with a peer each, which end with the test."""
    benches = []

    def make(**options):
        benches.append(Bench(**options))
        return benches[-1]

    yield make
    for opened in benches:
        opened.peer.close()
        opened.server.close()
