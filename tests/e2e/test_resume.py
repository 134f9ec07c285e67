"""Resume is resume: a learner that is killed with SIGKILL and goes on ends with the bits of one that was not."""

import dataclasses
import json
import os
import pathlib
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from congrasp.common.errors import TransportError
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import Message, decode
from congrasp.learner.hub.used_rollouts import journal_path, replay
from congrasp.learner.process import run_learner
from congrasp.learner.run_directory import create_run, open_run
from tests.learner.test_process import CONFIG

ROOT = pathlib.Path(__file__).resolve().parents[2]
UPDATES, EVERY, KILLED_AFTER = 8, 3, 5
# The stream is fixed by `feed` alone: what a write-ahead log takes up would be used in another order.
RUN = dataclasses.replace(CONFIG, updates=UPDATES, checkpoint_every=EVERY, write_ahead=False)
STEPS, WORLDS, BATCH = RUN.rollout_steps, RUN.environments, RUN.ppo.rollouts_per_update


def rollout(number, bundle):
    """The same whatever policy is asked for it."""
    rng = np.random.default_rng(number)
    size = sum(width for _, width in bundle.meta["layout"])
    observation = rng.uniform(-1.0, 1.0, (STEPS + 1, WORLDS, size)).astype(
        np.float16
    )  # what every entry of a task can be
    privileged = sum(width for _, width in bundle.meta["privileged"])
    inputs = rng.uniform(0.0, 1.0, (STEPS + 1, WORLDS, privileged)).astype(np.float16)
    arrays = {
        "observation": observation[:-1],
        "privileged": inputs[:-1],
        "last_privileged": inputs[-1],
        "last_observation": observation[-1],
        "action": rng.normal(size=(STEPS, WORLDS, bundle.meta["action_size"])).astype(np.float32),
        "log_probability": rng.normal(-40.0, 1.0, size=(STEPS, WORLDS)).astype(np.float32),
        "reward": rng.normal(size=(STEPS, WORLDS)).astype(np.float32),
        "terminal": (terminal := rng.random((STEPS, WORLDS)) < 0.3),
        "truncated": terminal & (rng.random((STEPS, WORLDS)) < 0.5),
    }
    who = {"actor": "a", "incarnation": "01", "sequence": number, "ticket": ""}
    return Message(arrays, {**who, **{name: bundle.meta[name] for name in ("version", "run_id", "schema")}, "steps": 8})


def feed(hub):
    """Sends every update the rollouts of its number, and no others."""
    keys, known, transport = Keys(RUN.name), None, MemoryTransport(hub)
    while True:
        try:
            bundle = transport.query(keys.weights_for("actor", "a"), Message(meta={"newer_than": -1}), timeout=5)
            if not bundle.arrays or bundle.meta["version"] == known:
                time.sleep(0.005)
                continue
            update = bundle.meta["transitions"] // (BATCH * STEPS * WORLDS)
            for number in range(update * BATCH, (update + 1) * BATCH):
                message = rollout(number, bundle)
                # A query whose answer came too late is repeated: its rollout had arrived.
                arrived = ("accepted", "duplicate")
                while transport.query(keys.rollout("a"), message, timeout=5).meta["outcome"] not in arrived:
                    time.sleep(0.005)
            known = bundle.meta["version"]
        except TransportError:
            time.sleep(0.01)


def train(run_dir, resume, killed_after):
    """A session of the learner; with `killed_after`, it ends by SIGKILL right after that update."""
    hub = MemoryHub()
    threading.Thread(target=feed, args=(hub,), daemon=True).start()
    with MemoryTransport(hub) as transport:
        run_learner(
            run_dir, open_run(run_dir), transport, stop_event=threading.Event(), resume=resume,
            on_update=lambda values: values["update"] == killed_after and os.kill(os.getpid(), signal.SIGKILL),
        )  # fmt: skip


def in_a_process(run_dir, resume, killed_after=0):
    script = (
        "import pathlib, sys; from tests.e2e.test_resume import train;"
        "train(pathlib.Path(sys.argv[1]), sys.argv[2] == 'resume', int(sys.argv[3]))"
    )
    command = [sys.executable, "-c", script, str(run_dir), "resume" if resume else "begin", str(killed_after)]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    return subprocess.run(command, env=environment, timeout=120, stderr=subprocess.PIPE, text=True)


@pytest.mark.timeout(300)
def test_killed_and_resumed_is_bit_for_bit_the_same_as_never_killed(tmp_path):
    for name in ("straight", "killed"):
        create_run(tmp_path / name, RUN)
    straight = in_a_process(tmp_path / "straight", resume=False)
    assert straight.returncode == 0, straight.stderr
    assert in_a_process(tmp_path / "killed", resume=False, killed_after=KILLED_AFTER).returncode == -signal.SIGKILL
    assert (tmp_path / "killed" / "checkpoints" / "latest").resolve().name.endswith(f"{EVERY}.safetensors")
    resumed = in_a_process(tmp_path / "killed", resume=True)
    assert resumed.returncode == 0, resumed.stderr

    ends = []
    for name in ("straight", "killed"):
        data = (tmp_path / name / "checkpoints" / "latest").read_bytes()
        arrays = dict(decode(data).arrays)
        ends.append((json.loads(arrays.pop("meta").tobytes()), arrays))
    (straight_meta, straight_arrays), (meta, arrays) = ends
    # Parameters, the optimiser's moments, rate, random key, normalisers, and counters.
    assert {name.split("/")[0] for name in arrays} >= {"params", "optimizer", "key", "observation", "value"}
    assert "optimizer/hyperparams/learning_rate" in arrays
    assert arrays.keys() == straight_arrays.keys() and len(arrays) > 20
    for name, array in arrays.items():
        assert array.dtype == straight_arrays[name].dtype
        assert array.tobytes() == straight_arrays[name].tobytes(), name
    assert (arrays["version"], arrays["transitions"]) == (UPDATES, UPDATES * BATCH * STEPS * WORLDS)
    books, straight_books = meta["hubs"][0]["counters"], straight_meta["hubs"][0]["counters"]
    lost = (KILLED_AFTER - EVERY) * BATCH
    assert (books["undone"], straight_books["undone"]) == (lost, 0)
    # All else as if nothing had happened; how many rollouts were sent again depends on how slow the answers were.
    assert {**books, "undone": 0, "duplicate": straight_books["duplicate"]} == straight_books
    assert meta["skipped"] == KILLED_AFTER - EVERY + 1  # versions are never given out twice
    standing, undone = replay(
        json.loads(line) for line in journal_path(tmp_path / "killed", "0").read_text().split("\n") if line
    )
    assert [use.sequence for use in standing] == [*range(UPDATES * BATCH)]
    assert len(undone) == lost
