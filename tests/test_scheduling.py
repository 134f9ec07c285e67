"""Which worker gets which module, and memory that a worker gives back."""

import types

import psutil
import pytest

from tests.conftest import return_freed_memory
from tests.scheduling import LoadFolderScheduling

MODULES = ("a/test_1.py", "b/test_1.py", "a/test_2.py", "c/test_1.py", "a/test_3.py", "c/test_2.py")


class Worker:
    """Takes tests by their index."""

    shutting_down = False
    gateway = types.SimpleNamespace(id="gw")

    def __init__(self):
        self.modules = []

    def send_runtest_some(self, indices):
        self.modules += [MODULES[index] for index in indices]

    def shutdown(self):
        self.shutting_down = True


@pytest.fixture
def scheduler(monkeypatch):
    """Of two workers that have collected a test of each module."""
    monkeypatch.setattr("xdist.scheduler.loadscope.parse_tx_spec_config", lambda config: [0, 1])
    option = types.SimpleNamespace(loadscopereorder=False)
    made = LoadFolderScheduling(types.SimpleNamespace(option=option, hook=None), None)
    for _ in range(2):
        worker = Worker()
        made.add_node(worker)
        made.add_node_collection(worker, [f"{module}::test" for module in MODULES])
    return made


def test_a_worker_continues_with_its_folder(scheduler):
    scheduler.schedule()
    first, second = scheduler.nodes
    assert first.modules == ["a/test_1.py", "a/test_2.py"]
    assert second.modules == ["b/test_1.py", "c/test_1.py"]


def test_a_worker_without_a_folder_helps_another(scheduler):
    scheduler.schedule()
    second = scheduler.nodes[1]
    for index in (1, 3, 5):
        scheduler.mark_test_complete(second, index)
    assert second.modules[2:] == ["c/test_2.py", "a/test_3.py"]


def test_freed_memory_is_returned():
    process = psutil.Process()
    pieces = [bytes(1000) for _ in range(100_000)]
    last = bytes(1000)  # behind them, so that the end of the heap stays in use
    large = process.memory_info().rss
    del pieces
    return_freed_memory()
    assert last
    assert process.memory_info().rss < large - 50e6
