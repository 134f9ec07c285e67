"""`congrasp serve`: the live policy."""

import pathlib


def serve(
    policy: pathlib.Path | None = None,
    connect: str = "",
    run: str = "quickstart",
    listen: str = "tcp/127.0.0.1:7457",
    name: str = "policy",
) -> int:
    """Answer live queries with a policy file, or with the newest policy of a run while it trains.

    Args:
      policy: A policy file; read again whenever it changes.
      connect: A learner's endpoint to follow instead of a file.
      run: Name of the run to follow.
      listen: Endpoint for the clients.
      name: Name under which the policy is served.
    """
    from common.errors import CongraspError
    from common.transport.zenoh_transport import ZenohTransport
    from services.server import PolicyServer, follow_file, follow_run
    from services.shutdown import on_signal

    if (policy is None) == (not connect):
        raise CongraspError(
            "The server needs a policy to serve.", "Give either --policy FILE or --connect tcp/HOST:PORT."
        )
    with on_signal() as stop:
        upstream = ZenohTransport(connect=[connect]) if connect else None
        source = follow_run(upstream, run) if upstream else follow_file(pathlib.Path(policy or ""))
        with ZenohTransport(listen=[listen], flows=("policy",)) as transport:
            server = PolicyServer(transport, name, source)
            health = server.health()
            print(f"serving '{name}' at {listen}: hand {health['hand']}, version {health['version']}", flush=True)
            stop.wait()
            server.close()
        if upstream:
            upstream.close()
        return stop.exit_code


COMMAND = serve
