"""What an actor's rollouts lose to a slow network: delay, loss and thin links.

Learner and actor are processes with the real hub, link, wire and transport. A rollout's production
is a sleep; an update takes no time.
"""

import contextlib
import itertools
import json
import os
import pathlib
import signal
import subprocess
import sys
import time
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from congrasp.actors.link import ActorLink, RunFinished
from congrasp.common.errors import CongraspError
from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import free_port
from congrasp.common.wire.codec import Message
from congrasp.common.wire.messages import RolloutForm
from congrasp.learner.hub.staleness import StalenessManager
from congrasp.services.ops.lifetime import follow_parent
from tests.children import following
from tests.partition import Medium, cuttable
from tests.rollouts import bundle, learner_hub, rollout

_RUN = "wide"
_BATCH = 8
_START_S = 60.0
_OBSERVATIONS = 695
"""Entries of an observation, as of the human hand."""
_ACTIONS = 26


class Case(NamedTuple):
    """A link and the rollouts that pass it."""

    name: str
    medium: Medium
    rollout_s: float
    """Duration of a rollout's production."""
    worlds: int
    """Environments of a rollout; it has 25 steps."""
    parameters: int = 560_000
    """Parameters of the policy: by default 2.2 MB, as the actor of the human hand."""


def wide_area(
    seconds: float = 20.0, max_staleness: int = 2, json_file: pathlib.Path | None = None
) -> int:
    """Rollouts of an actor over slow links, as a share of those without the link's delay.

    Args:
      seconds: Measured time of each row, after it has settled for half of that.
      max_staleness: Bound of the rollouts' lag.
      json_file: File for the rows.

    Examples:
      python -m tests.benchmarks wide_area
    """
    cases = [
        Case("direct", Medium(), 0.1, 16),
        Case("50 ms", Medium(delay_s=0.025), 0.1, 16),
        Case("200 ms", Medium(delay_s=0.1), 0.1, 16),
        Case("200 ms, 1 % loss", Medium(delay_s=0.1, loss=0.01), 0.5, 1, 25_000),
        Case("direct, 1.5 s a rollout", Medium(), 1.5, 64),
        Case("10 Mbit/s, 20 ms", Medium(delay_s=0.01, bytes_per_s=1.25e6), 1.5, 64),
        Case(
            "10 Mbit/s, 20 ms, 0.2 s a rollout", Medium(delay_s=0.01, bytes_per_s=1.25e6), 0.2, 64
        ),
        Case("10 Mbit/s, 200 ms", Medium(delay_s=0.1, bytes_per_s=1.25e6), 1.5, 64),
    ]
    rows = []
    for case in cases:
        rows.append(_measure(case, seconds, max_staleness))
        print(json.dumps(rows[-1]), flush=True)
    Console(width=None if sys.stdout.isatty() else 140).print(_table(rows))
    if json_file is not None:
        json_file.write_text(json.dumps({"load": os.getloadavg(), "rows": rows}, indent=1))
    return 0


def _measure(case: Case, seconds: float, max_staleness: int) -> dict[str, Any]:
    """Runs a learner and an actor for some seconds."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    options = {
        "worlds": case.worlds,
        "rollout_s": case.rollout_s,
        "parameters": case.parameters,
        "eta": max_staleness,
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(_process("learner", endpoint, options))
        link = stack.enter_context(cuttable(endpoint, case.medium))
        stack.enter_context(_process("actor", link.endpoint, options))
        observer = stack.enter_context(urls.connect(endpoint, "observer", wait=_START_S))

        def counters() -> dict[str, int]:
            return observer.query(Keys(_RUN).status, Message(), timeout=5.0).meta["counters"]

        deadline = time.monotonic() + _START_S
        while counters()["accepted"] < 3:
            if time.monotonic() > deadline:
                raise CongraspError(f"{case.name}: no rollouts arrive.", "Look at the output.")
            time.sleep(0.1)
        time.sleep(seconds / 2)
        before = counters()
        sent_before = link.sent_up
        began = time.monotonic()
        time.sleep(seconds)
        after = counters()
        sent_after = link.sent_up
        ended = time.monotonic()
    per_s = (after["accepted"] - before["accepted"]) / (ended - began)
    return {
        "link": case.name,
        "rollouts_per_s": per_s,
        "of_production": per_s * case.rollout_s,
        "link_used": (sent_after - sent_before) / (ended - began) / case.medium.bytes_per_s,
        "rollout_bytes": sum(array.nbytes for array in _rollout(case.worlds, 0).arrays.values()),
        "stale": after["stale"] + after["dropped"] - before["stale"] - before["dropped"],
    }


def _table(rows: list[dict[str, Any]]) -> Table:
    """A row for each link."""
    table = Table("link", title="an actor over slow links")
    for column in ("rollouts/s", "of the production", "link used", "MB a rollout", "too old"):
        table.add_column(column, justify="right")
    for row in rows:
        table.add_row(
            row["link"],
            f"{row['rollouts_per_s']:.2f}",
            f"{row['of_production']:.2f}",
            f"{row['link_used']:.2f}" if row["link_used"] else "",
            f"{row['rollout_bytes'] / 1e6:.2f}",
            str(row["stale"]),
        )
    return table


@contextlib.contextmanager
def _process(role: str, endpoint: str, options: dict[str, Any]):
    """A process of this file while the block runs."""
    command = [sys.executable, "-m", __name__, role, endpoint, json.dumps(options)]
    process = subprocess.Popen(command, env=following())
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _form(worlds: int) -> RolloutForm:
    """Rollouts of 25 steps of the human hand's size."""
    return RolloutForm(
        steps=25, worlds=worlds, observation=_OBSERVATIONS, action=_ACTIONS, half=True
    )


def _rollout(worlds: int, version: int) -> Message:
    """A rollout that compresses to about a half, like a real one."""
    form = _form(worlds)
    message = rollout(0.0, form, version=version)
    noise = np.random.default_rng(0).standard_normal
    for array in message.arrays.values():
        if array.dtype != bool and array.ndim > 1:
            half = array.reshape(-1)[: array.size // 2]
            half[:] = noise(half.size)
    return message


def _learn(endpoint: str, options: dict[str, Any]) -> None:
    """Consumes batches until it is terminated."""
    with urls.listen(endpoint, "learner") as transport:
        hub, rollouts = learner_hub(
            transport,
            _RUN,
            form=_form(options["worlds"]),
            staleness=StalenessManager(options["eta"], _BATCH),
        )
        for version in itertools.count():
            hub.publish_weights(
                bundle(version, form=_form(1), parameters=options["parameters"]), version
            )
            while rollouts.next_batch(_BATCH, 1.0) is None:
                pass


def _act(endpoint: str, options: dict[str, Any]) -> None:
    """Makes rollouts until it is terminated."""
    content = _rollout(options["worlds"], 0)
    with (
        urls.connect(endpoint, "actor", wait=_START_S) as transport,
        ActorLink(transport, _RUN, "far") as link,
        contextlib.suppress(RunFinished),
    ):
        link.config(_START_S)
        version = -1
        while True:
            ticket = link.acquire_ticket(1.0)
            if ticket is None:
                continue
            policy = link.weights(version, ticket.required_version)
            if policy is not None:
                version = policy.meta["version"]
            time.sleep(options["rollout_s"])
            meta = {**content.meta, "version": version}
            link.upload(Message(content.arrays, meta), ticket)


if __name__ == "__main__":
    follow_parent()
    role, endpoint, options = sys.argv[1:]
    {"learner": _learn, "actor": _act}[role](endpoint, json.loads(options))
