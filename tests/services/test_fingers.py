"""Constraints beyond the paper's, requested of a policy that knows them and of one that does not, at every door."""

import dataclasses
import json
import pathlib

import numpy as np
import onnxruntime
import pytest
import trimesh

from congrasp.actors.attempts import PLAIN, Phases
from congrasp.common.errors import CongraspError, UnknownConstraintError
from congrasp.common.objects import procedural
from congrasp.common.policy.bundle import PolicyBundle
from congrasp.common.task import observation
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import PAPER
from congrasp.services.cli.main import load
from congrasp.services.evaluate.experiment import Experiment, Variation
from congrasp.services.export.motion_file import load_motion, save_motion
from congrasp.services.export.policy import describe, export_policy
from congrasp.services.grasp.files import RESULT
from congrasp.services.grasp.grasper import Grasper
from congrasp.services.grasp.parse import read_request
from congrasp.services.serve.inference import Inference, PolicyFunction
from congrasp.services.serve.load import Example
from congrasp.services.serve.requests import Layout
from congrasp.services.studio.grasping import PolicyGrasping
from congrasp.services.studio.page import describe as describe_request
from congrasp.services.studio.page import for_page, lanes
from congrasp.services.studio.state import Studio
from congrasp.services.train.command import untrained
from tests.exported_policies import difference
from tests.printed import errors
from tests.queries import packed
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
    request, state = example.request, example.state
    given = {f"heading_{name}": value for name, value in request.constraints["heading"].items()}
    given |= {"q_target": request.q, "q_initial": request.q, "u_target": np.zeros(6), "time": np.float32(0)}
    given |= {"base_position": request.wrist[0], "base_quaternion": request.wrist[1], "table": np.bool_(True)}
    given |= {f"{name}_initial": state[name] for name in ("object_position", "object_quaternion")}
    return {**given, **state, "surface_points": request.surface}


# A policy that does not know it.


@pytest.mark.parametrize(
    ("name", "option"),
    [("fingers", ["--fingers", "thumb", "index"]), ("force", ["--force", "3"]), ("force", ["--gentle"])],
)
def test_the_command_refuses_it_in_one_line(paper_policy, tmp_path, monkeypatch, capsys, quick_import, name, option):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    trimesh.creation.box((0.05, 0.06, 0.14)).export(tmp_path / "block.stl")
    options = ["--policy", str(paper_policy), "--out", str(tmp_path / "out"), "--no-pictures"]
    assert load("grasp")([str(tmp_path / "block.stl"), *options, *option])() == 2
    (line,) = errors(capsys.readouterr().err)
    assert line.startswith(
        f"congrasp: error: The policy does not support the constraint '{name}'. It supports heading, "
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
    assert studio.asked == set() and [row["name"] for row in describe_request(studio)["constraints"]] == list(PAPER)


def test_an_evaluation_of_it_is_refused_in_one_line() -> None:
    own = Experiment(untrained(dataclasses.replace(CONFIG, task=TaskConfig(constraints=PAPER))), [MUG], episodes=1)
    with pytest.raises(CongraspError, match=f"^The policy {REFUSED}"):
        own.run([Variation("fingers")])


# A policy that knows it.


def test_fingers_are_read_by_their_names() -> None:
    request = read_request(MUG, HAND, 15, fingers=("thumb", "index"))
    assert set(request.constraints) == {"heading", "fingers"}
    np.testing.assert_array_equal(request.given("fingers", "allowed"), PINCH)
    for written in ("thumb index", "thumb, index", "thumb,index", ["thumb", "index"]):
        request = read_request(MUG, HAND, 15, fingers=written)
        np.testing.assert_array_equal(request.given("fingers", "allowed"), PINCH)
    assert read_request(MUG, HAND, 15).given("fingers", "allowed") is None
    with pytest.raises(CongraspError, match=r"no finger 'toe'\. Known: thumb, index, middle, ring, "):
        read_request(MUG, HAND, 15, fingers=("thumb", "toe"))
    with pytest.raises(CongraspError, match=r"--fingers names only one finger.*Name two or more"):
        read_request(MUG, HAND, 15, fingers=("thumb",))


def test_a_grasp_with_two_fingers_and_a_force_limit(policy: PolicyBundle, tmp_path: pathlib.Path) -> None:
    grasper = Grasper(policy, attempts=2, rounds=1, phases=Phases(hold=0.25), threads=1)
    found = grasper.grasp(MUG, read_request(MUG, HAND, 15, fingers=("thumb", "index"), force="3"))
    grasper.close()
    assert found.motion.constraints == ("heading", "fingers", "force") and "fingers_ratio" in found.facts()
    assert 0.0 <= found.facts()["force_ratio"] <= 1.0
    save_motion(tmp_path / "grasp.npz", found.motion)
    goal = load_motion(tmp_path / "grasp.npz").goal
    np.testing.assert_array_equal(goal["fingers_allowed"], PINCH)
    assert goal["force_limit"] == 3.0
    assert "Only the named fingers may touch the object." in found.active
    assert "No link may press harder than the force limit." in found.active
    arrays = found.episode.arrays
    steps = len(arrays["table"])
    other = np.isin(HAND.link_fingers, (2, 3, 4))
    links = np.linalg.norm(arrays["contact_force"], axis=-1)
    np.testing.assert_array_equal(arrays["error/fingers_ratio"] > 0, ((links > 0) & other).any(-1))
    np.testing.assert_array_equal(arrays["error/force_ratio"] > 0, (links > 3.0).any(-1))
    assert arrays["active/fingers"] and not arrays["active/pose_finger"]
    assert lanes(found.episode)["fingers"].met.shape == (steps,)
    assert "lane/fingers/share" in for_page(found.episode).arrays


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
    shapes = Layout(HAND, TASK).shapes
    assert (shapes["fingers_allowed"], shapes["force_limit"], shapes["asked"]) == ((5,), (), (6,))
    pinch = ask(["heading", "fingers"], fingers_allowed=PINCH)
    assert pinch.active == [["Only the named fingers may touch the object.", "The heading guides the wrist."]]
    free, ignored = ask(["heading"]), ask(["heading"], fingers_allowed=PINCH)
    np.testing.assert_array_equal(free.vectors, ignored.vectors)
    assert np.abs(pinch.vectors - free.vectors).max() > 1e-6
    assert "needs the thumb and another finger. Allow both" in str(
        ask(["heading", "fingers"], fingers_allowed=0 * PINCH)
    )
    with pytest.raises(CongraspError, match="lacks the field 'fingers_allowed'"):
        ask(["heading", "fingers"])
    with pytest.raises(CongraspError, match="no constraint that guides the wrist"):
        ask(["fingers"], fingers_allowed=PINCH)


def test_queries_for_a_force_limit_are_answered_and_checked(ask) -> None:
    soft, firm = (ask(["heading", "force"], force_limit=np.float32(limit)) for limit in (2.0, 15.0))
    assert np.abs(soft.vectors - firm.vectors).max() > 1e-6
    assert "takes a limit between 0.5 and 50 N" in str(ask(["heading", "force"], force_limit=np.float32(0.0)))
    with pytest.raises(CongraspError, match="lacks the field 'force_limit'"):
        ask(["heading", "force"])


def test_the_studio_has_its_toggles(policy: PolicyBundle) -> None:
    studio = Studio(HAND, TASK, MUG)
    flags = dict(zip(HAND.fingers, PINCH.tolist(), strict=True))
    shown = {"name": "fingers", "title": "fingers", "tool": "", "flags": {"allowed": flags}}
    assert describe_request(studio)["constraints"][4] == shown
    studio.ask("fingers", True)
    assert describe_request(studio)["active"]["masks"]["fingers"] and studio.trouble == ""
    np.testing.assert_array_equal(studio.request.given("fingers", "allowed"), PINCH)
    studio.choose("fingers", "allowed", [True, True, True, False, False])
    assert json.loads(json.dumps(describe_request(studio)))["constraints"][4]["flags"]["allowed"]["middle"]
    np.testing.assert_array_equal(studio.request.given("fingers", "allowed"), [1, 1, 1, 0, 0])
    studio.choose("fingers", "allowed", [True, False, False, False, False])
    assert studio.trouble == "The constraint 'fingers' needs the thumb and another finger. Allow both."
    for values in ([True], "thumb"):
        with pytest.raises(CongraspError, match="'fingers' takes 5 flags"):
            studio.choose("fingers", "allowed", values)
    with pytest.raises(CongraspError, match="nothing to choose for 'pose'"):
        studio.choose("pose", "q", [])


@pytest.mark.slow
def test_the_studio_grasps_with_it(policy: PolicyBundle) -> None:
    task = dataclasses.replace(TASK, approach_steps=4, hold_steps=2, hold_steps_max=2)
    grasping = PolicyGrasping(lambda version: dataclasses.replace(policy, task=task), "untrained", threads=1)
    studio = Studio(grasping.hand, grasping.task, MUG)
    studio.ask("fingers", True)
    episode = grasping.grasp(studio.labelled, studio.request, PLAIN, lambda text, share: None)
    assert episode.arrays["active/fingers"] and "fingers_ratio" in episode.meta["metrics"]
    np.testing.assert_array_equal(episode.arrays["goal/fingers_allowed"], PINCH)
    # An untrained policy holds nothing, with the constraint or without it.
    assert episode.meta["note"].startswith("None of 8 attempts held. The one shown: ")
    assert episode.meta["note"].endswith("Only the named fingers may touch the object. Try another heading.")


def test_its_block_is_described_in_the_exported_policy(policy: PolicyBundle, tmp_path: pathlib.Path) -> None:
    export_policy(policy, "onnx", tmp_path / "policy.onnx")
    assert difference(policy, tmp_path / "policy.onnx") <= 1e-5
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    meta = {name: json.loads(text) for name, text in session.get_modelmeta().custom_metadata_map.items()}
    block = [(field["field"], field["size"]) for field in meta["observation"] if field["block"] == "fingers"]
    assert block == [("fingers_allowed", 5), ("fingers_room", 5), ("force_other", 3 * len(HAND.links))]
    assert dict(meta["layout"])["fingers"] == sum(size for _, size in block)
    assert (
        meta["masks"]
        == ["affordance", "pose_finger", "pose_wrist", "trajectory", "fingers", "force_limit"]
        == describe(policy)["masks"]
    )
    assert sum(size for _, size in meta["layout"]) == sum(size for _, size in observation.layout(HAND, TASK))


def test_the_studio_has_a_box_for_a_force_limit() -> None:
    studio = Studio(HAND, TASK, MUG)
    studio.ask("force", True)
    assert {"name": "force", "title": "force limit", "tool": "", "flags": {}} in json.loads(
        json.dumps(describe_request(studio)["constraints"])
    )
    assert studio.request.given("force", "limit") == 5.0 and studio.trouble == ""
    with pytest.raises(CongraspError, match="nothing to choose for 'force'"):
        studio.choose("force", "limit", [True])
