"""`congrasp serve`: the live policy."""

import contextlib
import dataclasses
import os
import pathlib
import secrets
from typing import TYPE_CHECKING, Annotated

import tyro

from congrasp.common.errors import CongraspError
from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import SERVER_URL, check_ports, shifted
from congrasp.services.cli.console import in_range
from congrasp.services.client.worker_endpoints import MAX_WORKERS
from congrasp.services.ops.lifetime import Stop, command, on_signal
from congrasp.services.ops.logs import MonitoringOptions, announce_progress, log, logging_as
from congrasp.services.ops.metrics import ServerMetrics
from congrasp.services.ops.waiting import connect_when_up, when_up
from congrasp.services.serve.workers import run_workers, worker_of

if TYPE_CHECKING:
    from congrasp.services.serve.sources import Source


_COMPILING = "Loading and compiling the policy"


@dataclasses.dataclass(frozen=True)
class Serve:
    """Answer live queries with a policy file, or with the newest policy of a run while it trains.

    Examples:
      congrasp serve --policy runs/mine/policy.safetensors
      congrasp serve --connect tcp/127.0.0.1:7447 --run human
    """

    policy: pathlib.Path | None = None
    """A policy file, which is read again whenever it changes, or the name of a pretrained policy.
    Policies such as allegro-student observe only what a robot can measure. By default the
    pretrained policy of --hand."""
    hand: str = "human"
    """Hand of the pretrained policy."""
    connect: str = ""
    """Endpoint of a learner whose newest policy is served, instead of a policy file."""
    run: str = "quickstart"
    """Name of the learner's run, with --connect."""
    patience: float | None = None
    """Seconds for which the server waits for the learner of --connect when it starts; without
    limit by default. A worker that is restarted waits without limit, since the others serve."""
    listen: str = SERVER_URL
    """Endpoint for clients."""
    name: str = "policy"
    """Name under which clients find the policy."""
    monitoring: Annotated[MonitoringOptions, tyro.conf.arg(name="")] = MonitoringOptions()  # noqa: RUF009
    """Monitoring."""
    certs: pathlib.Path | None = None
    """Folder of the server's certificate (congrasp certs), for connections to clients and to the
    learner."""
    insecure: bool = False
    """Accept connections from other machines without certificates."""
    workers: int = 1
    """Number of processes that serve the policy, if one core is the limit. Each listens on its own
    port, from that of --listen on; --metrics-port counts up likewise. Clients that connect to the
    first one are distributed over all. With --certs all have the same certificate. With --connect
    each has its own connection to the learner."""
    worker: int | None = None
    """Only run the worker of this number, from 0 on, without the process that restarts workers."""

    def __call__(self) -> int:
        """Serves until a signal."""
        in_range(1, MAX_WORKERS, workers=self.workers)
        if self.policy is not None and self.connect:
            raise CongraspError(
                f"The server can follow either {self.policy} or {self.connect}.",
                "Pass one of --policy and --connect.",
            )
        if self.worker is not None:
            in_range(0, self.workers - 1, worker=self.worker)
            return self._as_worker(self.worker)._serve()
        if self.workers > 1:
            return self._serve_with_workers()
        return self._serve()

    def _as_worker(self, number: int) -> "Serve":
        """Returns the options of a worker, with its ports."""
        metrics_port = self.monitoring.metrics_port
        if metrics_port:
            metrics_port += number
        monitoring = dataclasses.replace(self.monitoring, metrics_port=metrics_port)
        return dataclasses.replace(self, listen=shifted(self.listen, number), monitoring=monitoring)

    def _serve_with_workers(self) -> int:
        """Runs the workers until a signal."""
        check_ports(self.listen, self.workers)
        urls.check_listener(
            self.listen,
            "server",
            certs=self.certs,
            insecure=self.insecure,
            run=self.run if self.connect else None,
        )
        workers = [worker_of(i, self._worker_arguments(i)) for i in range(self.workers)]
        run = self.run if self.connect else ""
        log_format = self.monitoring.log_format
        with logging_as(log_format, role="server", id=self.name, run=run), on_signal() as stop:
            run_workers(workers, stop)
            log("info", f"The workers end: {stop.reason}.")
        return stop.exit_code

    def _worker_arguments(self, number: int) -> list[str]:
        """Words of the command of a worker."""
        options = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        monitoring = options.pop("monitoring")
        options |= dataclasses.asdict(monitoring)
        options["worker"] = number
        options["connect"] = self.connect or None
        return command("serve", **options)

    def _serve(self) -> int:
        """Serves in this process until a signal."""
        starting = contextlib.ExitStack()
        activity = _COMPILING
        starting.enter_context(announce_progress(lambda: activity))
        # Waking a thread costs more than it saves in one policy's inference. So JAX has no pool of
        # threads, whose size it reads at its import, and computes in the calling thread (below).
        os.environ.setdefault("NPROC", "1")

        import jax

        from congrasp.common.policy.pretrained import policy_file
        from congrasp.services.serve.server import PolicyServer
        from congrasp.services.serve.sources import follow_file

        jax.config.update("jax_cpu_enable_async_dispatch", False)
        metrics = ServerMetrics()
        run = self.run if self.connect else ""
        with (
            self.monitoring.monitor("server", self.name, run, metrics),
            starting,
            contextlib.ExitStack() as stack,
        ):
            if self.connect:
                activity = f"Waiting for the policy of the learner at {self.connect}"
                with on_signal() as stop:
                    source = self._source_of_run(stack, stop)
                activity = _COMPILING
                if source is None:
                    log("info", f"The server ends: {stop.reason}.")
                    return stop.exit_code
            else:
                source = follow_file(policy_file(self.policy, self.hand))
            transport = stack.enter_context(
                urls.listen(self.listen, "server", certs=self.certs, insecure=self.insecure)
            )
            # Signals are not handled yet: Ctrl-C interrupts the compilation, which this contains.
            server = PolicyServer(
                transport,
                self.name,
                source,
                on_answer=metrics.answer,
                on_batch=metrics.batch,
                workers=self.workers,
                worker=self.worker or 0,
            )
            metrics.health = server.health
            with on_signal() as stop:
                starting.close()
                health = server.health()
                log(
                    "info",
                    f"Serving '{self.name}' at {self.listen}: hand {health['hand']}, version "
                    f"{health['version']}.",
                )
                stop.wait()
                server.close()
            log("info", f"The server ends: {stop.reason}.")
        return stop.exit_code

    def _source_of_run(self, stack: contextlib.ExitStack, stop: Stop) -> "Source | None":
        """Connects to the learner and waits for its first policy; returns None if stopped."""
        from congrasp.services.serve.sources import follow_run

        upstream = connect_when_up(
            self.connect,
            "server",
            certs=self.certs,
            run=self.run,
            patience=self.patience,
            stop=stop,
        )
        if upstream is None:
            return None
        stack.enter_context(upstream)
        name = urls.name_on_wire(self.name, self.certs, "server")
        upstream.declare_alive(Keys(self.run).alive("server", self.name, secrets.token_hex(4)))
        source = follow_run(upstream, self.run, name)
        what = f"the learner of the run '{self.run}' at {self.connect}"
        first = when_up(lambda: source(-1), what, patience=self.patience, stop=stop)
        return None if first is None else source


COMMAND = Serve
