"""The authority and its certificates, as files and as OpenSSL sees them."""

import datetime
import errno
import pathlib
import shutil
import stat
import subprocess

import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.transport.certificates import find, read
from congrasp.common.transport.security import (
    NUMBERS,
    Credentials,
    check_exposure,
    parse_identity,
    secured,
)
from congrasp.services.ops.certificates import certificates, create_authority, issue, revoke


@pytest.fixture
def folder(tmp_path):
    create_authority(tmp_path / "certs", run="human")
    return tmp_path / "certs"


def test_a_certificate_contains_run_role_number_hosts_and_expiry(folder):
    certificate = read(
        issue(folder, "learner", hosts=["10.0.0.5", "gpu.example", "10.0.0.5"], days=30) / "tls.crt"
    )
    assert certificate.name == "human.learner.0"
    assert certificate.identity == ("human", "learner", 0)
    assert certificate.hosts == ("localhost", "127.0.0.1", "10.0.0.5", "gpu.example")
    assert certificate.expires.utcoffset() == datetime.timedelta(0)
    assert 29.99 < certificate.days <= 30
    assert read(issue(folder, "learner") / "tls.crt").name == "human.learner.1"
    other = issue(folder, "learner", run="a.b-c")
    assert (
        read(other / "tls.crt").identity
        == Credentials(other, "learner").identity
        == ("a.b-c", "learner", 2)
    )
    assert (
        read(issue(folder, "actor", days=7000) / "tls.crt").expires
        <= read(folder / "ca.crt").expires
    )
    assert [one.name for one in certificates(folder)] == [
        "ca",
        "a.b-c.learner.2",
        "human.actor.0",
        "human.learner.0",
        "human.learner.1",
    ]


@pytest.mark.skipif(shutil.which("openssl") is None, reason="the command openssl is not here")
def test_openssl_accepts_listeners_only(folder, tmp_path):
    create_authority(tmp_path / "other")

    def verify(ca, certificate, purpose):
        command = [
            "openssl",
            "verify",
            "-x509_strict",
            "-purpose",
            purpose,
            "-CAfile",
            ca,
            certificate,
        ]
        return subprocess.run(command, capture_output=True, check=False, timeout=20).returncode == 0

    learner = issue(folder, "learner") / "tls.crt"
    actor = issue(folder, "actor") / "tls.crt"
    ca = folder / "ca.crt"
    assert verify(ca, learner, "sslserver")
    assert verify(ca, learner, "sslclient")
    assert verify(ca, actor, "sslclient")
    assert not verify(ca, actor, "sslserver")
    assert not verify(tmp_path / "other" / "ca.crt", actor, "sslclient")


def test_keys_are_secret_and_nothing_is_overwritten_unasked(folder):
    certificate = issue(folder, "actor")
    for key in (folder / "ca.key", certificate / "tls.key"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(CongraspError, match=r"already contains a certificate authority.*--force"):
        create_authority(folder)
    with pytest.raises(CongraspError, match=r"exists already.*--force"):
        issue(folder, "actor", number=0)
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    issue(folder, "actor", number=0, force=True)
    assert (certificate / "tls.key").read_bytes() != before[certificate / "tls.key"]
    create_authority(folder, force=True)
    assert (folder / "ca.key").read_bytes() != before[folder / "ca.key"]


@pytest.mark.parametrize(
    ("role", "options", "words"),
    [
        ("boss", {}, "no role 'boss'"),
        ("actor", {"hosts": ["gpu"]}, "cannot name hosts"),
        ("server", {"hosts": ["a b"]}, "neither a host name nor an address"),
        ("server", {"hosts": [""]}, "neither a host name nor an address"),
        ("server", {"hosts": ["../x"]}, "neither a host name nor an address"),
        ("actor", {"number": NUMBERS}, "0 to 255"),
        ("actor", {"number": -1}, "0 to 255"),
        ("actor", {"run": "a/b"}, "cannot be the name of a run"),
        ("actor", {"run": "x" * 60}, "longer than 64"),
        ("actor", {"days": 1e9}, "days"),
        ("actor", {"days": float("nan")}, "days"),
    ],
)
def test_invalid_certificate_requests_are_refused(folder, role, options, words):
    with pytest.raises(CongraspError, match=words):
        issue(folder, role, **options)
    assert [one.name for one in certificates(folder)] == ["ca"]


def test_certificate_is_kept_if_its_successor_cannot_be_written(tmp_path, monkeypatch):
    create_authority(tmp_path)
    before = (issue(tmp_path, "actor") / "tls.crt").read_bytes()

    def fail(*arguments):
        raise OSError(errno.ENOSPC, "no space left on device")

    with monkeypatch.context() as full_disk, pytest.raises(OSError):
        full_disk.setattr(pathlib.Path, "write_bytes", fail)
        issue(tmp_path, "actor", number=0, force=True)
    assert (tmp_path / "actor.0" / "tls.crt").read_bytes() == before
    issue(tmp_path, "actor", number=0, force=True)
    assert (tmp_path / "actor.0" / "tls.crt").read_bytes() != before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["actor.0", "ca.crt", "ca.key"]


def test_credentials_are_checked_before_they_are_used(folder, tmp_path):
    issue(folder, "actor")
    other = issue(folder, "actor")
    assert find(folder, "actor") == Credentials(folder / "actor.0", "actor")
    assert find(other, "actor").identity.number == 1
    with pytest.raises(CongraspError, match=r"has the role actor, not learner.*--role learner"):
        find(other, "learner")
    with pytest.raises(CongraspError, match="missing"):
        find(folder, "client")
    with pytest.raises(CongraspError, match=r"expired on .* UTC"):
        find(issue(folder, "actor", number=7, days=-1), "actor")
    (other / "tls.key").write_bytes((folder / "actor.0" / "tls.key").read_bytes())
    with pytest.raises(CongraspError, match="is not the key of"):
        find(other, "actor")
    (other / "tls.crt").write_text("nonsense")
    with pytest.raises(CongraspError, match="is not a certificate"):
        find(other, "actor")
    (other / "tls.crt").write_bytes((folder / "ca.crt").read_bytes())
    with pytest.raises(CongraspError, match="has the role ca"):
        find(other, "actor")


@pytest.mark.parametrize(
    "name", ["", "actor.0", ".actor.0", "r.boss.0", "r.actor.256", "r.actor.-1", "r.actor.x"]
)
def test_a_common_name_that_is_none_of_ours_is_nobodys(name):
    assert parse_identity(name) is None
    assert parse_identity("r.s.actor.255") == ("r.s", "actor", 255)


def test_revoked_certificates_are_listed_and_not_reissued(folder):
    learner = issue(folder, "learner")
    actor = issue(folder, "actor")
    assert revoke(folder, "actor", 0) == "human.actor.0"
    assert revoke(folder, "actor", 3) == "human.actor.3"
    assert Credentials(learner, "learner").revoked() == {"human.actor.0", "human.actor.3"}
    assert Credentials(actor, "actor").revoked() == {"human.actor.0", "human.actor.3"}
    assert Credentials(issue(folder, "server"), "server").revoked() == {
        "human.actor.0",
        "human.actor.3",
    }
    with pytest.raises(CongraspError, match="is revoked"):
        issue(folder, "actor", number=0, force=True)
    assert [issue(folder, "actor").name for _ in range(3)] == ["actor.1", "actor.2", "actor.4"]
    assert issue(folder, "actor", number=3, run="other").name == "actor.3"
    (learner / "revoked").write_bytes(b"\xff\xfe")
    with pytest.raises(CongraspError, match="cannot be read"):
        Credentials(learner, "learner").revoked()
    create_authority(folder, force=True)
    assert Credentials(folder, "learner").revoked() == set()


def test_with_credentials_every_endpoint_is_tls(tmp_path):
    some = Credentials(tmp_path, "actor")
    assert (
        secured("tcp/10.0.0.5:7447", some)
        == secured("tls/10.0.0.5:7447", some)
        == "tls/10.0.0.5:7447"
    )
    assert secured("tcp/10.0.0.5:7447", None) == "tcp/10.0.0.5:7447"
    with pytest.raises(CongraspError, match="cannot be used with certificates"):
        secured("udp/10.0.0.5:7447", some)
    with pytest.raises(CongraspError, match="needs certificates"):
        secured("tls/10.0.0.5:7447", None)


@pytest.mark.parametrize(
    ("endpoint", "inside"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/localhost:7447", True),
        ("tcp/[::1]:7447", True),
        ("tcp/127.8.9.1:7447", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/10.0.0.5:7447", False),
        ("tcp/localhost.example:7447", False),
        ("udp/0.0.0.0:7447", False),
        ("nonsense", False),
    ],
)
def test_without_certificates_only_loopback_is_listened_on(endpoint, inside, tmp_path):
    check_exposure(endpoint, Credentials(tmp_path, "learner"), insecure=False)
    check_exposure(endpoint, None, insecure=True)
    if inside:
        check_exposure(endpoint, None, insecure=False)
    else:
        with pytest.raises(CongraspError, match="--certs"):
            check_exposure(endpoint, None, insecure=False)
