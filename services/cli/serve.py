"""`congrasp serve`: the live policy."""

import pathlib


def serve(
    policy: pathlib.Path | None = None,
    hand: str = "human",
    connect: str = "",
    run: str = "quickstart",
    listen: str = "tcp/127.0.0.1:7457",
    name: str = "policy",
) -> int:
    """Answer live queries with a policy file, or with the newest policy of a run while it trains.

    Args:
      policy: A policy file, read again whenever it changes; by default the one that comes with congrasp.
      hand: Hand of the policy that comes with congrasp.
      connect: A learner's endpoint to follow instead of a file.
      run: Name of the run to follow.
      listen: Endpoint for the clients.
      name: Name under which the policy is served.
    """
    from common.errors import CongraspError
    from common.policy.shipped import policy_file
    from common.transport.zenoh_transport import ZenohTransport
    from services.server import PolicyServer, follow_file, follow_run
    from services.shutdown import on_signal

    if policy is not None and connect:
        raise CongraspError(
            f"The server can follow either {policy} or {connect}.", "Give one of --policy and --connect."
        )
    with on_signal() as stop:
        upstream = ZenohTransport(connect=[connect]) if connect else None
        source = follow_run(upstream, run) if upstream else follow_file(policy_file(policy, hand))
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
