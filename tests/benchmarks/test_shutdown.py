"""The measurement of shutdowns finds what it looks for, and real runs pass it."""

import signal
import sys

import pytest

from tests.benchmarks import shutdown

ORPHANING = """
import os, signal, subprocess, sys, time
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=True)
signal.signal(signal.SIGTERM, lambda *_: os._exit(143))
time.sleep(60)
"""
DEAF = "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); time.sleep(60)"


def test_what_is_left_behind_is_found_in_another_session_and_ended(monkeypatch):
    monkeypatch.setattr(shutdown, "PATIENCE", 1.0)
    found = shutdown.attempt([sys.executable, "-c", ORPHANING], 3.0, signal.SIGTERM)
    assert (found.code, found.processes, found.fine) == (143, 2, False)
    assert found.orphans == ("import time; time.sleep(60)",)


def test_a_process_that_ignores_the_signal_is_a_failure(monkeypatch):
    monkeypatch.setattr(shutdown, "PATIENCE", 0.5)
    found = shutdown.attempt([sys.executable, "-c", DEAF], 2.0, signal.SIGINT)
    assert found.seconds == float("inf") and not found.fine and found.processes == 1


def test_a_summary_counts_what_was_not_fine():
    results = [shutdown.Attempt("SIGINT", 1.0, 4, seconds, (), 130) for seconds in (1.0, 2.0, 7.0)]
    results.append(shutdown.Attempt("SIGTERM", 1.0, 4, 3.0, ("actor", "learner"), 143))
    text = "2 of 4 ended within 5 s with no orphan; median 2.50 s, longest 7.00 s, 2 orphan(s)"
    assert shutdown.summary(results) == text


@pytest.mark.slow
def test_a_run_that_starts_ends_on_a_signal_and_leaves_nothing_behind():
    for found in shutdown.attempts(2, within=8.0, seed=3):
        assert found.seconds < float("inf") and not found.orphans
        assert found.code != 0
