"""Reads certificates, and finds the credentials of a role in a folder."""

import datetime
import os
import pathlib
import ssl
from typing import NamedTuple

from cryptography import x509
from cryptography.x509.oid import NameOID

from congrasp.common.errors import CongraspError
from congrasp.common.transport.security import (
    CERTIFICATE_FILE,
    ROLES,
    Credentials,
    Identity,
    not_ours,
    parse_identity,
)


class Certificate(NamedTuple):
    """Content of a certificate."""

    identity: Identity | None
    """Owner of the certificate; None for the authority."""
    run: str
    """Run of the certificate; for the authority, its default run."""
    hosts: tuple[str, ...]
    """Names and addresses at which its owner may listen."""
    expires: datetime.datetime
    """End of its validity, UTC."""

    @property
    def name(self) -> str:
        """The common name."""
        return str(self.identity) if self.identity else "ca"

    @property
    def days(self) -> float:
        """Days until it expires; negative once it has expired."""
        return (self.expires - datetime.datetime.now(datetime.UTC)).total_seconds() / 86400


def load(path: pathlib.Path) -> x509.Certificate:
    """Loads a certificate file; raises a CongraspError if it is not one."""
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError):
        raise CongraspError(
            f"{path} is missing or is not a certificate.",
            "Create it with 'congrasp certs', or correct the path.",
        ) from None


def read(path: pathlib.Path) -> Certificate:
    """Reads a certificate file.

    Raises:
      CongraspError: the file cannot be read, or is not a certificate of this project.
    """
    certificate = load(path)
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    if not names:
        units = certificate.subject.get_attributes_for_oid(NameOID.ORGANIZATIONAL_UNIT_NAME)
        run = str(units[0].value) if units else ""
        return Certificate(None, run, (), certificate.not_valid_after_utc)
    identity = parse_identity(str(names[0].value))
    if identity is None:
        raise not_ours(path, str(names[0].value))
    hosts: list[str] = []
    for extension in certificate.extensions:
        if isinstance(extension.value, x509.SubjectAlternativeName):
            hosts = [str(name.value) for name in extension.value]
    return Certificate(identity, identity.run, tuple(hosts), certificate.not_valid_after_utc)


def find(folder: pathlib.Path, role: str) -> Credentials:
    """Returns the credentials of a role.

    Args:
      folder: folder issued for the role, or that of the authority, from which number 0 is used.
      role: one of `ROLES`.

    Raises:
      CongraspError: they are missing, damaged, expired, or another role's.
    """
    if not (folder / CERTIFICATE_FILE).exists() and (folder / f"{role}.0").exists():
        folder = folder / f"{role}.0"
    credentials = Credentials(folder, role)
    authority = folder.parent if folder.name.partition(".")[0] in ROLES else folder
    remedy = f"Run: congrasp certs issue {authority} --role {role}"
    for path in (credentials.ca, credentials.certificate, credentials.key):
        if not os.access(path, os.R_OK):
            raise CongraspError(f"{path} is missing or cannot be read.", remedy)
    certificate = read(credentials.certificate)
    actual = certificate.identity.role if certificate.identity else "ca"
    if actual != role:
        raise CongraspError(f"{credentials.certificate} has the role {actual}, not {role}.", remedy)
    for expires, path in (
        (certificate.expires, credentials.certificate),
        (read(credentials.ca).expires, credentials.ca),
    ):
        if expires <= datetime.datetime.now(datetime.UTC):
            raise CongraspError(f"{path} expired on {expires:%Y-%m-%d %H:%M} UTC.", remedy)
    try:
        ssl.create_default_context().load_cert_chain(credentials.certificate, credentials.key)
    except (ssl.SSLError, OSError):
        raise CongraspError(
            f"{credentials.key} is not the key of {credentials.certificate}.", remedy
        ) from None
    return credentials
