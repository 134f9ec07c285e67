"""Authentication and authorisation on the wire: mutual TLS, and the rights of each role at a
listener.

Every peer presents a certificate of the authority with the common name `<run>.<role>.<number>`. The
listening process (the learner, or a policy server) denies everything except what `RIGHTS` grants
that name, both for its endpoint and for what it would forward. A peer's names on the wire begin
with its certificate's number, so it cannot impersonate another certificate. The connecting process
denies everything to a listener that is not its run's learner or policy server.

Zenoh reads its rules once and compares whole common names. The rules therefore contain all numbers,
whether or not their certificates exist yet, except those in the file `revoked`. When that file
changes, the sessions are reopened.
"""

import contextlib
import dataclasses
import ipaddress
import pathlib
import re
import socket
import ssl
from collections.abc import Iterable, Iterator, Set
from typing import Any, NamedTuple

from congrasp.common.errors import CongraspError
from congrasp.common.transport.keys import ROOT, Flow, flow

ROLES = ("learner", "actor", "server", "client", "observer")
"""Certificate roles."""
LISTENERS = ("learner", "server")
"""Roles to whose certificates others connect."""
NUMBERS = 256
"""Number of certificates of a role."""
CA_FILE = "ca.crt"
CERTIFICATE_FILE = "tls.crt"
KEY_FILE = "tls.key"
REVOKED_FILE = "revoked"
_PROBE_TIMEOUT_S = 1.0
_ENDPOINT = re.compile(r"(?P<protocol>[a-z-]+)/(?P<host>\[[^]]*\]|[^/:]*)(:(?P<port>\d+))?.*")


class Identity(NamedTuple):
    """Identity in a certificate's common name."""

    run: str
    """Name of the run."""
    role: str
    """One of `ROLES`."""
    number: int
    """Distinguishes the certificates of a role; below `NUMBERS`."""

    def __str__(self) -> str:
        return f"{self.run}.{self.role}.{self.number}"


def parse_identity(common_name: str) -> Identity | None:
    """Parses a common name; returns None if it is not an identity."""
    parts = common_name.rsplit(".", 2)
    if len(parts) != 3:
        return None
    run, role, digits = parts
    if not run or role not in ROLES or not (digits.isascii() and digits.isdigit()):
        return None
    number = int(digits)
    return Identity(run, role, number) if number < NUMBERS else None


def not_ours(path: pathlib.Path, common_name: str) -> CongraspError:
    """Error for a certificate whose common name is not an identity."""
    return CongraspError(
        f"{path} is a certificate for {ascii(common_name)[:90]}, which is not a run, role and "
        f"number.",
        "Issue one with 'congrasp certs issue'.",
    )


@dataclasses.dataclass(frozen=True)
class Credentials:
    """A folder with the authority's certificate, a peer's certificate and its key, under Kubernetes
    file names.
    """

    folder: pathlib.Path
    role: str
    """One of `ROLES`."""

    @property
    def ca(self) -> pathlib.Path:
        """The authority's certificate."""
        return self.folder / CA_FILE

    @property
    def certificate(self) -> pathlib.Path:
        """The peer's certificate."""
        return self.folder / CERTIFICATE_FILE

    @property
    def key(self) -> pathlib.Path:
        """Private key of the certificate."""
        return self.folder / KEY_FILE

    @property
    def identity(self) -> Identity:
        """Identity of the certificate; raises a CongraspError if it cannot be read or does not name
        run and role.
        """
        try:
            decoded: Any = ssl._ssl._test_decode_cert(str(self.certificate))  # type: ignore[attr-defined]
        except (OSError, ValueError):
            raise CongraspError(
                f"The credentials in {self.folder} cannot be used.",
                "Issue new ones with 'congrasp certs issue'.",
            ) from None
        names: list[str] = []
        for entry in decoded["subject"]:
            names += [value for key, value in entry if key == "commonName"]
        identity = parse_identity(names[0]) if names else None
        if identity is None:
            raise not_ours(self.certificate, "".join(names))
        return identity

    def revoked(self) -> frozenset[str]:
        """Common names in the list of revoked certificates; empty without a list.

        Raises:
          CongraspError: the list cannot be read; no peer may be admitted without it.
        """
        try:
            return frozenset((self.folder / REVOKED_FILE).read_text(encoding="utf-8").split())
        except FileNotFoundError:
            return frozenset()
        except (OSError, UnicodeDecodeError):
            raise CongraspError(
                f"{self.folder / REVOKED_FILE} cannot be read.", "Copy it again."
            ) from None

    def expects(self, name: Flow, common_name: str | None) -> bool:
        """True if a certificate with this common name may listen to these credentials in a flow."""
        return common_name in self._listeners(name)

    def _listeners(self, name: Flow) -> list[str]:
        """Common names that may listen to these credentials: the learner's, in some flows also the
        server's.
        """
        roles = LISTENERS if name == "policy" else LISTENERS[:1]
        run = self.identity.run
        revoked = self.revoked()
        names: list[str] = []
        for role in roles:
            names += [str(Identity(run, role, number)) for number in range(NUMBERS)]
        return [common_name for common_name in names if common_name not in revoked]

    def settings(self, name: Flow, *, listens: bool) -> dict[str, Any]:
        """Zenoh configuration of a session with these credentials.

        Args:
          name: flow of the session.
          listens: True for a session that listens; False for one that connects.
        """
        side = "listen" if listens else "connect"
        tls = {
            "root_ca_certificate": str(self.ca),
            f"{side}_certificate": str(self.certificate),
            f"{side}_private_key": str(self.key),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
        if listens:
            access = _access_control(self.identity, name, self.revoked())
        else:
            access = _only(self._listeners(name))
        return {
            "transport/link/protocols": ["tls"],
            "transport/link/tls": tls,
            "access_control": access,
        }


@dataclasses.dataclass(frozen=True)
class Rights:
    """Rights of a role at a listener, as key expressions below the run; `{name}` matches the
    certificate's names.
    """

    ask: tuple[str, ...] = ()
    """Keys it may query."""
    publish: tuple[str, ...] = ()
    """Keys it may publish."""
    hear: tuple[str, ...] = ()
    """Expressions it may subscribe to."""
    show: tuple[str, ...] = ()
    """Liveliness tokens it may declare."""


RIGHTS: dict[str, dict[str, Rights]] = {
    "learner": {
        "actor": Rights(
            ask=("config", "weights/latest/actor/{name}", "ticket/{name}", "rollout/{name}"),
            publish=("log/*/actor/{name}",),
            hear=("weights/announce",),
            show=("alive/actor/{name}/*",),
        ),
        "server": Rights(
            ask=("config", "weights/latest/server/{name}"),
            hear=("weights/announce",),
            show=("alive/server/*/*",),
        ),
        "observer": Rights(
            ask=("config", "status"), hear=("log/**",), show=("alive/recorder/*/*",)
        ),
    },
    "server": {
        "client": Rights(ask=("policy/act/{name}", "policy/health")),
        "observer": Rights(ask=("policy/health",)),
    },
}
"""Rights by listening and connecting role; everything else is denied."""


@dataclasses.dataclass(frozen=True)
class Limit:
    """Limit of what one connection may send under an expression; excess is dropped, and such a
    query gets no reply.
    """

    keys: str
    """Expression below the run."""
    size: int
    """Largest message in bytes."""
    rate: float
    """With certificates: most messages per second. They must be evenly spaced; one that follows
    another too soon is dropped. 0 for no limit."""


_MAX_QUERY_BYTES = 64 << 10
_MAX_ACT_BYTES = 1 << 20
_MAX_LOG_BYTES = 16 << 20
LIMITS: tuple[Limit, ...] = (
    Limit("config", _MAX_QUERY_BYTES, 100.0),
    Limit("status", _MAX_QUERY_BYTES, 100.0),
    Limit("weights/latest/**", _MAX_QUERY_BYTES, 0.0),  # counted per peer by the hub
    Limit("ticket/*", _MAX_QUERY_BYTES, 0.0),  # counted per actor by the hub
    *(
        Limit(f"log/{channel}/**", _MAX_LOG_BYTES, 100.0)
        for channel in ("metrics", "event", "version", "episode", "rollout")
    ),
    # The policy server's queue refuses excess with a message.
    Limit("policy/act/**", _MAX_ACT_BYTES, 0.0),
    Limit("policy/health", _MAX_QUERY_BYTES, 100.0),
)
"""Rollouts are limited by their size and by the learner's hub."""


def numbered(number: int, name: str) -> str:
    """Name on the wire of the owner of the certificate with this number."""
    return f"{number}.{name}"


def secured(endpoint: str, credentials: Credentials | None) -> str:
    """Returns the endpoint to use: with credentials always TLS.

    Raises:
      CongraspError: a TLS or QUIC endpoint has no credentials, or one with credentials is neither
        TCP nor TLS.
    """
    protocol, _, rest = endpoint.partition("/")
    if credentials is None:
        if protocol in ("tls", "quic"):
            raise CongraspError(
                f"'{endpoint}' needs certificates.", "Pass --certs; 'congrasp certs' creates them."
            )
        return endpoint
    if protocol not in ("tcp", "tls"):
        raise CongraspError(
            f"'{endpoint}' cannot be used with certificates.", "Write it like tls/10.0.0.5:7447."
        )
    return f"tls/{rest}"


def check_exposure(endpoint: str, credentials: Credentials | None, *, insecure: bool) -> None:
    """Refuses to listen without protection where other machines can connect.

    Raises:
      CongraspError: the endpoint would be exposed.
    """
    if credentials is None and not insecure and not _is_loopback(endpoint):
        raise CongraspError(
            f"'{endpoint}' would be reachable from other machines without protection.",
            "Pass --certs ('congrasp certs' creates them), or --insecure in a network where every "
            "machine is trusted.",
        )


def refusal(endpoint: str, credentials: Credentials | None) -> CongraspError | None:
    """Returns the error of a connection that fails because of certificates; None for other causes.

    The attempt to connect takes one or two seconds. It is needed since Zenoh reports every failure
    in the same way: that it could not connect.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if not match or not match["port"]:
        return None
    host = match["host"].strip("[]")
    try:
        with socket.create_connection((host, int(match["port"])), _PROBE_TIMEOUT_S) as raw:
            return _handshake(raw, host, endpoint, credentials)
    except OSError:
        return None


def _handshake(
    raw: socket.socket, host: str, endpoint: str, credentials: Credentials | None
) -> CongraspError | None:
    """Returns the error of a TLS handshake if it is caused by the certificates."""
    context = ssl.create_default_context()
    if credentials is None:
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
    else:
        try:
            context = ssl.create_default_context(cafile=str(credentials.ca))
            context.load_cert_chain(credentials.certificate, credentials.key)
        except OSError:  # SSLError is an OSError
            return CongraspError(
                f"The credentials in {credentials.folder} cannot be used.",
                "Issue new ones with 'congrasp certs issue'.",
            )
    try:
        with context.wrap_socket(raw, server_hostname=host) as connection:
            if credentials is None:
                return CongraspError(
                    f"{endpoint} requires certificates.",
                    "Pass --certs; 'congrasp certs' creates them on its machine.",
                )
            with contextlib.suppress(TimeoutError):
                connection.recv(1)  # in TLS 1.3 the peer checks our certificate after the handshake
            return None
    except ssl.SSLCertVerificationError as error:
        what = f"{endpoint} presents a certificate that is not trusted: {error.verify_message}."
        return CongraspError(
            what, "Use certificates of one authority, and pass --host with the host when issuing."
        )
    except ssl.SSLError as error:
        reason = error.reason or ""
        if "ALERT" not in reason:
            return None
        certificate = credentials.certificate if credentials else "none"
        return CongraspError(
            f"{endpoint} refuses the certificate ({certificate}): {_alert_text(reason)}.",
            "Issue one with its authority.",
        )


def _alert_text(reason: str) -> str:
    """Reason of a peer's TLS alert against a certificate, as a predicate."""
    if "EXPIRED" in reason:
        return "expired"
    if "REQUIRED" in reason:
        return "missing"
    return "not accepted"


def _is_loopback(endpoint: str) -> bool:
    """True if only this machine can reach an endpoint."""
    match = _ENDPOINT.fullmatch(endpoint)
    if not match:
        return False
    host = match["host"].strip("[]")
    if match["protocol"].startswith("unix") or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _only(names: list[str]) -> dict[str, Any]:
    """Access control of a connecting process: everything from these names, nothing from others."""
    messages = ["put", "delete", "query", "reply", "declare_subscriber", "declare_queryable"]
    liveliness = ["liveliness_token", "liveliness_query", "declare_liveliness_subscriber"]
    rule = {
        "id": "all",
        "permission": "allow",
        "flows": ["ingress", "egress"],
        "messages": messages + liveliness,
        "key_exprs": ["**"],
    }
    subjects = [{"id": "listener", "cert_common_names": names}]
    policies = [{"rules": ["all"], "subjects": ["listener"]}]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule],
        "subjects": subjects,
        "policies": policies,
    }


def _access_control(listener: Identity, name: Flow, revoked: Set[str]) -> dict[str, Any]:
    """Access control of a listener in one flow: the rights of each certificate; everything else is
    denied.
    """
    # Clients of a server use other names for the policy
    run = listener.run if listener.role == "learner" else "*"
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []

    def allow(subject: str, names: list[str], rights: Rights) -> None:
        allowed = list(_rules(subject, rights, name, run))
        if not allowed or not names:
            return
        rules.extend(allowed)
        subjects.append({"id": subject, "cert_common_names": names})
        policies.append({"rules": [rule["id"] for rule in allowed], "subjects": [subject]})

    for role, rights in RIGHTS.get(listener.role, {}).items():
        shared, named = _split(rights)
        peers = [Identity(listener.run, role, number) for number in range(NUMBERS)]
        peers = [peer for peer in peers if str(peer) not in revoked]
        allow(role, [str(peer) for peer in peers], shared)
        if named == Rights():
            continue
        for peer in peers:
            allow(str(peer), [str(peer)], _fill_name(named, numbered(peer.number, "$*")))
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rules(subject: str, rights: Rights, name: Flow, run: str) -> Iterator[dict[str, Any]]:
    """Yields the Zenoh rules of one flow: for incoming messages, and for outgoing replies."""
    kinds = (
        (rights.ask, "query", "reply"),
        (rights.publish, "put", None),
        (rights.hear, "declare_subscriber", "put"),
        (rights.show, "liveliness_token", None),
    )
    for parts, incoming, outgoing in kinds:
        keys = _of_flow(parts, name, run)
        if not keys:
            continue
        for direction, message in (("ingress", incoming), ("egress", outgoing)):
            if message is None:
                continue
            yield {
                "id": f"{subject} {direction} {incoming}",
                "permission": "allow",
                "flows": [direction],
                "messages": [message],
                "key_exprs": keys,
            }


def _of_flow(parts: Iterable[str], name: Flow, run: str = "*") -> list[str]:
    """Keys of a run, or of any run, that belong to a flow."""
    keys = [f"{ROOT}/{run}/{part}" for part in parts]
    return [key for key in keys if flow(key) == name]


def _split(rights: Rights) -> tuple[Rights, Rights]:
    """Splits rights into those shared by a role and those restricted to names."""
    shared: dict[str, tuple[str, ...]] = {}
    named: dict[str, tuple[str, ...]] = {}
    for kind, keys in dataclasses.asdict(rights).items():
        shared[kind] = tuple(key for key in keys if "{name}" not in key)
        named[kind] = tuple(key for key in keys if "{name}" in key)
    return Rights(**shared), Rights(**named)


def _fill_name(rights: Rights, name: str) -> Rights:
    """Replaces `{name}` in rights by a name."""
    filled: dict[str, tuple[str, ...]] = {}
    for kind, keys in dataclasses.asdict(rights).items():
        filled[kind] = tuple(key.replace("{name}", name) for key in keys)
    return Rights(**filled)


def limits(name: Flow, *, rates: bool) -> dict[str, Any]:
    """Zenoh configuration of the size and rate limits of a listener in one flow."""
    scope = {"flows": ["ingress"], "messages": ["query", "put"]}
    size_rules: list[dict[str, Any]] = []
    rate_rules: list[dict[str, Any]] = []
    for limit in LIMITS:
        for key in _of_flow([limit.keys], name):
            size_rules.append({"id": key, **scope, "key_exprs": [key], "size_limit": limit.size})
            if rates and limit.rate:
                rate_rules.append({"key_expr": key, "freq": limit.rate})
    downsampling = [{"id": "rates", **scope, "rules": rate_rules}] if rate_rules else []
    return {"low_pass_filter": size_rules, "downsampling": downsampling}
