"""All ranks are started again when one dies; scripts stand in for them."""

import pathlib
import subprocess
import sys
import threading

import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.services.ops.lifetime import command
from congrasp.services.train import processes
from congrasp.services.train.processes import Child

WAITS = "import time; time.sleep(60)"


def test_options_become_arguments():
    given = {"run_dir": "a", "resume": True, "certs": None, "insecure": False, "port": 0, "metric_writers": ()}
    assert command("learner", **given) == ["learner", "--run-dir", "a", "--resume", "--port", "0", "--metric-writers"]


class Script(Child):
    """A child whose lives are Python programs, one after the other."""

    def start(self) -> None:
        life = self.arguments[min(self.restarts, len(self.arguments) - 1)]
        with self.log.open("ab") as log:
            self.process = subprocess.Popen([sys.executable, "-c", life], stdout=log, stderr=log)


@pytest.fixture
def supervise(tmp_path: pathlib.Path):
    children: list[Script] = []
    notes: list[str] = []

    def run(*lives: list[str]) -> list[str]:
        children.extend(Script(f"rank-{i}", programs, tmp_path / f"{i}.log") for i, programs in enumerate(lives))
        for child in children:
            child.start()
        with MemoryTransport(MemoryHub()) as transport:
            processes._supervise(children, [], transport, "run", threading.Event(), lambda status: None, notes.append)
        return notes

    yield run
    processes.end_all(children)
    assert all(child.process.poll() is not None for child in children)


def test_one_that_dies_takes_the_others_with_it_and_all_come_back(supervise, tmp_path):
    writes = f"import pathlib; pathlib.Path({str(tmp_path)!r}, 'again').touch(); {WAITS}"
    waits_for_it = (
        f"import pathlib, time\nwhile not pathlib.Path({str(tmp_path)!r}, 'again').exists(): time.sleep(0.05)"
    )
    notes = supervise([WAITS, waits_for_it], ["raise SystemExit(9)", writes])
    assert notes == ["The rank-1 died (exit code 9); restarting all ranks."]


def test_bad_input_of_any_rank_ends_the_run_with_its_last_words(supervise):
    complains = "import sys; print('congrasp: error: The port is in use.'); sys.exit(2)"
    follows = "import sys, time; time.sleep(0.2); print('Rank 1 ended.'); sys.exit(4)"
    with pytest.raises(CongraspError, match="The rank-1 failed: The port is in use"):
        supervise([follows], [complains])


@pytest.mark.parametrize(("visible", "names"), [("", ["0", "1"]), ("4,GPU-7", ["4", "GPU-7"])])
def test_each_rank_sees_one_of_the_visible_gpus(monkeypatch, visible, names):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert [processes._gpu(rank) for rank in range(2)] == names
