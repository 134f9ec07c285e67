"""A force limit, requested of policies that know it and of one that does not."""

import json
import pathlib

import numpy as np
import pytest
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.task.constraints import OURS, PAPER
from congrasp.common.wire.codec import Message
from congrasp.services.cli.main import load
from congrasp.services.export.policy import describe
from congrasp.services.serve.inference import Inference, PolicyFunction
from congrasp.services.studio import description
from congrasp.services.studio.state import Studio
from tests.printed import errors
from tests.services.test_fingers import query
from tests.task import HAND, TASK
from tests.task import policy as make_policy

__all__ = ["query"]
MUG = procedural.generate(1, "mug")


@pytest.fixture(scope="module")
def policy() -> PolicyBundle:
    return make_policy()


@pytest.mark.parametrize("option", [["--force", "3"], ["--gentle"]])
def test_a_policy_that_does_not_know_it_says_so(paper_policy, tmp_path: pathlib.Path, monkeypatch, capsys, option):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    trimesh.creation.box((0.05, 0.06, 0.14)).export(tmp_path / "block.stl")
    options = ["--policy", str(paper_policy), "--out", str(tmp_path / "out"), "--no-pictures", *option]
    assert load("grasp")([str(tmp_path / "block.stl"), *options])() == 2
    (line,) = errors(capsys.readouterr().err)
    assert line.startswith("congrasp: error: The policy does not support the constraint 'force'. It supports heading, ")


def test_queries_for_it_are_answered_and_checked(policy: PolicyBundle, query: dict[str, np.ndarray]) -> None:
    function = PolicyFunction(HAND, TASK)
    layout = function.layout
    assert layout.shapes["force_limit"] == ()

    def ask(constraints: list[str], **more: np.ndarray) -> Inference | Exception:
        queries = [layout.parse(Message({**query, **more}, {"constraints": constraints}))]
        (answer,) = function(policy.inference_parameters, queries)
        return answer

    soft, firm = (ask(["heading", "force"], force_limit=np.float32(limit)) for limit in (2.0, 15.0))
    assert isinstance(soft, Inference) and isinstance(firm, Inference)
    assert np.abs(soft.vectors - firm.vectors).max() > 1e-6
    assert "takes a limit between 0.5 and 50 N" in str(ask(["heading", "force"], force_limit=np.float32(0.0)))
    with pytest.raises(CongraspError, match="lacks the field 'force_limit'"):
        ask(["heading", "force"])


def test_the_studio_has_a_box_for_it() -> None:
    studio = Studio(HAND, TASK, MUG)
    studio.ask("force", True)
    assert {"name": "force", "title": "force limit", "flags": {}} in json.loads(
        json.dumps(description.describe(studio)["others"])
    )
    assert studio.request.given("force", "limit") == 5.0 and studio.trouble == ""
    with pytest.raises(CongraspError, match="nothing to choose for 'force'"):
        studio.choose("force", "limit", [True])


def test_the_exported_policy_describes_it(policy: PolicyBundle) -> None:
    assert describe(policy)["masks"][-1] == "force_limit" and OURS[:4] == PAPER
