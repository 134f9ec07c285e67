"""From the options of a command to the credentials of its role."""

import pytest

from common.errors import CongraspError
from common.transport.security import Credentials
from services.ops.access import acting, check_training, credentials, listening, nearby
from services.ops.certificates import create_authority, issue


@pytest.fixture
def certs(tmp_path):
    create_authority(tmp_path)
    for role in ("learner", "actor", "actor", "observer"):
        issue(tmp_path, role)
    return tmp_path


def test_each_role_gets_its_own(certs):
    assert credentials(None, "client") is None
    assert credentials(certs, "observer") == Credentials(certs / "observer.0", "observer")
    assert listening("tls/0.0.0.0:7447", certs, "learner", insecure=False) == Credentials(
        certs / "learner.0", "learner"
    )
    assert listening("tcp/127.0.0.1:7447", None, "learner", insecure=False) is None
    assert acting(None, "gpu-1") == (None, "gpu-1")
    assert acting(certs / "actor.1", "gpu-1") == (Credentials(certs / "actor.1", "actor"), "1.gpu-1")
    with pytest.raises(CongraspError, match="other machines"):
        listening("tcp/0.0.0.0:7447", None, "server", insecure=False)


def test_training_has_all_it_needs_before_it_starts(certs):
    check_training("tls/0.0.0.0:7447", certs, insecure=False)
    check_training("tcp/0.0.0.0:7447", None, insecure=True)
    with pytest.raises(CongraspError, match="belongs to one role"):
        check_training("tls/0.0.0.0:7447", certs / "learner.0", insecure=False)
    (certs / "observer.0" / "tls.key").unlink()
    with pytest.raises(CongraspError, match=r"observer.0/tls.key is missing.*--role observer"):
        check_training("tls/0.0.0.0:7447", certs, insecure=False)


def test_what_listens_everywhere_is_reached_nearby():
    assert nearby("tls/0.0.0.0:7447") == nearby("tls/[::]:7447") == "tls/127.0.0.1:7447"
    assert nearby("tls/10.0.0.5:7447") == "tls/10.0.0.5:7447"
