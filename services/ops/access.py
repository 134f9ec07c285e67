"""Certificates of a command: from its options to the credentials of its role."""

import pathlib

from common.errors import CongraspError
from common.transport.security import CERTIFICATE_FILE, Credentials, actor_name, check_exposure


def credentials(certs: pathlib.Path | None, role: str) -> Credentials | None:
    """The credentials with which a role connects; None without certificates.

    Args:
      certs: a folder that 'congrasp certs' made: a role's own, or the authority's.
      role: one of `common.transport.security.ROLES`.
    """
    if certs is None:
        return None
    from services.ops.certificates import find_credentials

    return find_credentials(certs, role)[0]


def listening(endpoint: str, certs: pathlib.Path | None, role: str, *, insecure: bool) -> Credentials | None:
    """The credentials with which a role listens; a CongraspError where it would be open to other machines without."""
    found = credentials(certs, role)
    check_exposure(endpoint, found, insecure=insecure)
    return found


def acting(certs: pathlib.Path | None, name: str) -> tuple[Credentials | None, str]:
    """The credentials of an actor, and its name on the wire, which its certificate has a part in."""
    if certs is None:
        return None, name
    from services.ops.certificates import find_credentials

    found, certificate = find_credentials(certs, "actor")
    return found, actor_name(certificate.number, name)


def nearby(endpoint: str) -> str:
    """Where this machine reaches what listens on an endpoint."""
    for everywhere in ("/0.0.0.0:", "/[::]:"):
        if everywhere in endpoint:
            return endpoint.replace(everywhere, "/127.0.0.1:")
    return endpoint


def check_training(listen: str, certs: pathlib.Path | None, *, insecure: bool) -> None:
    """Sees before anything starts that a learner with actors beside it may listen, and has all certificates."""
    if certs is not None and (certs / CERTIFICATE_FILE).exists():
        raise CongraspError(f"{certs} belongs to one role.", "Name the authority's folder, which holds all of them.")
    listening(listen, certs, "learner", insecure=insecure)
    for role in ("actor", "observer"):
        credentials(certs, role)
