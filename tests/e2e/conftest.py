"""Fixtures of the tests with real processes."""

import pytest

from tests.cluster import Cluster


@pytest.fixture
def cluster(tmp_path):
    made = Cluster(tmp_path)
    yield made
    made.close()
