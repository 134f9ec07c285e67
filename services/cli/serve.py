"""`congrasp serve`: the live policy."""

import pathlib

from congrasp.common.transport.ports import SERVER_URL
from congrasp.services.ops.logs import Watch, announced, log


def serve(
    policy: pathlib.Path | None = None,
    hand: str = "human",
    connect: str = "",
    run: str = "quickstart",
    listen: str = SERVER_URL,
    name: str = "policy",
    watch: Watch = Watch(),  # noqa: B008
    certs: pathlib.Path | None = None,
    insecure: bool = False,
) -> int:
    """Answer live queries with a policy file, or with the newest policy of a run while it trains.

    Args:
      policy: A policy file, reread whenever it changes, or 'allegro-student', whose inputs a robot can measure; by
        default the pretrained policy of the hand.
      hand: Hand of the pretrained policy.
      connect: A learner's endpoint to follow instead of a file.
      run: Name of the run to follow.
      listen: Endpoint for the clients.
      name: Name under which the policy is served.
      watch: Monitoring.
      certs: Folder of a server's certificate (congrasp certs), for its clients and for the learner.
      insecure: Listen beyond loopback without certificates.

    Examples:
      congrasp serve --policy runs/mine/policy.safetensors
      congrasp serve --connect tcp/127.0.0.1:7447 --run human
    """
    import contextlib
    import os
    import secrets

    starting = contextlib.ExitStack()
    starting.enter_context(announced("Loading and compiling the policy"))
    # Waking a thread costs more than it saves in one policy's inference: no pool (JAX reads it when it starts) ...
    os.environ.setdefault("NPROC", "1")

    import jax

    from congrasp.common.errors import CongraspError
    from congrasp.common.policy.pretrained import policy_file
    from congrasp.common.transport import urls
    from congrasp.common.transport.keys import Keys
    from congrasp.services.ops.metrics import ServerMetrics
    from congrasp.services.ops.shutdown import on_signal
    from congrasp.services.serve.server import PolicyServer, follow_file, follow_run

    if policy is not None and connect:
        raise CongraspError(
            f"The server can follow either {policy} or {connect}.", "Give one of --policy and --connect."
        )
    jax.config.update("jax_cpu_enable_async_dispatch", False)  # ... and no handing over
    metrics = ServerMetrics()
    with (
        watch.watched("server", name, run if connect else "", metrics),
        on_signal() as stop,
        starting,
        contextlib.ExitStack() as stack,
    ):
        if connect:
            upstream = stack.enter_context(urls.connect(connect, "server", certs=certs, run=run))
            upstream.declare_alive(Keys(run).alive("server", name, secrets.token_hex(4)))
            source = follow_run(upstream, run, urls.name_on_wire(name, certs, "server"))
        else:
            source = follow_file(policy_file(policy, hand))
        transport = stack.enter_context(urls.listen(listen, "server", certs=certs, insecure=insecure))
        server = PolicyServer(transport, name, source, on_answer=metrics.answer, on_batch=metrics.batch)
        metrics.health = server.health
        starting.close()
        health = server.health()
        log("info", f"Serving '{name}' at {listen}: hand {health['hand']}, version {health['version']}.")
        stop.wait()
        server.close()
    return stop.exit_code


COMMAND = serve
