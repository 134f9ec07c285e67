"""The sending side of a log: numbers its messages, so that recorders can count what was lost on the way."""

import time
from collections.abc import Mapping

from common.transport import keys
from common.transport.base import Transport
from common.wire.codec import Message


class LogStream:
    """What one process publishes about itself. Sending may lose messages and never blocks for long."""

    def __init__(self, transport: Transport, run: str, role: str, name: str, incarnation: str = ""):
        """For the process `name` of a `role`; `incarnation` tells its restarts apart."""
        self._transport, self._run, self._role, self._name = transport, run, role, name
        self._incarnation = incarnation
        self._next: dict[str, int] = {}

    def metrics(self, values: Mapping[str, float], **steps: int) -> None:
        """Named numbers; `steps` are the counters they belong to, such as `update` and `version`."""
        self.publish("metrics", Message({}, {"time": time.time(), **steps, "values": dict(values)}))

    def event(self, text: str, level: str = "info") -> None:
        """One line; the level is debug, info, warning, error or fatal."""
        self.publish("event", Message({}, {"time": time.time(), "level": level, "text": text}))

    def publish(self, kind: str, message: Message) -> None:
        """Any log message: its kind is metrics, event, version, episode or rollout."""
        number = self._next.get(kind, 0)
        self._next[kind] = number + 1
        meta = {**message.meta, "log_sequence": number, "incarnation": self._incarnation}
        self._transport.publish(keys.log_key(self._run, kind, self._role, self._name), Message(message.arrays, meta))
