"""`congrasp status` against a live learner's end."""

import json

import numpy as np
import pytest

from common.errors import TransportError
from common.transport.keys import Keys
from common.transport.zenoh_transport import ZenohTransport
from common.wire.messages import RolloutForm
from learner.hub import LearnerHub
from learner.staleness import StalenessManager
from services.cli.status import status
from services.train import free_port
from tests.rollouts import ACTION, OBSERVATION, SCHEMA, bundle, rollout


@pytest.fixture
def endpoint():
    """A run with one actor, which has sent one rollout."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ZenohTransport(listen=[endpoint]) as server:
        hub = LearnerHub(
            server,
            run="r",
            config_json="{}",
            epoch="e",
            schema=SCHEMA,
            form=RolloutForm(4, 2, OBSERVATION, ACTION, half=True),
            staleness=StalenessManager(1, 2),
        )
        weights = {"observation/mean": np.zeros(OBSERVATION), "observation/m2": np.zeros(OBSERVATION)}
        weights |= dict.fromkeys(("observation/count", "value/mean", "value/m2", "value/count"), np.zeros(()))
        message = bundle(0)
        hub.publish_weights(type(message)({**message.arrays, **weights}, message.meta), 0)
        with ZenohTransport(connect=[endpoint]) as actor:
            actor.declare_alive(Keys("r").alive("actor", "worker-7", "1f"))
            sent = rollout(actor="worker-7", incarnation="1f")
            assert actor.query(Keys("r").rollout, sent, timeout=5.0).meta["outcome"] == "accepted"
            yield endpoint


@pytest.mark.timeout(30)
def test_status_shows_who_works_and_what_came_in(endpoint, capsys):
    assert status(endpoint, "r", json=True) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["run"], found["version"], found["ledger"]["accepted"]) == ("r", 0, 1)
    assert {(role["role"], role["id"]) for role in found["roles"]} == {("learner", "0"), ("actor", "worker-7")}
    assert status(endpoint, "r") == 0
    text = capsys.readouterr().out
    assert "worker-7" in text and "accepted" in text and "1 rollout(s) waiting" in text


@pytest.mark.timeout(30)
def test_a_run_that_is_not_there_is_an_error_in_words(endpoint):
    with pytest.raises(TransportError, match="other"):
        status(endpoint, "other")
