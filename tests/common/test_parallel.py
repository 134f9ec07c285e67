"""Work spread over processes."""

import operator
import signal
import subprocess
import sys
import time

import psutil
import pytest

from congrasp.common.runtime import parallel

_SCRIPT = """
import time
from congrasp.common.runtime.parallel import parallel_map
if __name__ == "__main__":
    parallel_map(time.sleep, [60.0] * 200)
"""


@pytest.mark.parametrize("count", [3, 200])
def test_results_are_those_of_map(count, monkeypatch):
    monkeypatch.setattr(parallel.os, "sched_getaffinity", lambda pid: {0, 1})
    assert parallel.parallel_map(operator.sub, range(count), [1] * count) == [i - 1 for i in range(count)]


def test_workers_end_with_a_killed_parent(tmp_path):
    if len(psutil.Process().cpu_affinity()) < 2:
        pytest.skip("one core: nothing is spread")
    script = tmp_path / "spread.py"
    script.write_text(_SCRIPT)
    parent = subprocess.Popen([sys.executable, script])
    try:
        deadline = time.monotonic() + 30
        workers: list[psutil.Process] = []
        while len(workers) < 3 and time.monotonic() < deadline:  # two workers and multiprocessing's own tracker
            time.sleep(0.1)
            workers = psutil.Process(parent.pid).children(recursive=True)
        assert len(workers) >= 3
        time.sleep(1.0)  # they have begun
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        _, alive = psutil.wait_procs(workers, timeout=15)
        assert not alive
    finally:
        parent.kill()
