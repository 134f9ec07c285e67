"""A training that ends with its first update, as warm-up and benchmarks run it."""

import pathlib
import threading

from congrasp.common.config import RunConfig
from congrasp.services.train import learn as training


def test_it_ends_with_the_first_update_and_leaves_no_run_behind(monkeypatch):
    seen, events = {}, []

    def learn(run_dir, config, *, wire, inside, stop, on_update, grace):
        seen.update(run_dir=run_dir, config=config, inside=inside, stop=stop)
        assert pathlib.Path(run_dir, "config.json").exists()
        for update in range(2):
            events.append(f"update {update}")
            on_update({})

    monkeypatch.setattr(training, "learn", learn)
    stop = threading.Event()
    training.until_first_update(RunConfig(), "native", stop, lambda: events.append("reported"))
    assert events == ["update 0", "reported", "update 1"]
    assert stop.is_set() and seen["stop"] is stop
    assert seen["inside"] == "native" and seen["config"].updates == 1
    assert not seen["run_dir"].exists()


def test_nothing_is_reported_of_a_start_that_was_stopped(monkeypatch):
    def learn(run_dir, config, *, stop, on_update, **rest):
        stop.set()
        on_update({})

    reported = []
    monkeypatch.setattr(training, "learn", learn)
    training.until_first_update(RunConfig(), "native", threading.Event(), lambda: reported.append(1))
    assert not reported
