"""Keys on the wire, `congrasp/<run>/...`, and the flow of each."""

import dataclasses
import os
import platform
import re
from typing import Literal, NamedTuple

from congrasp.common.errors import CongraspError

ROOT = "congrasp"
Flow = Literal["control", "bulk", "log", "policy"]
FLOWS: tuple[Flow, ...] = ("control", "bulk", "log", "policy")
"""Kinds of traffic that must not delay one another, in the order of their ports."""
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")


def check_name(what: str, name: str) -> str:
    """Returns a name that is valid within a key.

    Raises:
      CongraspError: it is empty, too long, or has characters other than letters, digits, `_`, `.`
        and `-`.
    """
    if not _NAME.fullmatch(name):
        article = "an" if what[0] in "aeiou" else "a"
        raise CongraspError(
            f"{ascii(name)[:70]} cannot be the name of {article} {what}.",
            "Use 1 to 64 letters, digits, '_', '.' and '-'.",
        )
    return name


def process_name(role: str) -> str:
    """Default name of this process: the names of the machine and of the process."""
    name = f"{platform.node() or role}-{os.getpid()}"
    valid = re.sub(r"[^\w.-]", "-", name, flags=re.ASCII)
    return valid[-64:].lstrip(".-")


def flow(key: str) -> Flow:
    """Flow of a key or key expression, determined by the part below the run."""
    parts = key.split("/")[2:]
    # The announcement is tiny and urgent, the weights themselves are neither.
    if parts[:2] == ["weights", "announce"]:
        return "control"
    kind = parts[0] if parts else ""
    if kind in ("rollout", "weights"):
        return "bulk"
    if kind == "log":
        return "log"
    if kind == "policy":
        return "policy"
    return "control"


class Alive(NamedTuple):
    """Owner of a liveliness token."""

    role: str
    id: str
    incarnation: str


def parse_alive(key: str) -> Alive | None:
    """Returns the owner of a liveliness token; None if the key is not one, or contains an invalid
    name.
    """
    parts = key.split("/")
    named = len(parts) == 6 and parts[2] == "alive" and all(map(_NAME.fullmatch, parts[3:]))
    return Alive(*parts[3:]) if named else None


def matches(expression: str, key: str) -> bool:
    """True if an expression matches a key: `*` matches one part, `**` any number of parts."""
    pattern = "".join(_part_pattern(part) for part in expression.split("/"))
    return re.fullmatch(pattern, "/" + key) is not None


def _part_pattern(part: str) -> str:
    """Regular expression for one part of an expression, with the slash before it."""
    if part == "**":
        return "(?:/[^/]+)*"
    if part == "*":
        return "/[^/]+"
    return "/" + re.escape(part)


def below(key: str) -> str:
    """Expression that matches a key and all keys below it."""
    return f"{key}/**"


def account(key: str) -> str:
    """Common part of the keys of all peers with one certificate: the number at the start of their
    names.
    """
    before, slash, name = key.rpartition("/")
    return before + slash + name.partition(".")[0]


class _Fixed:
    """A key of a run that holds no name."""

    def __init__(self, *parts: str):
        self._parts = parts

    def __get__(self, keys: "Keys", owner: type) -> str:
        return keys._key(*self._parts)


@dataclasses.dataclass(frozen=True)
class Keys:
    """The keys of one run."""

    run: str
    """Name of the run."""

    def __post_init__(self) -> None:
        check_name("run", self.run)

    def _key(self, *parts: str) -> str:
        return "/".join((ROOT, self.run, *parts))

    config = _Fixed("config")
    """Query: the run's configuration."""

    tickets = _Fixed("ticket", "*")
    """Expression of the keys under which actors request a ticket for a rollout."""

    def ticket(self, actor: str) -> str:
        """Query: a ticket for a rollout of an actor."""
        return self._key("ticket", check_name("actor", actor))

    rollouts = _Fixed("rollout", "*")
    """Expression of the keys under which actors send rollouts."""

    def rollout(self, actor: str) -> str:
        """Query: sends a rollout of an actor and returns the acknowledgement."""
        return self._key("rollout", check_name("actor", actor))

    weights = _Fixed("weights", "latest")
    """Query: the latest policy bundle, for a peer without a name."""

    def weights_for(self, role: str, name: str) -> str:
        """Query: the latest policy bundle, for an actor or a policy server of this name."""
        return self._key("weights", "latest", check_name("role", role), check_name(role, name))

    announcement = _Fixed("weights", "announce")
    """Publication: a new policy version is available."""

    status = _Fixed("status")
    """Query: roles, versions, rates and counters."""

    act = _Fixed("policy", "act")
    """Query: an action of the current policy, for a client without a name."""

    def act_for(self, client: str) -> str:
        """Query: an action of the current policy, for a client of this name."""
        return self._key("policy", "act", check_name("client", client))

    health = _Fixed("policy", "health")
    """Query: readiness of the policy server."""

    logs = _Fixed("log", "**")
    """Expression of all publications for logs."""

    learner_metrics = _Fixed("log", "metrics", "learner", "*")
    """Expression of the learner's metrics."""

    everyone = _Fixed("alive", "*", "*", "*")
    """Expression of all liveliness tokens."""

    def alive(self, role: str, name: str, incarnation: str) -> str:
        """Liveliness token of one start of one process."""
        return self._key("alive", *(check_name("role", part) for part in (role, name, incarnation)))

    def log(self, channel: str, role: str, name: str) -> str:
        """Publication for logs; channels: metrics, event, version, episode, rollout."""
        return self._key("log", channel, check_name("role", role), check_name("role", name))
