"""One rank of a run with a made-up actor in its process, to be started, killed and resumed by tests.

Arguments: rank, ranks, port of the coordinator, run directory, number of updates, `fresh` or `resume`.
"""

import dataclasses
import pathlib
import sys
import threading
import time
import zlib

from congrasp.common.config import NetworkConfig, PPOConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import encode
from congrasp.learner.distributed.ranks import Ranks, end_process
from congrasp.learner.process import run_learner
from tests.learner.made_up_actor import MadeUpActor

CONFIG = RunConfig(
    name="t",
    environments=2,
    rollout_steps=4,
    checkpoint_every=2,
    network=NetworkConfig(hidden=(8,), encoder=2),
    ppo=PPOConfig(epochs=2, minibatches=2),
)


def end_slowly(text: str) -> None:
    """Ends the process as on a busy machine, where JAX has the time to abort it before."""
    time.sleep(1.0)
    end_process(text)


def main() -> None:
    rank, count, port, run_dir, goal, mode = sys.argv[1:]
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
            on_update=lambda values: print("update", int(values["update"]), flush=True),
            on_event=lambda level, text: print(level, text, flush=True),
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
