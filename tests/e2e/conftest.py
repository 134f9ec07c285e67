"""Fixtures of the tests with real processes."""

import pytest

from tests.cluster import Cluster


@pytest.fixture
def cluster(tmp_path):
    processes = Cluster(tmp_path)
    yield processes
    processes.close()
