"""What recording costs: a learner with real actors, now with a recorder and now without, in turns."""

import dataclasses
import pathlib
import statistics
import tempfile
import threading
import time

import psutil
from rich.console import Console

from congrasp.common.errors import CongraspError
from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import local_url
from congrasp.learner.process import run_learner
from congrasp.learner.run_directory import create_run
from congrasp.services.record.recorder import Recorder
from congrasp.services.train.presets import get_preset
from congrasp.services.train.processes import Child, end_all

_PATIENCE = 300.0


def bench_recording(actors: int, seconds: float, turns: int) -> None:
    """Prints control steps a second with and without a recorder, the recorder's processor time, and transport's share.

    The run is quickstart's, with the logs that it publishes by default.
    """
    config = dataclasses.replace(get_preset("quickstart"), updates=10**6, collapse_patience=0)
    updates: list[tuple[float, float]] = []  # time and transitions of every update
    stop = threading.Event()
    paces: dict[bool, list[float]] = {False: [], True: []}
    busy = recorded = size = 0.0
    with tempfile.TemporaryDirectory() as folder, urls.listen(endpoint := local_url(), "learner") as transport:
        run_dir = pathlib.Path(folder, "run")
        create_run(run_dir, config)
        actor_metrics = transport.subscribe(Keys(config.name).actor_metrics, depth=10**6)
        learner = threading.Thread(
            target=run_learner,
            args=(run_dir, config, transport),
            kwargs={
                "stop_event": stop,
                "on_update": lambda values: updates.append((time.monotonic(), values["transitions"])),
            },
        )
        arguments = ["actor", "--connect", endpoint, "--run", config.name, "--physics", "native", "--threads", "1"]
        children = [Child(f"a{i}", [*arguments, "--id", f"a{i}"], run_dir / f"a{i}.log") for i in range(actors)]
        try:
            learner.start()
            for child in children:
                child.start()
            _wait_for(updates, 5)
            while actor_metrics.receive(0.0):
                pass  # of actors that were alone, or began
            for turn in range(2 * turns):
                recording = turn % 2 == 1
                recorder = Recorder(transport, config.name, run_dir / "logs", name=f"bench{turn}")
                if recording:
                    recorder.start()
                _wait_for(updates, len(updates) + 1)
                first, began, worked = len(updates) - 1, time.monotonic(), _thread_seconds(recorder)
                time.sleep(seconds)
                _wait_for(updates, len(updates) + 1)
                if recording:
                    busy += _thread_seconds(recorder) - worked
                    recorded += time.monotonic() - began
                (start, before), (end, after) = updates[first], updates[-1]
                paces[recording].append((after - before) / (end - start))
                recorder.close()
                size += sum(file.stat().st_size for file in recorder.files)
            shares = [message.meta["values"] for _, message in iter(lambda: actor_metrics.receive(0.0), None)]
        finally:
            stop.set()
            end_all(children)
            learner.join(30.0)
    without, with_one = (sorted(paces[key])[turns // 2] for key in (False, True))
    cores = psutil.cpu_count() or 1
    console = Console()
    console.print(f"Without a recorder {without:,.0f} steps/s, with one {with_one:,.0f}: {with_one / without:.3f}.")
    console.print(
        f"The recorder's thread took {100 * busy / recorded / cores:.2f} % of the processors' time and wrote "
        f"{size / 1e6:.1f} MB in {recorded:.0f} s."
    )

    transported, waited = (
        100 * statistics.mean(v[f"share/{name}"] for v in shares) for name in ("transport", "waiting")
    )
    console.print(
        f"The actors spent {transported:.2f} % of their time on weights and uploads, and waited {waited:.2f} % of it "
        f"for permission to go on ({len(shares)} rollouts)."
    )


def _wait_for(updates: list[tuple[float, float]], count: int) -> None:
    """Until so many updates are done."""
    deadline = time.monotonic() + _PATIENCE
    while len(updates) < count:
        if time.monotonic() > deadline:
            raise CongraspError(f"There was no update within {_PATIENCE:g} s.", "Is the machine busy otherwise?")
        time.sleep(0.01)


def _thread_seconds(recorder: Recorder) -> float:
    """Processor seconds of the recorder's thread so far."""
    number = recorder.native_id
    return sum(t.user_time + t.system_time for t in psutil.Process().threads() if t.id == number)
