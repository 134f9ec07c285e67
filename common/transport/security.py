"""Who may do what on the wire: mutual TLS, and what each role is allowed by the process that listens.

Everyone shows a certificate of the authority whose common name is `<run>.<role>.<number>`. The listening process (the
learner, or a policy server) denies everything but what `RIGHTS` gives that name, for its own end and for what it would
forward. A peer's names on the wire begin with its certificate's number, so it cannot speak for another certificate's.
The connecting process denies everything to a listener that is not its run's learner or policy server.

Zenoh reads its rules once and compares common names as a whole; so all numbers are written into the rules, whether
their certificates exist yet or not, except those that the file `revoked` names. When that file changes, the sessions
are opened anew.
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
"""Roles whose certificates others connect to."""
NUMBERS = 256
"""Certificates of one role."""
CA_FILE, CERTIFICATE_FILE, KEY_FILE, REVOKED_FILE = "ca.crt", "tls.crt", "tls.key", "revoked"
_PROBE_SECONDS = 1.0
_ENDPOINT = re.compile(r"(?P<protocol>[a-z-]+)/(?P<host>\[[^]]*\]|[^/:]*)(:(?P<port>\d+))?.*")


class Identity(NamedTuple):
    """What a certificate's common name says."""

    run: str
    """Name of the run that it is for."""
    role: str
    """One of `ROLES`."""
    number: int
    """Tells the certificates of a role apart; below `NUMBERS`."""

    def __str__(self) -> str:
        return f"{self.run}.{self.role}.{self.number}"


def parse_identity(common_name: str) -> Identity | None:
    """The identity that a common name spells; None if it spells none."""
    run, role, number = ("", "", *common_name.rsplit(".", 2))[-3:]
    fits = run and role in ROLES and number.isascii() and number.isdigit() and int(number) < NUMBERS
    return Identity(run, role, int(number)) if fits else None


def not_ours(path: pathlib.Path, common_name: str) -> CongraspError:
    """The error of a certificate whose common name spells no identity."""
    return CongraspError(
        f"{path} is a certificate for {ascii(common_name)[:90]}, which is no run, role and number.",
        "Issue one with 'congrasp certs issue'.",
    )


@dataclasses.dataclass(frozen=True)
class Credentials:
    """A folder with the authority's certificate, one's own, and its key, under the names that Kubernetes gives them."""

    folder: pathlib.Path
    role: str
    """One of `ROLES`."""

    @property
    def ca(self) -> pathlib.Path:
        """The authority's certificate."""
        return self.folder / CA_FILE

    @property
    def certificate(self) -> pathlib.Path:
        """One's own certificate."""
        return self.folder / CERTIFICATE_FILE

    @property
    def key(self) -> pathlib.Path:
        """Its private key."""
        return self.folder / KEY_FILE

    @property
    def identity(self) -> Identity:
        """Whose certificate it is; a CongraspError if it cannot be read, or names no run and role."""
        try:
            decoded: Any = ssl._ssl._test_decode_cert(str(self.certificate))  # type: ignore[attr-defined]
        except (OSError, ValueError):
            raise CongraspError(f"The credentials in {self.folder} cannot be used.", "Issue them anew.") from None
        names = [value for entry in decoded["subject"] for key, value in entry if key == "commonName"]
        found = parse_identity(names[0]) if names else None
        if found is None:
            raise not_ours(self.certificate, "".join(names))
        return found

    def revoked(self) -> frozenset[str]:
        """Common names in the list of revoked certificates beside these; none without a list.

        Raises:
          CongraspError: there is a list that cannot be read: without it nobody is to be let in.
        """
        try:
            return frozenset((self.folder / REVOKED_FILE).read_text().split())
        except FileNotFoundError:
            return frozenset()
        except (OSError, UnicodeDecodeError):
            raise CongraspError(f"{self.folder / REVOKED_FILE} cannot be read.", "Copy it again.") from None

    def expects(self, name: Flow, common_name: str | None) -> bool:
        """Whether a certificate of this common name may listen to these in a flow."""
        return common_name in self._listeners(name)

    def _listeners(self, name: Flow) -> list[str]:
        """Common names that may listen to these in a flow: the learner's, and for queries of a policy the server's."""
        run, revoked = self.identity.run, self.revoked()
        roles = LISTENERS if name == "policy" else LISTENERS[:1]
        names = [str(Identity(run, role, number)) for role in roles for number in range(NUMBERS)]
        return [one for one in names if one not in revoked]

    def settings(self, name: Flow, *, listens: bool) -> dict[str, Any]:
        """Zenoh's configuration for the session of one flow that listens or connects with these."""
        side = "listen" if listens else "connect"
        tls = {
            "root_ca_certificate": str(self.ca),
            f"{side}_certificate": str(self.certificate),
            f"{side}_private_key": str(self.key),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
        settings: dict[str, Any] = {"transport/link/protocols": ["tls"], "transport/link/tls": tls}
        rules = _access_control(self.identity, name, self.revoked()) if listens else _only(self._listeners(name))
        return {**settings, "access_control": rules}


@dataclasses.dataclass(frozen=True)
class Rights:
    """What a role may do at a listener; key expressions below the run, where `{name}` stands for names of its own."""

    ask: tuple[str, ...] = ()
    """Keys that it may query."""
    publish: tuple[str, ...] = ()
    """Keys under which it may publish."""
    hear: tuple[str, ...] = ()
    """Expressions to which it may subscribe."""
    show: tuple[str, ...] = ()
    """Liveliness tokens that it may declare."""


RIGHTS: dict[str, dict[str, Rights]] = {
    "learner": {
        "actor": Rights(
            ask=("config", "weights/latest/actor/{name}", "ticket/{name}", "rollout/{name}"),
            publish=("log/*/actor/{name}",),
            hear=("weights/announce",),
            show=("alive/actor/{name}/*",),
        ),
        "server": Rights(
            ask=("config", "weights/latest/server/{name}"), hear=("weights/announce",), show=("alive/server/*/*",)
        ),
        "observer": Rights(ask=("config", "status"), hear=("log/**",), show=("alive/recorder/*/*",)),
    },
    "server": {
        "client": Rights(ask=("policy/act/{name}", "policy/health")),
        "observer": Rights(ask=("policy/health",)),
    },
}
"""By the role that listens and the role that connects; what is not here is denied."""


@dataclasses.dataclass(frozen=True)
class Limit:
    """What one connection may send under an expression; what exceeds it is dropped, and a query then has no answer."""

    keys: str
    """Expression below the run."""
    size: int
    """Bytes of a message."""
    rate: float
    """With certificates: messages a second, evenly spaced; those that come sooner after the one before are dropped. 0
    for no limit."""


_SMALL, _LOG = 64 << 10, 16 << 20
LIMITS: tuple[Limit, ...] = (
    Limit("config", _SMALL, 100.0),
    Limit("status", _SMALL, 100.0),
    Limit("weights/latest/**", _SMALL, 0.0),  # the hub counts these by peer
    Limit("ticket/*", _SMALL, 0.0),  # and these by actor
    *(Limit(f"log/{channel}/**", _LOG, 100.0) for channel in ("metrics", "event", "version", "episode", "rollout")),
    # The policy server's own queue refuses what is too much, with a message.
    Limit("policy/act/**", 1 << 20, 0.0),
    Limit("policy/health", _SMALL, 100.0),
)
"""Rollouts are limited by the longest message and by the learner's hub."""


def numbered(number: int, name: str) -> str:
    """The name on the wire of who has the certificate of this number."""
    return f"{number}.{name}"


def secured(endpoint: str, credentials: Credentials | None) -> str:
    """The endpoint that is used: with credentials always TLS.

    Raises:
      CongraspError: the endpoint wants TLS and there are no credentials, or the other way round.
    """
    protocol, _, rest = endpoint.partition("/")
    if credentials is None:
        if protocol in ("tls", "quic"):
            raise CongraspError(f"'{endpoint}' needs certificates.", "Give --certs; 'congrasp certs' makes them.")
        return endpoint
    if protocol not in ("tcp", "tls"):
        raise CongraspError(f"'{endpoint}' does not go with certificates.", "Write it like tls/10.0.0.5:7447.")
    return f"tls/{rest}"


def check_exposure(endpoint: str, credentials: Credentials | None, *, insecure: bool) -> None:
    """Refuses to listen where other machines can connect when nothing protects it.

    Raises:
      CongraspError: it would.
    """
    if credentials is None and not insecure and not _is_loopback(endpoint):
        raise CongraspError(
            f"'{endpoint}' could be reached from other machines, and nothing would protect it.",
            "Give --certs ('congrasp certs' makes them), or --insecure in a network where you trust everyone.",
        )


def refusal(endpoint: str, credentials: Credentials | None) -> CongraspError | None:
    """Why a connection cannot be made, if the reason is the certificates: takes one attempt, of a second or two.

    Zenoh reports every failure alike: that it could not connect.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if not match or not match["port"]:
        return None
    host = match["host"].strip("[]")
    try:
        with socket.create_connection((host, int(match["port"])), _PROBE_SECONDS) as raw:
            return _handshake(raw, host, endpoint, credentials)
    except OSError:
        return None


def _handshake(raw: socket.socket, host: str, endpoint: str, credentials: Credentials | None) -> CongraspError | None:
    """What a TLS handshake fails with, if it is the certificates."""
    context = ssl.create_default_context()
    if credentials is None:
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    else:
        try:
            context = ssl.create_default_context(cafile=str(credentials.ca))
            context.load_cert_chain(credentials.certificate, credentials.key)
        except OSError:  # an SSLError is one, too
            return CongraspError(f"The credentials in {credentials.folder} cannot be used.", "Issue them anew.")
    try:
        with context.wrap_socket(raw, server_hostname=host) as connection:
            if credentials is None:
                return CongraspError(
                    f"{endpoint} asks for certificates.", "Give --certs; 'congrasp certs' makes them on its machine."
                )
            with contextlib.suppress(TimeoutError):
                connection.recv(1)  # in TLS 1.3 the other side judges our certificate after the handshake
            return None
    except ssl.SSLCertVerificationError as error:
        what = f"{endpoint} shows a certificate that is not to be trusted: {error.verify_message}."
        return CongraspError(what, "Use certificates of one authority, and name the host with --host when issuing.")
    except ssl.SSLError as error:
        if "ALERT" not in (error.reason or ""):
            return None
        why = "expired" if "EXPIRED" in error.reason else "missing" if "REQUIRED" in error.reason else "not accepted"
        where = credentials.certificate if credentials else "none"
        return CongraspError(
            f"{endpoint} refuses: the certificate ({where}) is {why}.", "Issue one with its authority."
        )


def _is_loopback(endpoint: str) -> bool:
    """Whether only this machine reaches an endpoint."""
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
    """Who connects takes everything from these, and nothing from anybody else."""
    messages = ["put", "delete", "query", "reply", "declare_subscriber", "declare_queryable"]
    liveliness = ["liveliness_token", "liveliness_query", "declare_liveliness_subscriber"]
    rule = {
        "id": "all", "permission": "allow", "flows": ["ingress", "egress"], "messages": messages + liveliness,
        "key_exprs": ["**"],
    }  # fmt: skip
    subjects = [{"id": "listener", "cert_common_names": names}]
    policies = [{"rules": ["all"], "subjects": ["listener"]}]
    return {
        "enabled": True, "default_permission": "deny", "rules": [rule], "subjects": subjects, "policies": policies,
    }  # fmt: skip


def _access_control(mine: Identity, name_of_flow: Flow, revoked: Set[str]) -> dict[str, Any]:
    """What a listener allows each certificate to do in one flow; nothing else passes."""
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []

    def allow(who: str, names: list[str], rights: Rights) -> None:
        allowed = list(_rules(who, rights, name_of_flow, run))
        if not allowed or not names:
            return
        rules.extend(allowed)
        subjects.append({"id": who, "cert_common_names": names})
        policies.append({"rules": [rule["id"] for rule in allowed], "subjects": [who]})

    run = mine.run if mine.role == "learner" else "*"  # a server's clients know the policy by a name of its own
    for other, rights in RIGHTS.get(mine.role, {}).items():
        shared, own = _split(rights)
        peers = [Identity(mine.run, other, number) for number in range(NUMBERS)]
        peers = [peer for peer in peers if str(peer) not in revoked]
        allow(other, [str(peer) for peer in peers], shared)
        if own != Rights():
            for peer in peers:
                allow(str(peer), [str(peer)], _filled(own, numbered(peer.number, "$*")))
    return {
        "enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
    }  # fmt: skip


def _rules(who: str, rights: Rights, name: Flow, run: str) -> Iterator[dict[str, Any]]:
    """Zenoh's rules for one flow: what comes in, and what goes out in answer to it."""
    kinds = (
        (rights.ask, "query", "reply"),
        (rights.publish, "put", None),
        (rights.hear, "declare_subscriber", "put"),
        (rights.show, "liveliness_token", None),
    )
    for parts, comes, goes in kinds:
        keys = _of_flow(parts, name, run)
        for direction, message in (("ingress", comes), ("egress", goes)):
            if keys and message:
                yield {
                    "id": f"{who} {direction} {comes}",
                    "permission": "allow",
                    "flows": [direction],
                    "messages": [message],
                    "key_exprs": keys,
                }


def _of_flow(parts: Iterable[str], name: Flow, run: str = "*") -> list[str]:
    """The keys of a run, or of any, among these that belong to a flow."""
    keys = [f"{ROOT}/{run}/{part}" for part in parts]
    return [key for key in keys if flow(key) == name]


def _split(rights: Rights) -> tuple[Rights, Rights]:
    """The rights that all of a role share, and those that hold for own names."""
    parts = dataclasses.asdict(rights)
    return (
        Rights(**{kind: tuple(key for key in keys if "{name}" not in key) for kind, keys in parts.items()}),
        Rights(**{kind: tuple(key for key in keys if "{name}" in key) for kind, keys in parts.items()}),
    )


def _filled(rights: Rights, name: str) -> Rights:
    """The rights of one name, in place of `{name}`."""
    parts = dataclasses.asdict(rights)
    return Rights(**{kind: tuple(key.replace("{name}", name) for key in keys) for kind, keys in parts.items()})


def limits(name: Flow, *, rates: bool) -> dict[str, Any]:
    """Zenoh's configuration of the size of the messages that a listener takes in one flow, and of their rate."""
    both = {"flows": ["ingress"], "messages": ["query", "put"]}
    found = [(key, limit) for limit in LIMITS for key in _of_flow([limit.keys], name)]
    sizes = [{"id": key, **both, "key_exprs": [key], "size_limit": limit.size} for key, limit in found]
    often = [{"key_expr": key, "freq": limit.rate} for key, limit in found if limit.rate and rates]
    return {"low_pass_filter": sizes, "downsampling": [{"id": "rates", **both, "rules": often}] if often else []}
