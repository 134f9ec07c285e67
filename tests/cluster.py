"""A learner and actors as real processes over Zenoh, without networks and physics, for tests that
do damage.

Run as a script, this file is the learner or the actor. The hub, the link, the wire and the journals
are the real ones; the "policy" is a version number, an "update" consumes two rollouts and may take
some time, and a checkpoint is a JSON file.
"""

import contextlib
import dataclasses
import itertools
import json
import os
import pathlib
import random
import signal
import subprocess
import sys
import time

from congrasp.actors.link import ActorLink, RunFinished
from congrasp.common.errors import TransportError
from congrasp.common.io.journal import AUDIT, Journal
from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.ports import free_port
from congrasp.common.wire.codec import Message
from congrasp.learner.hub.staleness import StalenessManager
from congrasp.learner.hub.used_rollouts import AuditLog
from congrasp.learner.hub.write_ahead import FOLDER, WriteAheadLog
from congrasp.services.ops.lifetime import follow_parent
from tests.children import following, python_path
from tests.rollouts import FORM, bundle, learner_hub, rollout

ROOT = pathlib.Path(__file__).resolve().parents[1]
KEYS = Keys("chaos")
BATCH = 2
_PATIENCE = 240.0  # seconds, on a machine that does much else


def form_of(steps):
    return dataclasses.replace(FORM, steps=steps)


class SlowLog(WriteAheadLog):
    """Of a disk that takes some seconds for a rollout."""

    def __init__(self, *arguments, seconds, **options):
        super().__init__(*arguments, **options)
        self._seconds = seconds

    def add(self, *arguments):
        time.sleep(self._seconds)
        return super().add(*arguments)


# --- the two roles ---


def run_learner(folder, endpoint, *, steps=FORM.steps, every=1, pause=0.0, disk=0.0):
    """Consumes batches and checkpoints after `every` updates, until it is told to stop (SIGTERM) or
    killed.

    Its disk takes `disk` seconds for a rollout.
    """
    path = folder / "checkpoint"
    saved = (
        json.loads(path.read_text())
        if path.exists()
        else {"durable": None, "history": [], "version": 0}
    )
    history = saved["history"]
    version = saved["version"]
    published = folder / "version"
    if saved["durable"] is not None and int(published.read_text()) > version:
        version = int(published.read_text()) + 1
    stopped = []
    signal.signal(signal.SIGTERM, lambda *_: stopped.append(True))
    with urls.listen(endpoint, "learner") as transport:
        hub, rollouts = learner_hub(
            transport,
            "chaos",
            form=form_of(steps),
            staleness=StalenessManager(1, BATCH),
            durable=saved["durable"],
            audit=AuditLog(folder, "0"),
            log=SlowLog(folder / FOLDER / "0", 1, seconds=disk),
        )
        save(published, version)
        hub.publish_weights(bundle(version), version)
        print("ready", flush=True)
        updates = 0
        while not stopped:
            batch = rollouts.next_batch(BATCH, 0.1)
            if batch is None:
                continue
            for message in batch:
                expected = message.meta["sequence"] % 1000
                for name, array in message.arrays.items():
                    assert array.dtype == bool or (array == expected).all(), f"corrupted: {name}"
                history.append(
                    [message.meta[name] for name in ("actor", "incarnation", "sequence")]
                )
            time.sleep(pause)
            version, updates = version + 1, updates + 1
            save(published, version)
            hub.publish_weights(bundle(version), version)
            if updates % every == 0:
                durable = rollouts.durable()
                save(path, {"durable": durable, "history": history, "version": version})
                rollouts.note_saved()
        hub.finish()
        time.sleep(0.5)  # actors hear of it; what is on its way still comes in
        rollouts.close()
        save(
            folder / "final",
            {"history": history, "counters": hub.status()["counters"], "version": version},
        )


def save(path, content):
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(content))
    os.replace(temporary, path)


def run_actor(folder, endpoint, *, name, steps=FORM.steps, pause=0.0, request_timeout=3.0):
    """Makes rollouts until the run is finished; writes each outcome down."""
    path = folder / AUDIT / f"{name}.jsonl"
    with (
        open(folder / f"{name}.log", "a", buffering=1) as log,
        urls.connect(endpoint, "actor") as transport,
        ActorLink(
            transport,
            "chaos",
            name,
            window=2,
            request_timeout=request_timeout,
            journal=lambda run_id: Journal(path),
        ) as link,
    ):
        with contextlib.suppress(RunFinished):
            work(link, steps, pause, log)
        link.flush(5)


def work(link, steps, pause, log):
    link.config(20)
    version = -1
    for sequence in itertools.count():
        while (ticket := link.acquire_ticket(1.0)) is None:
            pass
        pulled = link.weights(version)
        version = pulled.meta["version"] if pulled else version
        time.sleep(pause)
        entry = {"incarnation": link.incarnation, "sequence": sequence}
        link.upload(
            rollout(sequence % 1000, form_of(steps), version=version), ticket
        ).add_done_callback(
            lambda f, entry=entry: log.write(json.dumps({**entry, "outcome": outcome_of(f)}) + "\n")
        )


def outcome_of(future):
    error = future.exception()
    return "unknown" if error else future.result()


def jump_about():
    """From now on, this process cannot trust its wall clock."""
    honest = time.time
    rng = random.Random(0)
    time.time = lambda: honest() + rng.uniform(-1, 1) * 30 * 86400
    time.time_ns = lambda: int(1e9 * time.time())


# --- what a test has in hand ---


class Cluster:
    """Processes of one test, and a look at the learner from outside."""

    def __init__(self, folder):
        self.folder = folder
        self.port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self.checkpoint = folder / "checkpoint"
        self.options = {}
        """Of all processes that are started from now on."""
        self.processes = []
        self.observer = None

    def start(self, role, endpoint=None, **options):
        """Starts a process; options are those of its function in this file, or `clock`."""
        environment = following(PYTHONPATH=python_path())
        arguments = {
            "folder": str(self.folder),
            "endpoint": endpoint or self.endpoint,
            **self.options,
            **options,
        }
        process = subprocess.Popen(
            [sys.executable, __file__, role, json.dumps(arguments)],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=(self.folder / f"{role}.err").open("ab"),
        )
        self.processes.append(process)
        return process

    def start_learner(self, **options):
        process = self.start("learner", **options)
        assert process.stdout.readline() == b"ready\n", (self.folder / "learner.err").read_text()
        if self.observer is None:
            self.observer = urls.connect(self.endpoint, "observer")
        return process

    def start_actor(self, name="a", **options):
        return self.start("actor", name=name, **options)

    def status(self):
        try:
            return self.observer.query(KEYS.status, Message(), timeout=2).meta
        except TransportError:
            return None

    def wait(self, condition, timeout=_PATIENCE):
        """Polls the learner's status until it is as wanted; the timeout only ends a test that
        hangs.
        """
        deadline = time.monotonic() + timeout
        while True:
            status = self.status()
            if status and condition(status):
                return status
            errors = "".join(path.read_text() for path in self.folder.glob("*.err"))
            assert time.monotonic() < deadline, f"not in time: {status} {errors}"
            time.sleep(0.02)

    def wait_for_updates(self, count, timeout=_PATIENCE):
        """Until the learner has published so many more versions."""
        version = self.wait(bool, timeout)["version"]
        return self.wait(lambda status: status["version"] >= version + count, timeout)

    def outcomes(self, name="a"):
        """What became of an actor's rollouts; nothing before its first."""
        path = self.folder / f"{name}.log"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def stop(self, learner):
        """Ends the learner and the actors gently; returns what the learner found in its books, and
        the audit's counts.

        Whatever happened before: nothing that was accepted is lost, duplicated or corrupted.
        """
        for process in self.processes:  # those that a test has stopped must hear of the end
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
        learner.terminate()
        assert learner.wait(10) == 0, (self.folder / "learner.err").read_text()
        for process in self.processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10)
        from congrasp.services.ops.audit import FAULTS, compare  # JAX, which no role needs

        report = compare(self.folder)
        assert not report.faults, report
        assert not any(report.counts[name] for name in FAULTS), report
        assert report.lag_max <= report.max_staleness == 1
        assert report.lag_mean <= 1
        assert report.counts["used"] > 0
        return json.loads((self.folder / "final").read_text()), report.counts

    def close(self):
        for process in self.processes:
            process.kill()
            process.communicate()
        if self.observer:
            self.observer.close()


def assert_books_balance(final):
    """What a learner left when it ended: everything was counted once, and used once."""
    ledger = final["counters"]
    assert ledger["accepted"] == ledger["consumed"] + ledger["dropped"] + ledger["queued"]
    assert (
        ledger["granted"]
        == ledger["running"] + ledger["redeemed"] + ledger["returned"] + ledger["expired"]
    )
    assert ledger["consumed"] == len(final["history"])
    assert len({tuple(identity) for identity in final["history"]}) == len(final["history"])


if __name__ == "__main__":
    follow_parent()
    given = json.loads(sys.argv[2])
    if given.pop("clock", "") == "jumps":
        jump_about()
    {"learner": run_learner, "actor": run_actor}[sys.argv[1]](
        pathlib.Path(given.pop("folder")), **given
    )
