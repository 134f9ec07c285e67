"""Keys on the wire: `congrasp/<run>/...`, and which flow each belongs to."""

import dataclasses
import os
import platform
import re
from typing import Literal, NamedTuple

from congrasp.common.errors import CongraspError

ROOT = "congrasp"
Flow = Literal["control", "bulk", "log", "policy"]
FLOWS: tuple[Flow, ...] = ("control", "bulk", "log", "policy")
"""Kinds of traffic that must not wait for one another, in the order of their ports."""
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")


def check_name(what: str, name: str) -> str:
    """Returns a name that may stand in a key.

    Raises:
      CongraspError: it is empty, too long, or has other characters than letters, digits, `_`, `.` and `-`.
    """
    if not _NAME.fullmatch(name):
        raise CongraspError(
            f"{ascii(name)[:70]} cannot be the name of {'an' if what[0] in 'aeiou' else 'a'} {what}.",
            "Use 1 to 64 letters, digits, '_', '.' and '-'.",
        )
    return name


def process_name(role: str) -> str:
    """A name for this process where none was given: the machine's and the process's number."""
    return re.sub(r"[^\w.-]", "-", f"{platform.node() or role}-{os.getpid()}", flags=re.ASCII)[-64:].lstrip(".-")


def flow(key: str) -> Flow:
    """The flow of a key or key expression: the part below the run decides."""
    part, *rest = (*key.split("/")[2:], "")
    if part in ("rollout", "weights"):
        # The notice is tiny and urgent, the weights themselves are neither.
        return "control" if (part, rest[0]) == ("weights", "announce") else "bulk"
    return "log" if part == "log" else "policy" if part == "policy" else "control"


class Alive(NamedTuple):
    """Whose liveliness token it is."""

    role: str
    id: str
    incarnation: str


def parse_alive(key: str) -> Alive | None:
    """The owner of a liveliness token; None if the key is none, or holds what is no name."""
    parts = key.split("/")
    named = len(parts) == 6 and parts[2] == "alive" and all(map(_NAME.fullmatch, parts[3:]))
    return Alive(*parts[3:]) if named else None


def matches(expression: str, key: str) -> bool:
    """Whether a key is one of those that an expression names: `*` stands for one part, `**` for any number of them."""
    pattern = "".join(
        "(?:/[^/]+)*" if part == "**" else "/[^/]+" if part == "*" else "/" + re.escape(part)
        for part in expression.split("/")
    )
    return re.fullmatch(pattern, "/" + key) is not None


def below(key: str) -> str:
    """Expression of a key and of all below it."""
    return f"{key}/**"


def account(key: str) -> str:
    """What the keys of all peers with one certificate have in common: the number that their names begin with."""
    before, slash, name = key.rpartition("/")
    return before + slash + name.partition(".")[0]


@dataclasses.dataclass(frozen=True)
class Keys:
    """The keys of one run."""

    run: str
    """Name of the run."""

    def __post_init__(self) -> None:
        check_name("run", self.run)

    def _key(self, *parts: str) -> str:
        return "/".join((ROOT, self.run, *parts))

    @property
    def config(self) -> str:
        """Query: the run's configuration."""
        return self._key("config")

    @property
    def tickets(self) -> str:
        """Expression of the keys under which actors ask for permission to make a rollout."""
        return self._key("ticket", "*")

    def ticket(self, actor: str) -> str:
        """Query: permission for an actor to make a rollout."""
        return self._key("ticket", check_name("actor", actor))

    @property
    def rollouts(self) -> str:
        """Expression of the keys under which actors send rollouts."""
        return self._key("rollout", "*")

    def rollout(self, actor: str) -> str:
        """Query: takes a rollout of an actor and acknowledges it."""
        return self._key("rollout", check_name("actor", actor))

    @property
    def weights(self) -> str:
        """Query: the latest policy bundle, for a peer without a name."""
        return self._key("weights", "latest")

    def weights_for(self, role: str, name: str) -> str:
        """Query: the latest policy bundle, for an actor or a policy server of this name."""
        return self._key("weights", "latest", check_name("role", role), check_name(role, name))

    @property
    def announcement(self) -> str:
        """Publication: a new policy version is there."""
        return self._key("weights", "announce")

    @property
    def status(self) -> str:
        """Query: roles, versions, rates and counters."""
        return self._key("status")

    @property
    def act(self) -> str:
        """Query: an action of the live policy, for a client without a name."""
        return self._key("policy", "act")

    def act_for(self, client: str) -> str:
        """Query: an action of the live policy, for a client of this name."""
        return self._key("policy", "act", check_name("client", client))

    @property
    def health(self) -> str:
        """Query: whether the policy server is ready."""
        return self._key("policy", "health")

    @property
    def logs(self) -> str:
        """Expression of everything that is published for logs."""
        return self._key("log", "**")

    @property
    def learner_metrics(self) -> str:
        """Expression of the learner's metrics."""
        return self._key("log", "metrics", "learner", "*")

    @property
    def actor_metrics(self) -> str:
        """Expression of the metrics of all actors."""
        return self._key("log", "metrics", "actor", "*")

    @property
    def everyone(self) -> str:
        """Expression of all liveliness tokens."""
        return self._key("alive", "*", "*", "*")

    def alive(self, role: str, name: str, incarnation: str) -> str:
        """Liveliness token of one start of one process."""
        return self._key("alive", *(check_name("role", part) for part in (role, name, incarnation)))

    def log(self, channel: str, role: str, name: str) -> str:
        """Publication for logs; channels: metrics, event, version, episode, rollout."""
        return self._key("log", channel, check_name("role", role), check_name("role", name))
