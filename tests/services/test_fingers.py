"""Constraints beyond the paper's, requested of a policy that knows them and of one that does not,
at every door.
"""

import dataclasses
import pathlib

import numpy as np
import pytest
import trimesh

from congrasp.actors.attempts import Phases
from congrasp.common.episode.motion_file import load_motion, save_motion
from congrasp.common.errors import CongraspError, UnknownConstraintError
from congrasp.common.objects import procedural
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import PAPER
from congrasp.services.cli.main import load
from congrasp.services.evaluate.experiment import Experiment, Variation
from congrasp.services.grasp.files import RESULT
from congrasp.services.grasp.grasper import Grasper
from congrasp.services.grasp.parse import read_request
from congrasp.services.serve.inference import Inference, PolicyFunction
from congrasp.services.serve.load import Example
from congrasp.services.serve.requests import Layout
from congrasp.services.studio.page import describe as describe_request
from congrasp.services.studio.page import for_page, lanes
from congrasp.services.studio.state import Studio
from congrasp.services.train.command import untrained
from tests.printed import errors
from tests.queries import packed
from tests.short_grasps import short_pushes
from tests.task import CONFIG, HAND, TASK
from tests.task import policy as make_policy

MUG = procedural.generate(1, "mug")
PINCH = np.array([True, True, False, False, False])
REFUSED = (
    r"does not support the constraint 'fingers'\. It supports heading, affordance, pose, trajectory; train one with "
    r"--task\.constraints … fingers\.$"
)


@pytest.fixture(scope="module")
def policy() -> PolicyBundle:
    return make_policy()


@pytest.fixture(scope="module")
def query(example: Example) -> dict[str, np.ndarray]:
    """The arrays of a query with the heading, from the start of an episode."""
    request = example.request
    state = example.state
    arrays = {f"heading_{name}": value for name, value in request.constraints["heading"].items()}
    arrays |= {
        "q_target": request.q,
        "q_initial": request.q,
        "u_target": np.zeros(6),
        "time": np.float32(0),
    }
    arrays |= {
        "base_position": request.wrist[0],
        "base_quaternion": request.wrist[1],
        "table": np.bool_(True),
    }
    arrays |= {f"{name}_initial": state[name] for name in ("object_position", "object_quaternion")}
    return {**arrays, **state, "surface_points": request.surface}


# A policy that does not know it.


@pytest.mark.parametrize(
    ("name", "option"), [("fingers", ["--fingers", "thumb", "index"]), ("force", ["--gentle"])]
)
def test_the_command_refuses_it_in_one_line(
    paper_policy, tmp_path, monkeypatch, capsys, quick_import, name, option
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    trimesh.creation.box((0.05, 0.06, 0.14)).export(tmp_path / "block.stl")
    options = ["--policy", str(paper_policy), "--out", str(tmp_path / "out"), "--no-pictures"]
    assert load("grasp")([str(tmp_path / "block.stl"), *options, *option])() == 2
    (line,) = errors(capsys.readouterr().err)
    assert line.startswith(
        f"congrasp: error: The policy does not support the constraint '{name}'. It supports "
        f"heading, "
    )
    assert not (tmp_path / "out" / "block" / RESULT).exists()


def test_a_query_for_it_is_refused_in_one_line(query: dict[str, np.ndarray]) -> None:
    layout = Layout(HAND, TaskConfig(constraints=PAPER))
    message = packed(layout, {**query, "fingers_allowed": PINCH}, ["heading", "fingers"])
    with pytest.raises(UnknownConstraintError, match=f"^The policy {REFUSED}"):
        layout.parse(message)


def test_the_studio_refuses_it_in_one_line() -> None:
    studio = Studio(HAND, TaskConfig(constraints=PAPER), MUG)
    with pytest.raises(CongraspError, match=f"^The policy {REFUSED}"):
        studio.ask("fingers", True)
    with pytest.raises(CongraspError, match=f"^The policy {REFUSED}"):
        studio.choose("fingers", "allowed", PINCH.tolist())
    assert studio.asked == set()
    assert [row["name"] for row in describe_request(studio)["constraints"]] == list(PAPER)


def test_an_evaluation_of_it_is_refused_in_one_line() -> None:
    experiment = Experiment(
        untrained(dataclasses.replace(CONFIG, task=TaskConfig(constraints=PAPER))),
        [MUG],
        episodes=1,
    )
    with pytest.raises(CongraspError, match=f"^The policy {REFUSED}"):
        experiment.run([Variation("fingers")])


# A policy that knows it.


def test_a_grasp_with_two_fingers_and_a_force_limit(
    policy: PolicyBundle, tmp_path: pathlib.Path
) -> None:
    grasper = Grasper(policy, attempts=2, rounds=1, phases=Phases(hold=0.25), threads=1)
    request = read_request(MUG, HAND, 15, fingers=("thumb", "index"), force="3")
    with short_pushes():
        grasp = grasper.grasp(MUG, request)
    grasper.close()
    assert grasp.motion.constraints == ("heading", "fingers", "force")
    assert "fingers_ratio" in grasp.facts()
    assert 0.0 <= grasp.facts()["force_ratio"] <= 1.0
    save_motion(tmp_path / "grasp.npz", grasp.motion)
    goal = load_motion(tmp_path / "grasp.npz").goal
    np.testing.assert_array_equal(goal["fingers_allowed"], PINCH)
    assert goal["force_limit"] == 3.0
    assert "Only the named fingers may touch the object." in grasp.active
    assert "No link may press harder than the force limit." in grasp.active
    recorded = grasp.episode
    errors = recorded.require_recorded().errors
    steps = recorded.steps
    other = np.isin(HAND.link_fingers, (2, 3, 4))
    links = np.linalg.norm(recorded.link_force, axis=-1)
    np.testing.assert_array_equal(errors["fingers_ratio"] > 0, ((links > 0) & other).any(-1))
    np.testing.assert_array_equal(errors["force_ratio"] > 0, (links > 3.0).any(-1))
    assert recorded.active["fingers"]
    assert not recorded.active["pose_finger"]
    assert lanes(grasp.episode)["fingers"].met.shape == (steps,)
    assert "lane/fingers/share" in for_page(grasp.episode).arrays


@pytest.fixture
def ask(policy, query):
    """Asks the policy under constraints; its inference or its error."""
    function = PolicyFunction(HAND, TASK)

    def ask(constraints: list[str], **more: np.ndarray) -> Inference | Exception:
        queries = [function.layout.parse(packed(function.layout, {**query, **more}, constraints))]
        (answer,) = function(policy.inference_parameters, queries)
        return answer

    return ask


def test_queries_for_it_are_answered_and_checked(ask) -> None:
    pinch = ask(["heading", "fingers"], fingers_allowed=PINCH)
    assert pinch.active == [
        ["Only the named fingers may touch the object.", "The heading guides the wrist."]
    ]
    free = ask(["heading"])
    ignored = ask(["heading"], fingers_allowed=PINCH)
    np.testing.assert_array_equal(free.vectors, ignored.vectors)
    soft, firm = (ask(["heading", "force"], force_limit=np.float32(limit)) for limit in (2.0, 15.0))
    for one, other in ((pinch, free), (soft, firm)):
        assert np.abs(one.vectors - other.vectors).max() > 1e-6
    refused = (
        ask(["heading", "fingers"], fingers_allowed=0 * PINCH),
        ask(["heading", "force"], force_limit=np.zeros(())),
    )
    assert "needs the thumb and another finger. Allow both" in str(refused[0])
    assert "takes a limit between 0.5 and 50 N" in str(refused[1])
    for name, field in (("fingers", "fingers_allowed"), ("force", "force_limit")):
        with pytest.raises(CongraspError, match=f"lacks the field '{field}'"):
            ask(["heading", name])
    with pytest.raises(CongraspError, match="no constraint that guides the wrist"):
        ask(["fingers"], fingers_allowed=PINCH)


def test_the_studio_requests_only_allowed_fingers() -> None:
    studio = Studio(HAND, TASK, MUG)
    studio.ask("fingers", True)
    assert describe_request(studio)["active"]["masks"]["fingers"]
    assert studio.trouble == ""
    np.testing.assert_array_equal(studio.request.given("fingers", "allowed"), PINCH)
    studio.choose("fingers", "allowed", [True, False, False, False, False])
    assert (
        studio.trouble == "The constraint 'fingers' needs the thumb and another finger. Allow both."
    )
    for values in ([True], "thumb"):
        with pytest.raises(CongraspError, match="'fingers' takes 5 flags"):
            studio.choose("fingers", "allowed", values)
    studio = Studio(HAND, TASK, MUG)
    studio.ask("force", True)
    assert studio.request.given("force", "limit") == 5.0
    assert studio.trouble == ""
    for name, field in (("pose", "q"), ("force", "limit")):
        with pytest.raises(CongraspError, match=f"nothing to choose for '{name}'"):
            studio.choose(name, field, [True])
