"""`congrasp status`: a live run."""

from typing import Annotated

import tyro


def status(
    connect: str = "tcp/127.0.0.1:7447",
    run: str = "quickstart",
    json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Who works on a run, and how it goes: versions, roles, rates, and what became of tickets and rollouts.

    Args:
      connect: The learner's endpoint.
      run: Name of the run.
      json: Print JSON instead of a table.
    """
    import json as json_module

    from rich.console import Console
    from rich.table import Table

    from common.transport.keys import Keys
    from common.transport.zenoh_transport import ZenohTransport
    from common.wire.codec import Message

    with ZenohTransport(connect=[connect]) as transport:
        found = dict(transport.query(Keys(run).status, Message({}, {}), timeout=5.0).meta)
    if json:
        print(json_module.dumps(found))
        return 0
    console = Console()
    roles = Table(title=f"{found['run']}, version {found['version']}, epoch {found['epoch']}")
    for column in ("role", "name", "incarnation", "rollouts", "version"):
        roles.add_column(column)
    for role in found["roles"]:
        roles.add_row(*(str(role.get(name, "")) for name in ("role", "id", "incarnation", "rollouts", "version")))
    console.print(roles)
    ledger = Table("tickets and rollouts", "number", title="Ledger")
    for name, value in found["ledger"].items():
        ledger.add_row(name, str(value))
    console.print(ledger)
    console.print(f"{found['rates']['steps_per_second']:.0f} steps/s, {found['queue']['length']} rollout(s) waiting")
    return 0


COMMAND = status
