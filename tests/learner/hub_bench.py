"""A learner's hub over the in-memory transport, and a peer of it."""

import functools

import numpy as np

from congrasp.common.transport.keys import Keys
from congrasp.common.transport.memory import MemoryHub, MemoryTransport
from congrasp.common.wire.codec import Message
from congrasp.common.wire.messages import RolloutForm
from congrasp.learner.hub.staleness import StalenessManager
from tests import rollouts

KEYS = Keys("test")
T = 3
B = 2
D = 5
A = 4
FORM = RolloutForm(T, B, D, A, half=True)


def rollout(sequence=0, version=0, **meta):
    arrays = {**FORM.zeros(), "reward": np.full((T, B), sequence, np.float32)}
    header = {
        "actor": "a",
        "incarnation": "01",
        "sequence": sequence,
        "version": version,
        "run_id": "e",
        "schema": "s",
    }
    return Message(arrays, {**header, "steps": T * B, **meta})


bundle = functools.partial(rollouts.bundle, form=FORM)


class Bench:
    """A hub, which has published weights where a version is given, and a peer of it."""

    def __init__(self, *, version=None, max_staleness=1, batch=2, **options):
        self.memory = MemoryHub()
        self.server = MemoryTransport(self.memory)
        self.peer = MemoryTransport(self.memory)
        self.staleness = StalenessManager(max_staleness, batch)
        self.hub, self.rollouts = rollouts.learner_hub(
            self.server, "test", form=FORM, staleness=self.staleness, **options
        )
        if version is not None:
            self.hub.publish_weights(bundle(version), version)

    def ask(self, key, meta=None, arrays=None):
        return self.peer.query(key, Message(arrays or {}, meta or {}), timeout=60).meta

    def send(self, *args, **options):
        message = rollout(*args, **options)
        return self.peer.query(KEYS.rollout(message.meta["actor"]), message, timeout=60).meta

    def ticket(self, name="t", **meta):
        return self.ask(
            KEYS.ticket("a"), {"actor": "a", "incarnation": "01", "ticket": name, **meta}
        )

    def ledger(self):
        return self.ask(KEYS.status)["counters"]


def sequences(batch):
    return [message.meta["sequence"] for message in batch]
