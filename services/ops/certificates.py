"""A private certificate authority, with one certificate for each run, role and number:
`human.actor.3`.

The common name of a certificate is `<run>.<role>.<number>`. Zenoh compares whole common names and
reads its rules once. Listeners therefore allow all numbers below `NUMBERS` from the start, so that
a certificate issued later works at once. A lost certificate is revoked: its common name is added to
the file `revoked`, which listeners check. Keys are elliptic (P-256), in files readable only by
their owner.
"""

import datetime
import ipaddress
import os
import pathlib
import secrets
import shutil
import tempfile
from collections.abc import Sequence

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.shell import shell_command
from congrasp.common.transport.certificates import Certificate, load, read
from congrasp.common.transport.keys import check_name
from congrasp.common.transport.security import (
    CA_FILE,
    CERTIFICATE_FILE,
    KEY_FILE,
    LISTENERS,
    NUMBERS,
    REVOKED_FILE,
    ROLES,
    Credentials,
    Identity,
)

CA_KEY_FILE = "ca.key"
"""The authority's private key, which stays on the machine of its owner."""
CA_DAYS = 3650
"""Validity of an authority."""
DAYS = 365
"""Default validity of a role's certificate."""
RUN = "quickstart"
"""Default run of an authority."""
_MAX_NAME_CHARACTERS = 64  # limit of a common name in characters (RFC 5280)
_ORGANIZATION = "congrasp"
_LOOPBACK = ("localhost", "127.0.0.1")
_CLOCK_TOLERANCE = datetime.timedelta(minutes=5)  # tolerance between the clocks of two machines


def create_authority(folder: pathlib.Path, *, run: str = RUN, force: bool = False) -> Certificate:
    """Creates an authority: `ca.crt`, which all peers get, and `ca.key`, which must not be copied.

    Args:
      folder: created if needed.
      run: default run of its certificates.
      force: replaces an existing authority, which invalidates all of its certificates.

    Raises:
      CongraspError: there is one already, or a value is not valid.
    """
    if not force and ((folder / CA_FILE).exists() or (folder / CA_KEY_FILE).exists()):
        raise CongraspError(
            f"{folder} already contains a certificate authority.",
            "Issue certificates with it, or pass --force to replace it.",
        )
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, _ORGANIZATION),
            x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, check_name("run", run)),
            # Two authorities of a run must not have the same name.
            x509.NameAttribute(NameOID.SERIAL_NUMBER, secrets.token_hex(8)),
        ]
    )
    usage = x509.KeyUsage(
        digital_signature=True,
        key_cert_sign=True,
        crl_sign=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
    certificate = (
        _builder(name, name, key.public_key(), CA_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .sign(key, hashes.SHA256())
    )
    folder.mkdir(parents=True, exist_ok=True)
    _write_secret(folder / CA_KEY_FILE, key)
    write_atomically(folder / CA_FILE, certificate.public_bytes(serialization.Encoding.PEM))
    (folder / REVOKED_FILE).unlink(missing_ok=True)
    return Certificate(None, run, (), certificate.not_valid_after_utc)


def issue(
    folder: pathlib.Path,
    role: str,
    *,
    run: str | None = None,
    number: int | None = None,
    hosts: Sequence[str] = (),
    days: float = DAYS,
    force: bool = False,
) -> pathlib.Path:
    """Issues a certificate.

    Args:
      folder: folder of the authority; the new folder `<role>.<number>` with `ca.crt`, `tls.crt` and
        `tls.key` is created in it.
      role: one of `ROLES`.
      run: name of the run; by default the authority's.
      number: number of the certificate; by default the lowest without a folder that is not revoked.
      hosts: names and addresses at which its owner may listen, in addition to loopback.
      days: validity in days, at most that of the authority.
      force: replaces an existing certificate.

    Returns:
      The new folder: copy it to the machine where the role runs.

    Raises:
      CongraspError: there is no authority, the certificate exists already, or a value is not valid.
    """
    if role not in ROLES:
        raise CongraspError(
            f"There is no role {ascii(role)[:40]} for certificates.",
            f"Choose one of: {', '.join(ROLES)}.",
        )
    if hosts and role not in LISTENERS:
        raise CongraspError(
            f"A certificate of the role {role} cannot name hosts.",
            f"Only {' and '.join(LISTENERS)} can.",
        )
    ca, ca_key = _authority(folder)
    name_of_run = check_name("run", run or read(folder / CA_FILE).run)
    identity = _free_identity(folder, role, name_of_run, number, force)
    key = ec.generate_private_key(ec.SECP256R1())
    common_name = x509.NameAttribute(NameOID.COMMON_NAME, str(identity))
    subject = x509.Name([x509.NameAttribute(NameOID.ORGANIZATION_NAME, _ORGANIZATION), common_name])
    builder = _builder(subject, ca.subject, key.public_key(), days, at_most=ca.not_valid_after_utc)
    certificate = (
        _with_uses(builder, role, hosts)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(ca_key.public_key()), critical=False
        )
        .sign(ca_key, hashes.SHA256())
    )
    target = folder / f"{role}.{identity.number}"
    files = {
        CERTIFICATE_FILE: certificate.public_bytes(serialization.Encoding.PEM),
        CA_FILE: (folder / CA_FILE).read_bytes(),
    }
    if (folder / REVOKED_FILE).exists():
        files[REVOKED_FILE] = (folder / REVOKED_FILE).read_bytes()
    # The files are complete before they replace a certificate, which a full disk then cannot cost.
    with tempfile.TemporaryDirectory(prefix=".new-", dir=folder) as temporary:
        complete = pathlib.Path(temporary, target.name)
        complete.mkdir(mode=0o700)
        _write_secret(complete / KEY_FILE, key)
        for name, content in files.items():
            (complete / name).write_bytes(content)
        if target.exists():
            shutil.rmtree(target)
        complete.replace(target)
    return target


def _free_identity(
    folder: pathlib.Path, role: str, run: str, number: int | None, force: bool
) -> Identity:
    """Returns the identity of a new certificate; see `issue`."""
    revoked = Credentials(folder, role).revoked()

    def is_taken(number: int) -> bool:
        has_folder = (folder / f"{role}.{number}").exists()
        return has_folder or str(Identity(run, role, number)) in revoked

    if number is None:
        # Without a free number, `NUMBERS` itself is rejected below.
        number = next((i for i in range(NUMBERS) if not is_taken(i)), NUMBERS)
    if not 0 <= number < NUMBERS:
        raise CongraspError(
            f"{role}.{number} cannot be issued.", f"Numbers range from 0 to {NUMBERS - 1}."
        )
    target = folder / f"{role}.{number}"
    identity = Identity(run, role, number)
    if target.exists() and not force:
        raise CongraspError(
            f"{target} exists already.", "Pass another --number, or --force to replace it."
        )
    if str(identity) in revoked:
        raise CongraspError(f"{identity} is revoked.", "Pass another --number.")
    if len(str(identity)) > _MAX_NAME_CHARACTERS:
        raise CongraspError(
            f"{identity} is longer than {_MAX_NAME_CHARACTERS} characters.",
            "Give the run a shorter name.",
        )
    return identity


def _with_uses(
    builder: x509.CertificateBuilder, role: str, hosts: Sequence[str]
) -> x509.CertificateBuilder:
    """Restricts a role's certificate to its uses: to connect and, at these hosts and loopback, to
    listen.
    """
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if role in LISTENERS:
        uses.append(ExtendedKeyUsageOID.SERVER_AUTH)
        names = [_host(host) for host in dict.fromkeys((*_LOOPBACK, *hosts))]
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    builder = builder.add_extension(
        x509.BasicConstraints(ca=False, path_length=None), critical=True
    )
    return builder.add_extension(x509.ExtendedKeyUsage(uses), critical=False)


def revoke(folder: pathlib.Path, role: str, number: int, *, run: str | None = None) -> str:
    """Revokes a certificate: adds its common name to the list of the authority and in all folders
    within its folder.

    Args:
      folder: folder of the authority.
      role: one of `ROLES`.
      number: number of the certificate.
      run: run of the certificate; by default the authority's.

    Returns:
      The common name.

    Raises:
      CongraspError: there is no authority.
    """
    _authority(folder)
    name = str(Identity(run or read(folder / CA_FILE).run, role, number))
    names = sorted(Credentials(folder, role).revoked() | {name})
    lines = "".join(f"{revoked_name}\n" for revoked_name in names)
    folders = [folder]
    for issued_role in ROLES:
        folders += folder.glob(f"{issued_role}.*")
    for certificate_folder in folders:
        write_atomically(certificate_folder / REVOKED_FILE, lines.encode())
    return name


def certificates(folder: pathlib.Path) -> list[Certificate]:
    """Returns all certificates in a folder, the authority's first.

    Raises:
      CongraspError: there are none, or one is damaged.
    """
    files = [folder / CA_FILE, folder / CERTIFICATE_FILE, *folder.glob(f"*.*/{CERTIFICATE_FILE}")]
    listed = [read(path) for path in files if path.exists()]
    if not listed:
        raise CongraspError(
            f"{folder} contains no certificates.",
            f"Create them: {shell_command('congrasp', 'certs', 'init', folder)}",
        )
    # The authority has no identity.
    return sorted(listed, key=lambda certificate: certificate.identity or Identity("", "", 0))


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    days: float,
    at_most: datetime.datetime | None = None,
) -> x509.CertificateBuilder:
    """Returns a builder with the fields of all certificates: names, key, serial number, validity.

    Args:
      subject: name of the owner.
      issuer: name of the authority.
      key: public key of the owner.
      days: validity; below zero for a certificate that has expired.
      at_most: latest end of the validity, if any.

    Raises:
      CongraspError: the validity is too long.
    """
    now = datetime.datetime.now(datetime.UTC)
    if not -CA_DAYS <= days <= 2 * CA_DAYS:
        raise CongraspError(
            f"A certificate cannot be valid for {days:g} days.", f"Pass at most {2 * CA_DAYS}."
        )
    end = now + datetime.timedelta(days=days)
    limited_end = min(end, at_most) if at_most else end
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, end) - _CLOCK_TOLERANCE)
        .not_valid_after(limited_end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _host(name: str) -> x509.GeneralName:
    """Converts a host's name, which may begin with the wildcard `*.`, or its address.

    Raises:
      CongraspError: it is neither.
    """
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        pass
    labels = name.removeprefix("*.").split(".")
    if len(name) > 253 or not all(map(_is_label, labels)):  # RFC 1035
        raise CongraspError(
            f"{ascii(name)[:70]} is neither a host name nor an address.", "Correct --host."
        )
    return x509.DNSName(name)


def _is_label(label: str) -> bool:
    """True for one of the words of a host name, between its dots."""
    return 0 < len(label) < 64 and label.replace("-", "a").isalnum() and label.isascii()


def _authority(folder: pathlib.Path) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """Loads certificate and key of the authority in a folder.

    Raises:
      CongraspError: there is none.
    """
    try:
        key = serialization.load_pem_private_key((folder / CA_KEY_FILE).read_bytes(), None)
    except (OSError, ValueError):
        raise CongraspError(
            f"There is no authority for certificates in {folder}.",
            f"Create one: {shell_command('congrasp', 'certs', 'init', folder)}",
        ) from None
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    return load(folder / CA_FILE), key


def _write_secret(path: pathlib.Path, key: ec.EllipticCurvePrivateKey) -> None:
    """Writes a key that only its owner can read."""
    path.unlink(missing_ok=True)
    text = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(text)
