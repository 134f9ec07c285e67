"""How many of an actor's requests overlap."""

import threading

import pytest

from congrasp.actors.pace import Pace, UploadWindow


def pace_of(**seconds):
    pace = Pace()
    for what, duration in seconds.items():
        pace.record(what, duration)
    return pace


@pytest.mark.parametrize(
    ("seconds", "number"),
    [
        ({}, 0),
        ({"ticket": 0.2}, 0),
        ({"ticket": 0.004, "rollout": 0.1}, 0),
        ({"ticket": 0.05, "rollout": 0.1}, 1),
        ({"ticket": 0.2, "rollout": 0.1}, 2),
        ({"ticket": 0.25, "rollout": 0.1}, 3),
        ({"ticket": 60.0, "rollout": 0.0}, 4),
    ],
)
def test_as_many_requests_overlap_as_rollouts_pass_during_one(seconds, number):
    assert pace_of(**seconds).overlap_count("ticket", most=4) == number


def test_a_single_slow_request_counts_little():
    pace = pace_of(rollout=1.0, ticket=0.01)
    pace.record("ticket", 0.1)
    assert pace.overlap_count("ticket", most=4) == 0
    for _ in range(5):
        pace.record("ticket", 0.1)
    assert pace.overlap_count("ticket", most=4) == 1


def fill(window):
    """Enters until the window is full; returns the number of rollouts in transit."""
    count = 0
    while window.enter(0.0):
        count += 1
    return count


def test_a_window_grows_while_uploads_do_not_queue_up_to_its_limit():
    window = UploadWindow(1, 3)
    assert fill(window) == 1
    for size in (2, 3, 3):
        window.record(0.2)
        assert window.size == size
        fill(window)


def test_a_window_shrinks_while_uploads_queue_down_to_its_least():
    window = UploadWindow(1, 8)
    for _ in range(3):
        fill(window)
        window.record(0.2)
    assert window.size == 4
    for size in (3, 2, 1, 1):
        window.record(0.7)
        assert window.size == size


def test_a_window_that_nobody_waits_for_stays():
    window = UploadWindow(1, 8)
    window.enter(0.0)
    window.record(0.2)
    assert window.size == 1


def test_who_waits_for_the_window_enters_when_another_leaves():
    window = UploadWindow(1, 1)
    assert window.enter(0.0)
    threading.Timer(0.1, window.leave).start()
    assert window.enter(10.0)
