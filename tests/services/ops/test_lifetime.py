"""Signals end a process within its grace, even one whose main thread cannot listen; children do not
outlive parents.
"""

import os
import signal
import subprocess
import sys

import psutil
import pytest

STUCK = """
import threading
from congrasp.services.ops.lifetime import on_signal
with on_signal(grace=0.2):
    print("ready", flush=True)
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()  # handlers run, and then it waits on for ever
"""
CHILD = """
import os, pathlib, signal
from congrasp.services.ops.lifetime import Child
child = Child("stopped", ["serve"], pathlib.Path(os.devnull))
os.kill(child.start(), signal.SIGSTOP)  # only SIGKILL ends it
print(child.process.pid, end=" ")
"""
PARENT = """
import os, subprocess, sys, time
child = subprocess.Popen(
    [sys.executable, "-c", "import time; from congrasp.services.ops.lifetime import follow_parent; follow_parent();"
     "print('ready', flush=True); time.sleep(60)"],
    env={**os.environ, "CONGRASP_PARENT": str(os.getpid())}, stdout=subprocess.PIPE, start_new_session=True)
child.stdout.readline()
print(child.pid, flush=True)
time.sleep(60)
"""


def start(code: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)


def test_a_process_that_is_stuck_ends_all_the_same():
    with start(STUCK) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=20)
    assert process.returncode == 130


def test_a_second_signal_ends_a_process_that_drains_for_long():
    with start(STUCK.replace("0.2", "600")) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(1)
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=20)
    assert process.returncode == 130


def test_a_forced_end_takes_the_children_along():
    with start(CHILD + STUCK) as process:
        pid, ready = process.stdout.readline().split()
        child = psutil.Process(int(pid))
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=20)
    assert ready == "ready"
    assert process.returncode == 143
    if running := child.is_running() and child.status() != psutil.STATUS_ZOMBIE:
        child.kill()
    assert not running


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="uses prctl")
def test_a_child_dies_with_a_parent_that_was_killed():
    with start(PARENT) as parent:
        child = psutil.Process(int(parent.stdout.readline()))
        os.kill(parent.pid, signal.SIGKILL)
        parent.wait(20)
        _, alive = psutil.wait_procs([child], timeout=20)
    assert not alive
