"""Keys on the wire; all lie under `congrasp/<run>/`."""

import re

from common.errors import CongraspError

CONFIG = "config"
TICKET = "ticket"
ROLLOUT = "rollout"
WEIGHTS = "weights/latest"
ANNOUNCE = "weights/announce"
STATUS = "status"
ACT = "policy/act"
HEALTH = "policy/health"
BULK = (ROLLOUT, WEIGHTS)
"""Keys whose messages are large; they travel on a session of their own."""


def key(run: str, *parts: str) -> str:
    """The full key of a run; a CongraspError names a part that cannot be in a key."""
    for part in (run, *parts):
        if not re.fullmatch(r"[\w.\-*]+(/[\w.\-*]+)*", part):
            raise CongraspError(f"The name '{part}' cannot be used on the wire.", "Use letters, digits, '-', '_', '.'.")
    return "/".join(("congrasp", run, *parts))


def log_key(run: str, kind: str, role: str, name: str) -> str:
    """Key of a log stream: kind is metrics, event, version, episode or rollout."""
    return key(run, "log", kind, role, name)


def alive_key(run: str, role: str, name: str, incarnation: str) -> str:
    """Key of a liveliness token."""
    return key(run, "alive", role, name, incarnation)


def relative(full: str) -> str:
    """The part of a key after the run's name."""
    return full.split("/", 2)[2]
