"""`congrasp actor`: one actor."""

from typing import Annotated

import tyro

from common.config import PhysicsName


def actor(
    connect: str = "tcp/127.0.0.1:7447",
    run: str = "quickstart",
    id: Annotated[str, tyro.conf.arg(name="id")] = "",
    physics: PhysicsName = "auto",
    threads: int = 0,
    patience: float = 60.0,
) -> int:
    """One actor that works for a learner, on this machine or another; it may come and go while the learner trains.

    Args:
      connect: The learner's endpoint, such as tcp/10.0.0.5:7447.
      run: Name of the run.
      id: Name of this actor, unique in the run; host name and process number by default.
      physics: Engine; auto takes warp on an NVIDIA GPU and native on a CPU.
      threads: Threads of the native engine; 0 takes all cores.
      patience: Seconds without a learner after which the actor gives up.
    """
    import os
    import platform
    import re

    from actors.process import run_actor
    from common.transport.zenoh_transport import ZenohTransport
    from services.shutdown import on_signal

    name = id or re.sub(r"[^\w.-]", "-", f"{platform.node() or 'actor'}-{os.getpid()}")
    with on_signal() as stop, ZenohTransport(connect=[connect], wait=patience) as transport:
        run_actor(
            transport,
            run=run,
            actor=name,
            stop=stop,
            physics=physics,
            threads=threads or os.cpu_count() or 1,
            patience=patience,
        )
        return stop.exit_code


COMMAND = actor
