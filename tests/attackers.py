"""Actors that mean harm, as programs: each does one thing for ever, with an actor's rights and one name's identity.

python tests/attackers.py hold_tickets tcp/127.0.0.1:7447 chaos
"""

import contextlib
import itertools
import sys
import time

import numpy as np

from congrasp.common.errors import TransportError
from congrasp.common.transport import urls
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import Keys
from congrasp.common.wire.codec import Message
from congrasp.common.wire.schema import RolloutForm

IDENTITY = "9"
"""What the names of all its actors begin with, as those of one certificate do."""


def _ask(transport: Transport, key: str, message: Message) -> None:
    with contextlib.suppress(TransportError):
        transport.query(key, message, timeout=2.0)


def hold_tickets(transport: Transport, keys: Keys) -> None:
    """Asks for tickets under ever new names and uses none of them."""
    for number in itertools.count():
        name = f"{IDENTITY}.{number}"
        _ask(transport, keys.ticket(name), Message(meta={"actor": name, "incarnation": "1", "ticket": "t"}))


def show_tokens(transport: Transport, keys: Keys) -> None:
    """Shows thousands of liveliness tokens."""
    for number in range(12_000):
        transport.declare_alive(keys.alive("actor", f"{IDENTITY}.{number}", "1"))
    time.sleep(1e6)


def send_nonsense(transport: Transport, keys: Keys) -> None:
    """Sends rollouts whose rewards are no numbers, and others with arrays that nobody knows."""
    for number in itertools.count():
        name = f"{IDENTITY}.{number % 50}"
        arrays = RolloutForm(20, 16, 32, 4, half=True).zeros()
        arrays["reward" if number % 2 else "made/up"] = np.full((20, 16), np.nan, np.float32)
        meta = {"actor": name, "incarnation": "1", "sequence": number, "version": 0, "run_id": "e", "schema": "s"}
        _ask(transport, keys.rollout(name), Message(arrays, {**meta, "steps": 320, "ticket": "t"}))


def publish_logs(transport: Transport, keys: Keys) -> None:
    """Publishes metrics of ever new names under ever new names."""
    for number in itertools.count():
        values = {f"{number}/{i}": 1.0 for i in range(2000)}
        key = keys.log("metrics", "actor", f"{IDENTITY}.{number % 5000}")
        transport.publish(key, Message(meta={"time": 1.0, "values": values}))
        time.sleep(0.01)


ATTACKS = {attack.__name__: attack for attack in (hold_tickets, show_tokens, send_nonsense, publish_logs)}

if __name__ == "__main__":
    what, endpoint, run = sys.argv[1:]
    with urls.connect(endpoint, "actor") as connected:
        ATTACKS[what](connected, Keys(run))
