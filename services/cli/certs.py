"""Certificates for mutual TLS: a private authority, and a certificate for each process that joins a
run.
"""

import pathlib
from typing import Annotated, Literal

import tyro
from rich.console import Console
from rich.table import Table

from congrasp.common.transport.security import CERTIFICATE_FILE, LISTENERS, ROLES, Credentials

Folder = Annotated[pathlib.Path, tyro.conf.Positional]
Role = Literal["learner", "actor", "server", "client", "observer"]
_SOON_DAYS = 30
"""A certificate that expires in fewer days is marked."""


def init(
    folder: Folder = pathlib.Path("certs"),
    run: str = "quickstart",
    host: tuple[str, ...] = (),
    force: bool = False,
) -> int:
    """Create a private certificate authority, and certificate number 0 of every role, which are
    sufficient for a run on one machine.

    A certificate is valid for one run. The authority's key, ca.key, signs certificates: protect it
    from other users. Commands on this machine take the authority's folder as --certs.

    Args:
      folder: Folder for the authority and the certificates.
      run: Name of the run.
      host: Host names and addresses under which other machines connect to the learner or the
        policy server of this machine.
      force: Replace an existing authority, whose certificates then become invalid.

    Examples:
      congrasp certs init certs --run human --host 10.0.0.5
      congrasp certs init certs --force
    """
    from congrasp.services.ops.certificates import create_authority, issue

    create_authority(folder, run=run, force=force)
    for role in ROLES:
        hosts = host if role in LISTENERS else ()
        issue(folder, role, number=0, hosts=hosts, force=force)
    return show(folder)


def issue(
    folder: Folder = pathlib.Path("certs"),
    *,
    role: Role,
    run: str | None = None,
    number: int | None = None,
    host: tuple[str, ...] = (),
    days: float = 365.0,
    force: bool = False,
) -> int:
    """Issue a certificate, which is a folder. Copy it to the machine where the role runs, and pass
    it as --certs to the commands there.

    A running learner accepts new certificates. Several actors may share a certificate if they trust
    each other.

    Args:
      folder: Folder of the authority.
      role: Certificate role: learner, actor, server (of a policy), client (of a policy server) or
        observer (status, recorder).
      run: Name of the run; by default that of the authority.
      number: Number of the certificate among those of the role; by default the lowest free number.
      host: Host names and addresses under which others connect to the learner or server.
      days: Days until the certificate expires.
      force: Replace the certificate of this number. The old one remains valid until it expires.

    Examples:
      congrasp certs issue certs --role actor
      congrasp certs issue certs --role server --host 10.0.0.6
    """
    from congrasp.services.ops.certificates import issue, read

    target = issue(folder, role, run=run, number=number, hosts=host, days=days, force=force)
    print(f"{target}: valid until {read(target / CERTIFICATE_FILE).expires:%Y-%m-%d}")
    return 0


def revoke(
    folder: Folder = pathlib.Path("certs"), *, role: Role, number: int, run: str | None = None
) -> int:
    """Revoke a certificate whose key is lost or stolen, so that learners and servers reject it.

    Learners and servers on this machine apply this within seconds, and all their peers reconnect.
    If the certificate is that of a learner or a server, its peers disconnect. On other machines,
    copy the file 'revoked' into the folders of the certificates.

    Args:
      folder: Folder of the authority.
      role: Role of the certificate.
      number: Number of the certificate.
      run: Name of the certificate's run; by default that of the authority.

    Examples:
      congrasp certs revoke certs --role actor --number 1
      congrasp certs revoke certs --role client --number 2 --run human
    """
    from congrasp.services.ops.certificates import revoke

    print(f"{revoke(folder, role, number, run=run)} is revoked.")
    return 0


def show(folder: Folder = pathlib.Path("certs")) -> int:
    """Show the certificates of a folder, their expiry dates, and which are revoked. The exit code
    is 1 if a certificate has expired.

    Args:
      folder: Folder of an authority or of one certificate.

    Examples:
      congrasp certs show
      congrasp certs show certs
    """
    from congrasp.services.ops.certificates import certificates

    revoked = Credentials(folder, "").revoked()
    table = Table("certificate", "expires (UTC)", "days left", "listens as")
    has_expired = False
    for certificate in certificates(folder):
        is_expired = certificate.days <= 0
        has_expired |= is_expired
        days_left = "expired" if is_expired else f"{certificate.days:.0f}"
        if certificate.name in revoked:
            days_left = "revoked"
        style = ""
        if is_expired:
            style = "red"
        elif certificate.days < _SOON_DAYS:
            style = "yellow"
        expires = f"{certificate.expires:%Y-%m-%d %H:%M}"
        hosts = ", ".join(certificate.hosts)
        table.add_row(certificate.name, expires, days_left, hosts, style=style)
    Console(markup=False).print(table)
    return int(has_expired)


COMMANDS = {"init": init, "issue": issue, "revoke": revoke, "show": show}
