"""Monitoring options of every role: the format of its log, and its metrics."""

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Annotated, Any

import tyro

from congrasp.services.ops.logs import LogFormat, logging_as


@dataclasses.dataclass(frozen=True)
class Watch:
    """Options for monitoring a role."""

    log_format: LogFormat = "text"
    """Lines of text, or one JSON object a line: time, level, role, id, run, text, fields."""
    metrics_port: int = 0
    """Port of a Prometheus endpoint, http://HOST:PORT/metrics; 0 for none."""
    metrics_host: str = "127.0.0.1"
    """Interface of the Prometheus endpoint. It has no authentication."""

    @contextlib.contextmanager
    def watched(self, role: str, id: str, run: str, collector: Any = None) -> Iterator[None]:
        """Logs and, if a port is set, serves the collector's metrics while the block runs."""
        with contextlib.ExitStack() as stack:
            stack.enter_context(logging_as(self.log_format, role=role, id=id, run=run))
            if self.metrics_port and collector is not None:
                from congrasp.services.ops.metrics import exposed

                stack.enter_context(exposed(self.metrics_port, self.metrics_host, collector))
            yield


Watched = Annotated[Watch, tyro.conf.arg(name="")]
"""The options without a prefix."""
