"""Resume is resume: a learner that is killed with SIGKILL and goes on ends with the bits of one
that was not.
"""

import dataclasses
import json
import os
import signal
import threading
import time

import numpy as np

from congrasp.common.errors import TransportError
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import Message, decode
from congrasp.learner.hub.used_rollouts import journal_path, replay
from congrasp.learner.process import Outputs, run_learner
from congrasp.learner.run_directory import create_run, open_run
from tests.children import python
from tests.learner.made_up_actor import random_steps
from tests.learner.test_process import CONFIG

UPDATES = 8
EVERY = 3
KILLED_AFTER = 5
# The stream is fixed by `feed` alone: what a write-ahead log takes up would be used in another
# order.
RUN = dataclasses.replace(CONFIG, updates=UPDATES, checkpoint_every=EVERY, write_ahead=False)
STEPS = RUN.rollout_steps
WORLDS = RUN.environments
BATCH = RUN.rollouts_per_update


def rollout(number, bundle):
    """The same whatever policy is asked for it."""
    rng = np.random.default_rng(number)
    meta = bundle.meta
    sizes = (sum(dict(meta[name]).values()) for name in ("layout", "privileged"))
    arrays = random_steps(rng, STEPS, WORLDS, *sizes) | {
        "action": rng.normal(size=(STEPS, WORLDS, meta["action_size"])).astype(np.float32),
        "log_probability": rng.normal(-40.0, 1.0, size=(STEPS, WORLDS)).astype(np.float32),
    }
    who = {"actor": "a", "incarnation": "01", "sequence": number, "ticket": ""}
    return Message(
        arrays,
        {**who, **{name: meta[name] for name in ("version", "run_id", "schema")}, "steps": 8},
    )


def feed(hub, ended):
    """Sends every update the rollouts of its number, and no others."""
    keys = Keys(RUN.name)
    version = None
    transport = MemoryTransport(hub)
    while not ended.is_set():
        try:
            bundle = transport.query(
                keys.weights_for("actor", "a"), Message(meta={"newer_than": -1}), timeout=5
            )
            if not bundle.arrays or bundle.meta["version"] == version:
                time.sleep(0.005)
                continue
            update = bundle.meta["transitions"] // (BATCH * STEPS * WORLDS)
            for number in range(update * BATCH, (update + 1) * BATCH):
                message = rollout(number, bundle)
                # A query whose answer came too late is repeated: its rollout had arrived.
                arrived = ("accepted", "duplicate")
                while (
                    transport.query(keys.rollout("a"), message, timeout=5).meta["outcome"]
                    not in arrived
                ):
                    time.sleep(0.005)
            version = bundle.meta["version"]
        except TransportError:
            time.sleep(0.01)


def train(run_dir, resume=False, killed_after=0):
    """A session of the learner; with `killed_after`, it ends by SIGKILL right after that update."""
    hub = MemoryHub()
    ended = threading.Event()
    feeder = threading.Thread(target=feed, args=(hub, ended), daemon=True)
    feeder.start()
    with MemoryTransport(hub) as transport:
        run_learner(
            run_dir,
            open_run(run_dir),
            transport,
            stop_event=threading.Event(),
            resume=resume,
            outputs=Outputs(
                on_update=lambda values: (
                    values["update"] == killed_after and os.kill(os.getpid(), signal.SIGKILL)
                ),
            ),
        )
    ended.set()
    feeder.join(10.0)


def test_killed_and_resumed_is_bit_for_bit_the_same_as_never_killed(tmp_path):
    for name in ("straight", "killed"):
        create_run(tmp_path / name, RUN)
    train(tmp_path / "straight")
    script = (
        "import pathlib, sys; from tests.e2e.test_resume import train; "
        "train(pathlib.Path(sys.argv[1]), "
    )
    done = python("-c", script + f"killed_after={KILLED_AFTER})", tmp_path / "killed", timeout=240)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert (
        (tmp_path / "killed" / "checkpoints" / "latest")
        .resolve()
        .name.endswith(f"{EVERY}.safetensors")
    )
    train(tmp_path / "killed", resume=True)

    ends = []
    for name in ("straight", "killed"):
        data = (tmp_path / name / "checkpoints" / "latest").read_bytes()
        arrays = dict(decode(data).arrays)
        ends.append((json.loads(arrays.pop("meta").tobytes()), arrays))
    (straight_meta, straight_arrays), (meta, arrays) = ends
    # Parameters, the optimiser's moments, rate, random key, normalisers, and counters.
    assert {name.split("/")[0] for name in arrays} >= {
        "params",
        "optimizer",
        "key",
        "observation",
        "value",
    }
    assert "optimizer/hyperparams/learning_rate" in arrays
    assert arrays.keys() == straight_arrays.keys()
    assert len(arrays) > 20
    for name, array in arrays.items():
        assert array.dtype == straight_arrays[name].dtype
        assert array.tobytes() == straight_arrays[name].tobytes(), name
    assert arrays["version"] == UPDATES
    assert arrays["transitions"] == UPDATES * BATCH * STEPS * WORLDS
    books = meta["hubs"][0]["counters"]
    straight_books = straight_meta["hubs"][0]["counters"]
    lost = (KILLED_AFTER - EVERY) * BATCH
    assert books["undone"] == lost
    assert straight_books["undone"] == 0
    # All else as if nothing had happened; how many rollouts were sent again depends on how slow the
    # answers were.
    assert {**books, "undone": 0, "duplicate": straight_books["duplicate"]} == straight_books
    assert meta["skipped"] == KILLED_AFTER - EVERY + 1  # versions are never given out twice
    standing, undone = replay(
        json.loads(line)
        for line in journal_path(tmp_path / "killed", "0").read_text().split("\n")
        if line
    )
    assert [use.sequence for use in standing] == [*range(UPDATES * BATCH)]
    assert len(undone) == lost
