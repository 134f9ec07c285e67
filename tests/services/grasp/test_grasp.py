"""Grasps of custom objects: a real one by the pretrained policy, and the command with fake ones."""

import dataclasses
import json
import pathlib

import numpy as np
import pytest
import trimesh
from PIL import Image

from congrasp.actors import attempts
from congrasp.actors.attempts import Outcome, Phases
from congrasp.actors.physics.engine import ResetState
from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.rollout import Trace
from congrasp.actors.stress import ASSESSED_NAMES, SURVIVAL_NAMES
from congrasp.common import mirror
from congrasp.common.episode.motion_file import load_motion
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.common.objects.resting import upright_rest
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import policy_file
from congrasp.common.request import GraspRequest
from congrasp.common.rotations import rotate
from congrasp.services.assets.objects.named import one_object
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.cli.main import load
from congrasp.services.grasp.costs import costs, rest_ranks
from congrasp.services.grasp.files import (
    MOTION,
    OBJECT,
    PICTURE,
    PORTRAIT,
    RECORDING,
    RESULT,
    save_grasp,
)
from congrasp.services.grasp.grasper import Grasper, limiting_cause
from congrasp.services.grasp.keys import identity_of_text
from congrasp.services.grasp.motion import Grasp
from congrasp.services.grasp.parse import read_request
from congrasp.services.grasp.result import Result
from congrasp.services.record.reader import read_episodes
from tests.episodes import episode
from tests.services.conftest import quick_imports
from tests.short_grasps import short_pushes

SIDES = (0.05, 0.06, 0.14)


@pytest.fixture(scope="module", autouse=True)
def _short_pushes():
    """No test depends on the pushes after the hold, which take most of an attempt."""
    with short_pushes():
        yield


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mesh")
    trimesh.creation.box(SIDES).export(folder / "block.stl")
    with quick_imports():
        return one_object(folder / "block.stl", ImportOptions(cache_dir=str(folder)))


@pytest.fixture(scope="module")
def grasper():
    grasper = Grasper(
        bundles.load(policy_file(None)), attempts=4, phases=Phases(hold=0.25), threads=2
    )
    yield grasper
    grasper.close()


def test_an_unreliable_shape_does_not_count_as_held():
    held = {"success": True, "shape_reliable": True}
    assert Result("mug", held).held
    assert not Result("mug", held | {"shape_reliable": False}).held
    assert not Result("mug", held | {"success": False}).held


def test_the_pretrained_policy_grasps_a_block(block, grasper):
    reports = []
    minus = block.points[:, 2] < 0
    heading = {"direction": np.array([0.0, 0.0, -1.0])}
    request = GraspRequest({"heading": heading, "affordance": {}}, avoid=minus)
    grasp = grasper.grasp(
        block, request, lambda what, done, total: reports.append((what, done, total))
    )
    steps = grasper.task.approach_steps + 25
    assert reports[0][0].startswith("Compiling")
    counts = [report[1:] for report in reports if report[0] == "Attempting"]
    simulated = counts[0][1]
    assert simulated > steps
    assert counts == [(step + 1, simulated) for step in range(simulated)]
    assert 1 <= grasp.held <= grasp.attempts <= 12
    assert grasp.success
    motion = grasp.motion
    assert motion.constraints == ("heading", "affordance")
    assert motion.about["attempts"] == grasp.attempts
    assert len(motion.time) == steps
    assert motion.table.sum() == steps - 26  # gone with its last step
    np.testing.assert_allclose(motion.goal["heading_direction"], [0, 0, -1], atol=1e-6)
    np.testing.assert_array_equal(motion.surface_avoid, minus[:256])
    # The hand approached along the block's z axis: the wrist moved mostly in that direction.
    way = motion.wrist_position[48] - motion.wrist_position[0]
    axis = np.asarray(rotate(motion.object_quaternion[0], np.array([0.0, 0.0, -1.0])))
    assert way @ axis > 0.8 * np.linalg.norm(way) > 0.05
    # The held block keeps its height although there is no table.
    assert abs(motion.object_position[-1, 2] - motion.object_position[49, 2]) < 0.05
    facts = grasp.facts()
    assert facts["heading_rad"] < 0.5
    assert {"heading_m", "affordance_ratio", "force_link_max"} <= facts.keys()

    again = grasper.grasp(block, request).motion
    np.testing.assert_array_equal(again.joint_position, motion.joint_position)


def test_a_left_hand_moves_as_the_mirrored_right_one(block, grasper, monkeypatch):
    begun = []
    conditions_of = attempts.conditions_of

    def recorded(*arguments):
        begun.append(conditions_of(*arguments))
        return begun[-1]

    monkeypatch.setattr(attempts, "conditions_of", recorded)
    monkeypatch.setattr(grasper, "left", True)
    monkeypatch.setattr(grasper, "hand", get_hand("human:left"))
    grasp = grasper.grasp(
        block, GraspRequest({"heading": {"direction": np.array([0.0, 0.6, -0.8])}})
    )
    arrays = grasp.episode.to_message().arrays
    assert grasp.motion.hand == "human_left"
    assert grasp.success
    np.testing.assert_allclose(grasp.motion.goal["heading_direction"], [0, 0.6, -0.8], atol=1e-6)
    np.testing.assert_allclose(grasp.motion.object_vertices, block.visual_vertices, atol=1e-6)
    start = mirror.fields(
        {name: np.asarray(x) for name, x in begun[-1][0].reset_state._asdict().items()}
    )
    chosen = np.linalg.norm(
        start["base_position"] - arrays["link_position"][0, 0], axis=-1
    ).argmin()
    physics = NativePhysics(get_hand("human:left"), grasper.task, [block], 1)
    physics.start(ResetState(**{name: x[[chosen]] for name, x in start.items()}))
    for step, target in enumerate(np.concatenate([arrays["u_target"], arrays["q_target"]], -1)):
        _, state = physics.step(None, target[None], np.array([step < grasper.task.approach_steps]))
    physics.close()
    np.testing.assert_allclose(state.object_position[0], arrays["object_position"][-1], atol=0.01)
    np.testing.assert_allclose(state.q[0], arrays["q"][-1], atol=0.1)


def test_costs_of_attempts():
    """Costs of five attempts, computed by hand."""
    zeros = np.zeros(5)
    metrics = {name: zeros.copy() for name in ("moved_at_removal", *ASSESSED_NAMES)}
    metrics |= {
        "held": np.array([0.0, 1, 1, 1, 1]),
        "success": np.array([0.0, 1, 1, 1, 1]),
        "heading_rad": np.array([0.0, 0.0, 0.0, 0.1, 0.9]),  # one for 0.2 rad
        "heading_m": zeros,
        "force_link_max": np.array([0.0, 0.0, 10.0, 0.0, 0.0]),  # one for 10 N
        "pose_rad": np.full(5, 9.0),  # not requested
        "clean": np.array([0.0, 0, 0, 1, 1]),
        **dict.fromkeys(SURVIVAL_NAMES, np.array([0.0, 0, 1, 1, 1])),
    }
    trace = Trace(*(np.zeros((3, 5, 3)) for _ in Trace._fields))
    computed = costs(Outcome(None, zeros > 0, zeros == 0, metrics, trace), ("heading",), 1)  # type: ignore[arg-type]
    np.testing.assert_allclose(computed, [11004.0, 4.0, 2.0, 0.5, 4.5], rtol=1e-6)


def test_the_cause_of_failures_is_weight_or_width(block):
    """Attempts hold objects that are light or narrow enough; the cause is the limit that was
    exceeded.
    """

    def cause(request, may_be_held):
        return limiting_cause(block, request, lambda obj, _: np.full(4, may_be_held(obj)))

    free = GraspRequest()
    light = 0.3 * block.mass
    narrow = 0.8 * SIDES[0]
    assert cause(free, lambda obj: obj.mass < light) == (
        f"Its weight is the cause: with a quarter of its {1000 * block.mass:.0f} g 4 of 4 attempts "
        f"hold it."
    )
    assert cause(
        free, lambda obj: np.ptp(obj.points[:, 0]) < narrow and obj.mass == block.mass
    ) == ("Its width is the cause: with 70 % of its size 4 of 4 attempts hold it.")
    assert cause(free, lambda obj: False) == ""
    # In the frame of an object of this size
    placed = GraspRequest({"heading": {"position": np.zeros(3)}})
    assert cause(placed, lambda obj: np.ptp(obj.points[:, 0]) < narrow) == ""


def test_a_grasp_lifts_the_block_off_the_table(block):
    """In the simulation the hand rises, and the block with it; the table stays."""
    lifting = Grasper(
        bundles.load(policy_file(None)), attempts=4, phases=Phases(0.3, 0.1, 0.25), threads=2
    )
    upright = int(np.argmax(block.rest_poses[:, 2]))
    grasp = lifting.grasp(block, GraspRequest(rest=upright))
    lifting.close()
    motion = grasp.motion
    phases = grasp.facts()["phases"]
    assert list(phases) == ["approach", "grasp", "lift", "hold"]
    assert grasp.rest == upright
    seconds = lifting.task.approach_steps * lifting.task.control_dt
    assert phases["grasp"] >= 0.3
    assert phases["lift"] == pytest.approx(phases["grasp"] + seconds)
    assert motion.table.all()
    assert grasp.success
    grasped, lifted, held = (
        round(phases[name] / motion.control_dt) for name in ("grasp", "lift", "hold")
    )
    assert len(motion.time) == held + 25
    np.testing.assert_allclose(motion.object_position[:grasped, 2], SIDES[2] / 2, atol=2e-3)
    assert motion.object_position[-1, 2] - motion.object_position[lifted, 2] == pytest.approx(
        0.1, abs=0.02
    )
    assert (np.linalg.norm(motion.link_force[held:], axis=-1).sum(-1) > 0.5).all()
    assert (
        np.linalg.norm(np.diff(motion.wrist_position[lifted:held], axis=0), axis=-1).max()
        < 0.6 * motion.control_dt
    )


def test_impossible_requests(block, grasper):
    one_pose = dataclasses.replace(block, rest_poses=block.rest_poses[:1])
    down = -np.asarray(rotate(block.rest_poses[0][3:] * [1, -1, -1, -1], np.array([0.0, 0.0, 1.0])))
    words = " ".join(f"{x:.2f}" for x in np.round(down, 2) + 0.0)
    with pytest.raises(
        CongraspError, match=f'approach through the table.* straight down is --heading "{words}"'
    ):
        grasper.grasp(one_pose, GraspRequest({"heading": {"direction": -down}}))
    below = {"q": grasper.hand.q_open, "position": down, "quaternion": np.array([1.0, 0, 0, 0])}
    with pytest.raises(
        CongraspError, match="would be in the table in every resting pose of 'block'"
    ):
        grasper.grasp(one_pose, GraspRequest({"heading": {}, "pose": below}))


@pytest.fixture
def fake_grasps(monkeypatch, quick_import):
    """Replaces the grasps of the command by fake ones; returns the names of the grasped objects."""
    calls = []

    def motion(self, attempted, progress):
        obj = attempted
        fake_episode = episode(success=obj.name != "loose")
        errors = (
            "heading_rad",
            "heading_m",
            "pose_rad",
            "pose_m",
            "trajectory_rad",
            "trajectory_m",
        )
        metrics = {
            **fake_episode.metrics,
            **dict.fromkeys(errors, 0.01),
            "affordance_ratio": 0.0,
            "moved_at_removal": 0.0,
            "force_link_max": 3.0,
            "held": float(fake_episode.success),
            "push_survival": float(obj.name == "a"),
        }
        fake_result = dataclasses.replace(
            fake_episode,
            object=obj.name,
            metrics=metrics,
            about={**fake_episode.about, "phases": {"grasp": 0.0, "hold": 0.04}},
        )
        return Grasp(fake_result, 4, 3, 0, ("The heading guides the wrist.",))

    def attempt(self, obj, request, progress):
        calls.append(obj.name)
        return obj

    monkeypatch.setattr(Grasper, "attempt", attempt)
    monkeypatch.setattr(Grasper, "motion", motion)
    return calls


def command(*arguments) -> int:
    return load("grasp")([*map(str, arguments), "--no-pictures"])()


def meshes(folder: pathlib.Path, *names: str) -> pathlib.Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        trimesh.creation.box(SIDES).export(folder / f"{name}.stl")
    return folder


def test_a_folder_with_a_bad_mesh_is_grasped_once(tmp_path, capsys, monkeypatch, fake_grasps):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = meshes(tmp_path / "things", "a", "b")
    out = tmp_path / "out"
    (folder / "bad.obj").write_text("no mesh")
    assert command(folder, "--out", out) == 2
    captured = capsys.readouterr()
    assert fake_grasps == ["a", "b"]
    assert "bad.obj" in captured.err
    assert captured.err.count("congrasp: error:") == 1
    line = next(line for line in captured.out.splitlines() if line.startswith("a:"))
    size = "5.0 x 6.0 x 14.0 cm, about as long as a phone"
    assert (
        f"{size}; held, also against pushes of 1 N; best of 4 attempts (3 hold the object)" in line
    )
    assert f"b: {size}; held; best of" in captured.out
    assert "2 of 3 objects are held; 1 could not be used" in captured.out
    summary = json.loads((out / "summary.json").read_text())
    assert summary["objects"] == 3
    assert summary["succeeded"] == 2
    assert load_motion(out / "a" / MOTION).object == "a"
    assert next(read_episodes(out / "a" / RECORDING)).object == "a"
    assert sorted(path.name for path in (out / "a").iterdir()) == [RECORDING, MOTION, RESULT]

    (folder / "bad.obj").unlink()
    meshes(folder, "c")
    assert json.loads((out / "a" / RESULT).read_text())["object_mass"] > 0.001
    (out / "b" / RESULT).unlink()  # as if it had been interrupted while b was written
    assert command(folder, "--out", out) == 0
    assert fake_grasps == ["a", "b", "b", "c"]
    assert "a (done before)" in capsys.readouterr().out
    assert command(folder, "--out", out, "--heading", "above") == 0  # another request
    assert command(folder, "--out", out, "--heading", "above") == 0
    assert fake_grasps[4:] == ["a", "b", "c"]
    trimesh.creation.box((0.05, 0.05, 0.05)).export(folder / "c.stl")  # another mesh under its name
    assert command(folder, "--out", out, "--heading", "above") == 0
    assert fake_grasps[7:] == ["c"]
    assert command(folder, "--out", out, "--heading", "above", "--again") == 0
    assert fake_grasps[8:] == ["a", "b", "c"]


def test_another_file_of_a_constraint_is_another_request(tmp_path):
    identities = set()
    for content in ("one", "other"):
        (tmp_path / "a.bvh").write_text(content)
        identities |= {
            identity_of_text(f"{tmp_path}/a.bvh{part}") for part in ("", ":0", ":1", ":Hand")
        }
    assert len(identities) == 6


def test_exit_codes(tmp_path, capsys, monkeypatch, fake_grasps):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = meshes(tmp_path / "things", "loose")
    assert command(folder / "loose.stl", "--out", tmp_path / "out") == 1
    assert "not held" in capsys.readouterr().out
    assert command(tmp_path / "nothing.stl", "--out", tmp_path / "out") == 2
    assert "There is no file" in capsys.readouterr().err
    assert (
        command(folder / "loose.stl", "--out", tmp_path / "out", "--heading", "up there", "--again")
        == 2
    )
    assert "--heading is 'up there', not 3 numbers" in capsys.readouterr().err


def test_pictures_of_import_and_grasp(tmp_path, fake_grasps):
    path = meshes(tmp_path / "things", "a") / "a.stl"
    options = ["--out", str(tmp_path / "out"), "--cache-dir", str(tmp_path / "cache")]
    assert command(path, *options) == 0
    for _ in range(2):
        assert load("grasp")([str(path), *options])() == 0
    assert fake_grasps == ["a", "a"]  # without its pictures it was not finished
    assert Image.open(tmp_path / "out" / "a" / PORTRAIT).size == (1280, 720)
    for name, columns in ((OBJECT, 3), (PICTURE, 4)):
        image = np.asarray(Image.open(tmp_path / "out" / "a" / name).convert("RGB")).astype(int)
        red, _, blue = np.moveaxis(image, -1, 0)
        orange = (red > 90) & (blue < 0.5 * red)
        skin = (red > 80) & (red > 1.2 * blue) & (blue > 0.5 * red)
        for part in np.array_split(np.arange(image.shape[1]), columns)[
            : 2 if name == OBJECT else columns
        ]:
            assert orange[:, part].sum() > 400, name
            assert skin[:, part].sum() > 400, name
    assert (tmp_path / "out" / "summary.png").exists()


def test_a_grasp_is_a_constraint_of_the_next(tmp_path, block, grasper, monkeypatch, fake_grasps):
    grasp = Grasper.grasp(grasper, block)
    save_grasp(tmp_path, grasp, film=None, pictures=False, about={"key": "k"})
    text = str(tmp_path / MOTION)
    request = read_request(block, grasper.hand, 15, pose=text, trajectory=text)
    assert set(request.constraints) == {"heading", "pose", "trajectory"}
    np.testing.assert_array_equal(request.given("pose", "q"), grasp.motion.joint_position[7])


def test_an_upright_resting_pose_is_preferred():
    """The mug's likeliest resting pose is on its side; upright precedes it, unless the request
    names a pose.
    """
    mug = procedural.generate(0, "mug")
    upright = upright_rest(mug)
    assert upright is not None
    assert upright > 0
    rests = np.arange(len(mug.rest_poses))
    places = rest_ranks(mug, rests, GraspRequest())
    assert places[upright] == 0
    assert sorted(places) == list(rests)
    np.testing.assert_array_equal(places[upright + 1 :], rests[upright + 1 :])
    assert not rest_ranks(mug, rests, GraspRequest(rest=0)).any()
