"""Opens transports by URL and role; the only place that decides ports, flows and certificates of a
role.

A URL is `SCHEME/ADDRESS`: `tcp/HOST:PORT` and `tls/HOST:PORT` over Zenoh, `memory/NAME` within a
process. `SCHEMES` maps schemes to factories; an external transport adds a row.
"""

import importlib.util
import os
import pathlib
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.runtime.forks import require_not_inherited
from congrasp.common.transport.base import Transport
from congrasp.common.transport.keys import FLOWS, Flow
from congrasp.common.transport.memory import connect_in_memory, listen_in_memory
from congrasp.common.transport.ports import LEARNER_URL
from congrasp.common.transport.security import Credentials, check_exposure, numbered, secured

Listener = Literal["learner", "server"]
Peer = Literal["actor", "server", "client", "observer"]
Certs = str | os.PathLike[str] | None
"""A folder created by 'congrasp certs': that of a role, or of the authority."""

LISTENER_FLOWS: dict[Listener, tuple[Flow, ...]] = {"learner": FLOWS, "server": ("policy",)}
"""Flows that each role listens on, each with a port, starting at the URL's."""
PEER_FLOWS: dict[Peer, tuple[Flow, ...]] = {
    "actor": FLOWS[:3],
    "server": FLOWS[:2],
    "observer": FLOWS[:3],
    "client": ("policy",),
}
"""Flows that each role needs at its listener (a client's is a policy server, all others' a
learner): the first of the listener's flows."""


class Endpoint(NamedTuple):
    """Arguments of a scheme's factory."""

    url: str
    role: str
    """One of `common.transport.security.ROLES`."""
    listens: bool
    certs: Certs = None
    insecure: bool = False
    """Allows listening without protection where other machines can connect."""
    wait: float = 0.0
    """Seconds to wait for a listener."""
    run: str | None = None
    """Run of the certificates; None for any."""
    longest_rollout: int | None = None
    """Longest rollout accepted by a learner, in bytes; None for the limit of all messages."""
    alternatives: Sequence[str] = ()
    """URLs to which a connection is reopened if that of `url` is lost."""

    @property
    def address(self) -> str:
        """Part after the scheme."""
        return self.url.partition("/")[2]


def connect(
    url: str,
    role: Peer,
    *,
    certs: Certs = None,
    wait: float = 10.0,
    run: str | None = None,
    alternatives: Sequence[str] = (),
) -> Transport:
    """Connects to the listener at a URL.

    Args:
      url: `SCHEME/ADDRESS` of a learner or, for a client, of a policy server.
      role: role of this process.
      certs: folder of the role's certificate, for mutual TLS.
      wait: seconds to wait for a listener.
      run: required run of the certificate.
      alternatives: URLs of listeners that can replace this one: a lost connection is reopened to
        the first of all that responds. The first connection is only to `url`.

    Raises:
      CongraspError: the URL is malformed; or the certificates are missing, expired, not accepted,
        or of another role or run; or the listener's certificate does not allow it to listen.
      TransportError: no listener responds.
    """
    endpoint = Endpoint(
        url, role, listens=False, certs=certs, wait=wait, run=run, alternatives=alternatives
    )
    return _open(endpoint)


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
      role: learner or policy server.
      certs: folder of the role's certificate: enables mutual TLS, and restricts each role to its
        rights.
      insecure: allows listening beyond loopback without certificates.
      run: required run of the certificate.
      longest_rollout: longest rollout accepted by a learner, in bytes; longer ones are dropped
        undecoded.

    Raises:
      CongraspError: the URL is malformed or in use; or it is exposed to other machines without
        protection; or the certificates are missing, expired, or of another role or run.
    """
    return _open(
        Endpoint(url, role, True, certs, insecure, run=run, longest_rollout=longest_rollout)
    )


def check_listener(
    url: str, role: Listener, *, certs: Certs = None, insecure: bool = False, run: str | None = None
) -> None:
    """Checks the arguments of `listen` without listening, for a Zenoh URL.

    Raises:
      CongraspError: it is exposed to other machines without protection, or needs certificates; or
        these are missing, expired, or of another role or run.
    """
    credentials = find_credentials(certs, role, run)
    check_exposure(url, credentials, insecure=insecure)
    secured(url, credentials)


def find_credentials(certs: Certs, role: str, run: str | None = None) -> Credentials | None:
    """Returns the credentials of a role, for a run if one is given; None without a folder of
    certificates.

    Without the package cryptography, as for a client that needs only NumPy and Zenoh, only the peer
    checks them.

    Raises:
      CongraspError: they are missing, damaged, expired, or of another role or run.
    """
    if certs is None:
        return None
    if importlib.util.find_spec("cryptography") is None:
        return Credentials(pathlib.Path(certs), role)
    from congrasp.common.transport.certificates import find

    credentials = find(pathlib.Path(certs), role)
    if run is not None and credentials.identity.run != run:
        raise CongraspError(
            f"{credentials.certificate} belongs to the run '{credentials.identity.run}', not "
            f"'{run}'.",
            f"Connect to that run, or issue a certificate for this one: congrasp certs issue --run "
            f"{run} --role {role}",
        )
    return credentials


def name_on_wire(name: str, certs: Certs, role: str = "actor") -> str:
    """Name of an actor, server or client on the wire.

    With a certificate, the name begins with the certificate's number.
    """
    credentials = find_credentials(certs, role)
    return name if credentials is None else numbered(credentials.identity.number, name)


def _open(endpoint: Endpoint) -> Transport:
    scheme = endpoint.url.partition("/")[0]
    if scheme not in SCHEMES:
        raise CongraspError(
            f"'{endpoint.url}' is not an endpoint.",
            f"Write it like {LEARNER_URL}; schemes: {', '.join(SCHEMES)}.",
        )
    return SCHEMES[scheme](endpoint)


def _open_memory(endpoint: Endpoint) -> Transport:
    """Opens an in-process transport: every role has all flows, and certificates are ignored."""
    if endpoint.listens:
        return listen_in_memory(endpoint.address)
    return connect_in_memory(endpoint.address, endpoint.wait)


def _open_zenoh(endpoint: Endpoint) -> Transport:
    require_not_inherited("Zenoh")
    from congrasp.common.transport.zenoh_transport import MessageLimits, ZenohTransport

    credentials = find_credentials(endpoint.certs, endpoint.role, endpoint.run)
    if endpoint.listens:
        check_exposure(endpoint.url, credentials, insecure=endpoint.insecure)
        flows = LISTENER_FLOWS[endpoint.role]  # type: ignore[index]
        return ZenohTransport(
            listen=[endpoint.url],
            flows=flows,
            credentials=credentials,
            limits=MessageLimits(rollout=endpoint.longest_rollout),
        )
    flows = PEER_FLOWS[endpoint.role]  # type: ignore[index]
    return ZenohTransport(
        connect=[endpoint.url, *endpoint.alternatives],
        flows=flows,
        wait=endpoint.wait,
        credentials=credentials,
    )


Factory = Callable[[Endpoint], Transport]
SCHEMES: dict[str, Factory] = {
    "memory": _open_memory,
    **dict.fromkeys(("tcp", "tls", "quic", "udp", "ws"), _open_zenoh),
}
"""Factories of transports by scheme."""
