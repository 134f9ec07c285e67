"""A client that asks a policy server too often: `python -m tests.benchmarks.crowds ENDPOINT QUERY
READS RATE [CERTS ...]`.

It holds eight connections under eight names, with a certificate for each or without, and sends
queries with Zenoh's own interface whether or not earlier ones were answered.
"""

import contextlib
import pathlib
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence

import zenoh
from zenoh.handlers import Callback

from congrasp.common.transport import urls
from congrasp.common.transport.keys import Keys
from congrasp.common.transport.security import secured
from congrasp.common.transport.zenoh_session import configuration
from congrasp.common.wire.codec import MAX_MESSAGE
from congrasp.services.ops.lifetime import follow_parent
from tests.children import following

CONNECTIONS = 8
_FOREVER = 3600.0


@contextlib.contextmanager
def crowded(
    endpoint: str, query: pathlib.Path, *, reads: bool, rate: float, certs: Sequence[pathlib.Path]
) -> Iterator[None]:
    """Context in which a process sends queries through `CONNECTIONS` connections.

    Args:
      endpoint: endpoint of the policy server.
      query: file of the query.
      reads: it reads the answers.
      rate: queries a second of each connection.
      certs: folders of certificates, one for each connection, or none.
    """
    words = [endpoint, query, int(reads), rate, *certs]
    command = [sys.executable, "-m", "tests.benchmarks.crowds", *map(str, words)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env=following())
    try:
        assert process.stdout is not None
        assert process.stdout.readline(), "the attacker did not start"
        yield
    finally:
        process.kill()
        process.wait()


def _connection(endpoint: str, certs: str | None) -> zenoh.Session:
    """A connection to a policy server, by name or by certificate."""
    credentials = urls.find_credentials(certs, "client")
    where = secured(endpoint, credentials)
    return zenoh.open(configuration("policy", [where], False, MAX_MESSAGE, credentials))


def _ask(session: zenoh.Session, name: str, query: bytes, reads: bool, rate: float) -> None:
    """Sends queries without end at a rate."""

    def receive(reply: zenoh.Reply) -> None:
        if not reads:
            time.sleep(_FOREVER)

    callback: Callback[zenoh.Reply] = Callback(receive, indirect=False)
    due = time.monotonic()
    while True:
        session.get(Keys("policy").act_for(name), callback, payload=query, timeout=10.0)
        due = max(due + 1.0 / rate, time.monotonic() - 0.1)
        time.sleep(max(0.0, due - time.monotonic()))


def main(endpoint: str, file: str, reads: str, rate: str, *certs: str) -> None:
    """Opens the connections and sends."""
    query = pathlib.Path(file).read_bytes()
    folders = list(certs) or [None] * CONNECTIONS
    for number, folder in enumerate(folders):
        session = _connection(endpoint, folder)
        name = urls.name_on_wire(f"crowd-{number}", folder, "client")
        arguments = (session, name, query, reads == "1", float(rate))
        threading.Thread(target=_ask, args=arguments, daemon=True).start()
    print("began", flush=True)
    time.sleep(_FOREVER)


if __name__ == "__main__":
    follow_parent()
    main(*sys.argv[1:])
