"""Status of a run: queries its learner, checks its counters, and formats them as tables."""

import time
from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from congrasp.common.errors import TransportError
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message

_TIMEOUT = 5.0
_SUMS = {
    "granted": ("running", "redeemed", "returned", "expired"),
    "accepted": ("consumed", "dropped", "queued"),
}
"""Counters that are sums of others: no ticket and no accepted rollout is lost."""
_ROLE = ("role", "name", "incarnation", "version", "lag", "rollouts", "rollouts/s", "steps/s")
_SHOWN = 100  # most processes in a table


def ask(transport: Transport, run: str) -> dict[str, Any]:
    """Queries the status of a run from its learner, with `warnings` (see there).

    Raises:
      TransportError: no learner of this run responds.
    """
    found = dict(transport.query(Keys(run).status, Message({}, {}), timeout=_TIMEOUT).meta)
    return {**found, "warnings": warnings(found)}


def follow(transport: Transport, run: str, every: float) -> Iterator[dict[str, Any] | None]:
    """Yields the status periodically; None while the learner is disconnected."""
    while True:
        began = time.monotonic()
        try:
            yield ask(transport, run)
        except TransportError:
            yield None
        time.sleep(max(0.0, every - (time.monotonic() - began)))


def warnings(status: Mapping[str, Any]) -> list[str]:
    """Inconsistencies of a learner's status, and checkpoints that fail, one line each."""
    counters, queue = status["counters"], status["queue"]
    found = []
    for total, parts in _SUMS.items():
        if counters[total] != sum(counters[part] for part in parts):
            found.append(f"The counters are inconsistent: {total} {counters[total]} is not {_sum(counters, parts)}.")
    if counters["queued"] != queue["length"]:
        found.append(f"{counters['queued']} rollouts are counted as queued, but the queue holds {queue['length']}.")
    return [*found, *filter(None, [status.get("trouble")])]  # a learner of an earlier version tells none


def _sum(counters: Mapping[str, int], parts: tuple[str, ...]) -> str:
    """Formats a sum of counters as a formula."""
    return " + ".join(f"{part} {counters[part]}" for part in parts)


def tables(status: Mapping[str, Any]) -> Group:
    """Formats the status for a terminal."""
    ended = ", finished" if status["finished"] else ""
    roles = Table(title=f"{status['run']}, version {status['version']}, run id {status['run_id']}{ended}")
    refused = any(role.get("refused") for role in status["roles"])
    for column in (*_ROLE, "refused") if refused else _ROLE:
        roles.add_column(column, justify="left" if column in _ROLE[:3] else "right")
    for role in status["roles"][:_SHOWN]:
        version = status["version"] if role["role"] == "learner" else role.get("version", "")
        rates = (f"{role[rate]:.2f}" if rate in role else "" for rate in ("rollouts_per_second", "steps_per_second"))
        counts = (version, role.get("lag", ""), role.get("rollouts", ""), *rates)
        who = (Text(ascii(role[name])[1:70].rstrip("'")) for name in ("role", "id", "incarnation"))
        roles.add_row(*who, *map(str, counts), *([str(role.get("refused", ""))] if refused else []))
    counters = Table(title="Counters: tickets and rollouts")
    counters.add_column("count")
    counters.add_column("number", justify="right")
    counters.add_column("which is")
    for name, value in status["counters"].items():
        counters.add_row(name, str(value), " + ".join(_SUMS.get(name, ())))
    rates, queue = status["rates"], status["queue"]
    line = (
        f"{rates['rollouts_per_second']:.2f} rollouts/s, {rates['steps_per_second']:.0f} steps/s; "
        f"{queue['length']} rollout(s) of at most {queue['limit']} waiting"
    )
    more = len(status["roles"][_SHOWN:]) + status["unlisted"]
    others = [Text(f"{more} more live process(es).")] if more else []
    wrong = (Text(f"Warning: {text}", style="yellow") for text in status["warnings"])
    return Group(roles, *others, counters, Text(line), *wrong)
