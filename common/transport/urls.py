"""Opens transports by URL and role; ports, flows and certificates of a role are decided here alone.

A URL is `SCHEME/ADDRESS`: `tcp/HOST:PORT` and `tls/HOST:PORT` over Zenoh, `memory/NAME` within a process. `SCHEMES`
has their factories; a transport from elsewhere adds a row to it.
"""

import importlib.util
import os
import pathlib
from collections.abc import Callable
from typing import Literal, NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import FLOWS, Flow
from congrasp.common.transport.memory import connect_in_memory, listen_in_memory
from congrasp.common.transport.ports import LEARNER_URL
from congrasp.common.transport.security import Credentials, check_exposure, numbered

Listener = Literal["learner", "server"]
Peer = Literal["actor", "server", "client", "observer"]
Certs = str | os.PathLike[str] | None
"""A folder that 'congrasp certs' made: a role's own, or the authority's."""

LISTENER_FLOWS: dict[Listener, tuple[Flow, ...]] = {"learner": FLOWS, "server": ("policy",)}
"""By role: the flows that it listens on, which take a port each, from the URL's on."""
PEER_FLOWS: dict[Peer, tuple[Flow, ...]] = {
    "actor": FLOWS[:3],
    "server": FLOWS[:2],
    "observer": FLOWS[:3],
    "client": ("policy",),
}
"""By role: the flows that it needs at its listener (a client's is a policy server, the others' a learner), of whose
flows they are the first."""


class Endpoint(NamedTuple):
    """What a scheme's factory is told."""

    url: str
    role: str
    """One of `common.transport.security.ROLES`."""
    listens: bool
    certs: Certs = None
    insecure: bool = False
    """May listen where other machines reach it although nothing protects it."""
    wait: float = 0.0
    """Seconds to wait for somebody to listen."""
    run: str | None = None
    """The run that certificates must be for; None for any."""
    longest_rollout: int | None = None
    """Bytes of the longest rollout that a learner takes; None for that of any message."""

    @property
    def address(self) -> str:
        """What follows the scheme."""
        return self.url.partition("/")[2]


def connect(url: str, role: Peer, *, certs: Certs = None, wait: float = 10.0, run: str | None = None) -> Transport:
    """Connects to who listens at a URL.

    Args:
      url: `SCHEME/ADDRESS` of a learner, or for a client of a policy server.
      role: what this process is to its peer.
      certs: folder of the role's certificate, for mutual TLS.
      wait: seconds to wait for somebody to listen.
      run: name of the run that the certificate must be for.

    Raises:
      CongraspError: the URL is malformed, or the certificates are missing, expired, another role's or run's, or not
        accepted, or those of who listens are not for that.
      TransportError: there is no response.
    """
    return _open(Endpoint(url, role, listens=False, certs=certs, wait=wait, run=run))


def listen(
    url: str,
    role: Listener,
    *,
    certs: Certs = None,
    insecure: bool = False,
    run: str | None = None,
    longest_rollout: int | None = None,
) -> Transport:
    """Listens at a URL.

    Args:
      url: `SCHEME/ADDRESS`.
      role: a learner, or a policy server.
      certs: folder of the role's certificate: mutual TLS, and each role may do only what is its own.
      insecure: listen beyond loopback without certificates.
      run: name of the run that the certificate must be for.
      longest_rollout: bytes of the longest rollout that a learner takes; longer ones are refused unseen.

    Raises:
      CongraspError: the URL is malformed or in use, other machines could connect and nothing would protect it, or the
        certificates are missing, expired, or another role's or run's.
    """
    return _open(Endpoint(url, role, True, certs, insecure, run=run, longest_rollout=longest_rollout))


def find_credentials(certs: Certs, role: str, run: str | None = None) -> Credentials | None:
    """The credentials of a role, for a run if it is named; None without a folder of certificates.

    Where the package cryptography is absent, as beside a client that needs numpy and Zenoh alone, it is only the peer
    who judges them.

    Raises:
      CongraspError: they are missing, damaged, expired, or another role's or run's.
    """
    if certs is None:
        return None
    if importlib.util.find_spec("cryptography") is None:
        return Credentials(pathlib.Path(certs), role)
    from congrasp.common.transport.certificates import find

    credentials = find(pathlib.Path(certs), role)
    if run is not None and credentials.identity.run != run:
        raise CongraspError(
            f"{credentials.certificate} is for the run '{credentials.identity.run}', not '{run}'.",
            f"Name that run, or issue one for this: congrasp certs issue --run {run} --role {role}",
        )
    return credentials


def name_on_wire(name: str, certs: Certs, role: str = "actor") -> str:
    """The name of an actor, server or client on the wire: it begins with its certificate's number, if it has one."""
    credentials = find_credentials(certs, role)
    return name if credentials is None else numbered(credentials.identity.number, name)


def _open(endpoint: Endpoint) -> Transport:
    scheme = endpoint.url.partition("/")[0]
    if scheme not in SCHEMES:
        raise CongraspError(
            f"'{endpoint.url}' is not an endpoint.", f"Write it like {LEARNER_URL}; schemes: {', '.join(SCHEMES)}."
        )
    return SCHEMES[scheme](endpoint)


def _open_memory(endpoint: Endpoint) -> Transport:
    """Nothing leaves the process: every role has all flows, and certificates have nothing to protect."""
    if endpoint.listens:
        return listen_in_memory(endpoint.address)
    return connect_in_memory(endpoint.address, endpoint.wait)


def _open_zenoh(endpoint: Endpoint) -> Transport:
    from congrasp.common.transport.zenoh_transport import ZenohTransport

    credentials = find_credentials(endpoint.certs, endpoint.role, endpoint.run)
    if endpoint.listens:
        check_exposure(endpoint.url, credentials, insecure=endpoint.insecure)
        flows = LISTENER_FLOWS[endpoint.role]  # type: ignore[index]
        return ZenohTransport(
            listen=[endpoint.url], flows=flows, credentials=credentials, longest_rollout=endpoint.longest_rollout
        )
    flows = PEER_FLOWS[endpoint.role]  # type: ignore[index]
    return ZenohTransport(connect=[endpoint.url], flows=flows, wait=endpoint.wait, credentials=credentials)


Factory = Callable[[Endpoint], Transport]
SCHEMES: dict[str, Factory] = {
    "memory": _open_memory,
    **dict.fromkeys(("tcp", "tls", "quic", "udp", "ws"), _open_zenoh),
}
"""Who opens the URLs of a scheme."""
