"""A constraint and a reward term that only this file knows: the project makes of them all that it
makes of its own.

Options, weights and probabilities are made of constraints and terms when their modules are
imported. So the test runs this file as a program, which adds its own before it imports anything
else.
"""

import dataclasses
import pathlib
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from congrasp.common import rotations
from congrasp.common.task.constraints.base import Constraint
from congrasp.common.task.constraints.markers import Polyline
from congrasp.common.task.constraints.specs import (
    ErrorSpec,
    GoalArray,
    ObservationField,
    Option,
    Weight,
)
from tests.children import python


class LevelGoal(NamedTuple):
    """Whether it is the wrist or the hand's centre that must be as high as the object's centre."""

    wrist: Annotated[np.ndarray, GoalArray((1,), "the wrist, else the hand's centre", "flag")]


class Level(Constraint):
    """The hand stays as high as the object."""

    name = "level"
    title = "level hand"
    goal = LevelGoal
    blocks = ("level",)
    weights = (Weight("level_height", 0.7, "Per metre of height."),)
    errors = (ErrorSpec("level_m", "m", "hold", 0.05, 0.05, "height beside the object's"),)
    options = (
        Option("level", "What must be as high as the object: wrist or centre."),
        Option(
            "levelled",
            "A wrist path: the wrist must be as high as the object if it ends level.",
            "path",
        ),
    )

    def fields(self, hand, task):
        return (
            (
                ObservationField("level_wrist", 1, "1 for the wrist"),
                ObservationField("level_height", 1, "m, world"),
            ),
        )

    def columns(self, hand, bank):
        """(N,) share of the object's surface points that are above their mean."""
        height = jnp.asarray(bank.points)[..., 2]
        return {"upper": jnp.mean(height > height.mean(-1, keepdims=True), -1)}

    def sample(self, hand, draw, uniform):
        return LevelGoal(uniform < draw.columns("level")["upper"][:, None])

    def labels(self, hand):
        return {"wrist": ("wrist",)}

    def markers(self, own, blocks):
        return (Polyline(np.array([[-0.05, 0.0, 0.0], [0.05, 0.0, 0.01 * own.wrist[0]]])),)

    def observe(self, scene):
        return ([scene.goal["level"].wrist.astype(jnp.float32), self._height(scene)[:, None]],)

    def reward(self, scene):
        return {"level_height": -scene.gate("level") * jnp.abs(self._height(scene))}

    def measure(self, scene):
        return {"level_m": jnp.abs(self._height(scene))}

    def parse(self, text, hand, obj):
        if text["levelled"]:
            return {"wrist": np.abs(np.diff(text["levelled"]["position"][-2:, 2])) < 1e-3}
        return {"wrist": np.array([text["level"] == "wrist"])} if text["level"] else None

    def _height(self, scene):
        features = scene.features
        center = features.wrist_position + rotations.rotate(
            features.wrist_quaternion, features.center
        )
        wrist = scene.goal["level"].wrist[:, 0]
        return (
            jnp.where(wrist, features.wrist_position[:, 2], center[:, 2])
            - scene.state.object_position[:, 2]
        )


def height(scene, earning):
    rise = scene.state.object_position[:, 2] - scene.state.object_position_initial[:, 2]
    return jnp.clip(rise, 0.0, 0.2)


def test_outside_constraint_and_term_work():
    done = python("-m", "tests.common.test_outside", timeout=220)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines() == [
        *(
            "episodes",
            "tables",
            "server",
            "command line",
            "file",
            "marker",
            "studio",
            "ONNX",
            "term",
        )
    ]


def episodes(task):
    """Metrics of short episodes with it; it is sampled, observed, rewarded and measured in them."""
    from congrasp.actors.physics.native import NativePhysics
    from congrasp.actors.rollout import finished_episodes
    from congrasp.actors.worker import RolloutWorker
    from congrasp.common.hands import get_hand
    from congrasp.common.objects import procedural
    from congrasp.common.task.observation import layout
    from congrasp.common.task.sampling.build import build_bank

    hand = get_hand("human")
    batch = 32
    objects = [procedural.generate(0, "box")]
    physics = NativePhysics(hand, task, objects, 1)

    def policy(parameters, observation, key):
        return jnp.zeros((batch, len(hand.joints) + 6)), jnp.zeros(batch)

    worker = RolloutWorker(
        hand,
        task,
        physics,
        build_bank(hand, task, objects, 0),
        policy,
        batch=batch,
        seed=0,
        half_precision=False,
        traced="all",
    )
    goal = jax.device_get(worker.state.goal)
    rollout = worker.collect(None, task.approach_steps + task.hold_steps)
    physics.close()
    active = goal.active["level"]
    wrist = goal["level"].wrist[:, 0]
    assert 0.25 < active.mean() < 0.75
    assert 0.25 < wrist.mean() < 0.75
    metrics = finished_episodes(rollout, task)
    np.testing.assert_array_equal(metrics["episode/mask_level"], active)

    # What the engine shows, worked out from the traces; in `final` the steps after the table's
    # removal.
    height = np.asarray(rollout.trace.wrist_position - rollout.trace.object_position)[..., 2]
    final = np.asarray(rollout.trace.table)[-1] == 0
    assert final.all()
    assert task.hold_steps == 1
    np.testing.assert_allclose(
        metrics["episode/level_m"][wrist], np.abs(height[-1])[wrist], atol=1e-5
    )
    paid = np.where(active & wrist, 0.7 * np.abs(height).sum(0), 0.0)
    np.testing.assert_allclose(-metrics["term/level_height"][wrist], paid[wrist], atol=1e-4)
    assert (metrics["term/level_height"][active] < 0).all()
    assert not metrics["term/level_height"][~active].any()
    assert layout(hand, task)[-2:] == (("level", 2), ("mask", 1))
    block = np.asarray(rollout.observation)[..., -3:-1]
    np.testing.assert_array_equal(block[0, :, 0], active & wrist)
    np.testing.assert_allclose(block[1, :, 1][active & wrist], height[0][active & wrist], atol=1e-5)
    assert not block[:, ~active].any()
    return {
        name.removeprefix("episode/"): values
        for name, values in metrics.items()
        if name.startswith("episode/")
    }


def tables(task, values):
    """Its row of an evaluation, from those episodes that had it alone, as if they had all held the
    object.
    """
    from congrasp.services.evaluate import columns, episodes, scores
    from tests.rows import summarised

    assert scores.TABLES["single"][-1] == "level"
    assert scores.ERRORS["level"] == {"level_m": "level_m"}
    alone = values["mask_level"] > 0
    plan = {"identity": np.arange(len(alone)), "mass_kg": np.full(len(alone), 0.2)}
    some = {
        name: column[alone]
        for name, column in {**values, **plan, "success": np.ones(len(alone))}.items()
    }
    nothing = np.zeros((0, 1, 1))
    row = summarised(
        "level",
        "human",
        episodes.Sample(some, nothing, nothing),
        held_2s=False,
        objects=list("abcdefgh"),
    )
    np.testing.assert_allclose(row.errors["level_m"], some["level_m"].mean())
    assert row.to_json()["level_m"] == row.errors["level_m"]
    assert row.errors["heading_m"] is None
    cells = columns.SCORE_CELLS
    assert "level" in cells["error"](row) or "level" in cells["constraint"](row)


def server(task):
    """Its field of a query."""
    from congrasp.common.hands import get_hand
    from congrasp.services.serve.requests import Layout

    layout = Layout(get_hand("human"), task)
    assert layout.shapes["level_wrist"] == (1,)
    assert layout.shapes["asked"] == (2,)
    assert layout.description()["fields"]["level_wrist"] == [layout.offsets["level_wrist"], 1]


def command_line():
    """Its option, what becomes of it, and its settings of a run."""
    import contextlib
    import io

    from congrasp.common.config import RunConfig
    from congrasp.common.hands import get_hand
    from congrasp.common.objects import procedural
    from congrasp.services.cli import main, parse_errors
    from congrasp.services.grasp.parse import read_request

    train = [
        "--task.p-level",
        "--task.reward.level-height",
        "--task.reward.height",
        "Per metre of rise.",
    ]
    for command, words in {"grasp": ["--level"], "train": train}.items():
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            main.load(command)(["--help"])
        for word in words:
            assert word in printed.getvalue(), word
    parsed = parse_errors.parse("grasp", main.load("grasp"), ["can.obj", "--level", "wrist"])
    assert "level='wrist'" in repr(parsed)
    request = read_request(procedural.generate(0, "box"), get_hand("human"), 15, level="wrist")
    assert list(request.constraints) == ["heading", "level"]
    assert request.constraints["level"]["wrist"].tolist() == [True]
    assert RunConfig().task.reward.level_height == 0.7


def file():
    """A file that one of its options names."""
    import json
    import tempfile

    from congrasp.common.hands import get_hand
    from congrasp.common.objects import procedural
    from congrasp.services.grasp.parse import read_request

    with tempfile.TemporaryDirectory() as folder:
        for end, level in ((0.0, True), (0.1, False)):
            path = pathlib.Path(folder, "path.json")
            written = {"position": [[0.2, 0, 0], [0.1, 0, end]], "quaternion": [[1, 0, 0, 0]] * 2}
            path.write_text(json.dumps(written))
            request = read_request(
                procedural.generate(0, "box"), get_hand("human"), 15, levelled=path
            )
            assert request.constraints["level"]["wrist"].tolist() == [level]


def marker():
    """What pictures, recordings and the studio's player draw of it."""
    from congrasp.common.episode.constraints import block_activity, goal_arrays, markers

    heading = {
        "position": np.zeros(3),
        "direction": np.array([0.0, 0.0, -1.0]),
        "cross": np.array([1.0, 0.0, 0.0]),
    }
    arrays = {f"goal/heading_{name}": value for name, value in heading.items()}
    arrays |= {"goal/level_wrist": np.array([True]), "active/level": np.bool_(True)}
    drawn = dict(markers(goal_arrays(arrays), block_activity(arrays)))
    assert list(drawn) == ["heading", "level"]
    assert drawn["level"].points[1, 2] == 0.01


def studio(task):
    """Its toggle."""
    from congrasp.common.hands import get_hand
    from congrasp.common.objects import procedural
    from congrasp.services.studio.page import describe
    from congrasp.services.studio.state import Studio

    session = Studio(get_hand("human"), task, procedural.generate(0, "box"))
    session.choose("level", "wrist", [True])
    row = {"name": "level", "title": "level hand", "tool": "", "flags": {"wrist": {"wrist": True}}}
    assert row in describe(session)["constraints"]
    assert session.asked == {"level"}
    assert session.request.constraints["level"]["wrist"].tolist() == [True]


def onnx(task):
    """Its block in what is written beside an exported policy."""
    from congrasp.common.config import NetworkConfig, RunConfig
    from congrasp.services.export.policy import describe
    from congrasp.services.train.command import untrained

    description = describe(
        untrained(RunConfig(task=task, network=NetworkConfig(hidden=(8,), encoder=2)))
    )
    assert description["masks"][-1] == "level"
    assert ["level", 2] in description["layout"]
    fields = [entry for entry in description["observation"] if entry["block"] == "level"]
    assert [(entry["field"], entry["size"], entry["meaning"]) for entry in fields] == [
        ("level_wrist", 1, "1 for the wrist"),
        ("level_height", 1, "m, world"),
    ]


def term():
    """The reward term: paid with its weight, which a run keeps."""
    from congrasp.common.config import RunConfig, run_config_from_json, to_json
    from congrasp.common.task.config import RewardWeights, TaskConfig
    from congrasp.common.task.reward import reward_terms, terms
    from tests.scenes import evaluated, scene, scene_of

    task = TaskConfig(constraints=("heading",))
    state, surface, goal = scene(0, batch=3)
    start = state.object_position_initial * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.1]
    risen = start + np.array([[0.0, 0.0, 0.05], [0.0, 0.0, -0.05], [0.0, 0.0, 0.8]])
    state = state._replace(object_position=risen, object_position_initial=start)
    weights = dataclasses.replace(RewardWeights(), height=3.0)
    paid = evaluated(reward_terms, scene_of(task, state, surface, goal), weights)
    np.testing.assert_allclose(paid["height"], [3.0 * 0.05, 0.0, 3.0 * 0.2], rtol=1e-5)
    assert set(paid) == set(terms(task))
    assert "height" in terms(task)
    assert RewardWeights().height == 2.0
    config = RunConfig(task=TaskConfig(reward=RewardWeights(height=0.5)))
    assert run_config_from_json(to_json(config)) == config


if __name__ == "__main__":
    from congrasp.common.task import constraints, reward

    constraints.CONSTRAINTS = (*constraints.CONSTRAINTS, Level())
    reward.GRASP = (*reward.GRASP, reward.Term("height", 2.0, "Per metre of rise.", height))

    from congrasp.common.task.config import TaskConfig

    TASK = TaskConfig(
        constraints=("heading", "level"), approach_steps=2, hold_steps=1, hold_steps_max=1
    )
    metrics = episodes(TASK)
    print("episodes")
    tables(TASK, metrics)
    print("tables")
    server(TASK)
    print("server")
    command_line()
    print("command line")
    file()
    print("file")
    marker()
    print("marker")
    studio(TASK)
    print("studio")
    onnx(TASK)
    print("ONNX")
    term()
    print("term")
