"""One rank of a run with a made-up actor in its process, to be started, killed and resumed by
tests.

Arguments: rank, ranks, port of the coordinator, run directory, number of updates, `fresh` or
`resume`, and optionally the rank that kills itself, with one of `PHASES` ("1:update").
"""

import dataclasses
import os
import pathlib
import signal
import sys
import threading
import time
import zlib

import jax

from congrasp.common.config import NetworkConfig, PPOConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import encode
from congrasp.learner.distributed.ranks import Ranks, end_process
from congrasp.learner.hub.hub import LearnerHub
from congrasp.learner.hub.queue import RolloutQueue
from congrasp.learner.process import Outputs, run_learner
from tests.learner.made_up_actor import MadeUpActor

CONFIG = RunConfig(
    name="t",
    environments=2,
    rollout_steps=4,
    checkpoint_every=2,
    network=NetworkConfig(hidden=(8,), encoder=2),
    ppo=PPOConfig(epochs=2, minibatches=2),
)


class Reports:
    """What this process prints."""

    @staticmethod
    def update(values: dict[str, float]) -> None:
        """Prints the number of a finished update, after which the learner waits for a batch."""
        print("update", int(values["update"]), flush=True)


PHASES = {
    "join": (jax.distributed, "initialize", 1),
    "wait": (Reports, "update", 3),
    "update": (RolloutQueue, "next_batch", 2),
    "publish": (LearnerHub, "publish_weights", 3),
    "checkpoint": (pathlib.Path, "replace", 8),
    "leave": (Ranks, "close", 1),
}
"""Function, and the number of its call at which a rank dies: others wait in a collective, a round,
or JAX itself.
"""


def die_in(phase: str) -> None:
    """Kills this process at that call, as the kernel would."""
    place, name, number = PHASES[phase]
    function = getattr(place, name)
    calls = iter(range(1, number))

    def last(*args: object, **options: object) -> object:
        if next(calls, None) is None:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args, **options)

    setattr(place, name, last)


def end_slowly(text: str) -> None:
    """Ends the process as on a busy machine, where JAX has the time to abort it before."""
    time.sleep(1.0)
    end_process(text)


def main() -> None:
    rank, count, port, run_dir, goal, mode, *doom = sys.argv[1:]
    for victim, _, phase in (each.partition(":") for each in doom):
        if victim == rank:
            die_in(phase)
    ranks = Ranks.join(int(rank), int(count), f"127.0.0.1:{port}", end_slowly)
    broker = MemoryHub()
    actor = MadeUpActor(MemoryTransport(broker), f"actor-{rank}", seed=int(rank))
    with MemoryTransport(broker) as transport:
        last = run_learner(
            pathlib.Path(run_dir),
            dataclasses.replace(CONFIG, updates=int(goal)),
            transport,
            stop_event=threading.Event(),
            resume=mode == "resume",
            ranks=ranks,
            outputs=Outputs(
                on_update=Reports.update,
                on_event=lambda level, text: print(level, text, flush=True),
            ),
        )
    # A thread that is inside JAX when the interpreter ends takes the process down with it.
    actor.stop.set()
    actor.join(30.0)
    print("bundle", zlib.crc32(encode(last.to_message())), last.transitions, flush=True)


if __name__ == "__main__":
    try:
        main()
    except CongraspError as error:
        end_process(str(error), error.exit_code)
