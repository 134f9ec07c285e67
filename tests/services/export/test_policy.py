"""An exported policy answers as the Flax policy does, says what its numbers mean, and runs without
JAX.
"""

import dataclasses
import json
import pathlib
import zipfile
from typing import Any

import jax
import numpy as np
import onnxruntime
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common.config import NetworkConfig, RunConfig
from congrasp.common.hands import get_hand
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy import network
from congrasp.common.policy.bundle import PolicyBundle, policy_spec
from congrasp.common.policy.normalizer import Statistics
from congrasp.common.policy.pretrained import policy_file
from congrasp.common.request import GraspRequest
from congrasp.common.task import observation
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import blocks, goal_of
from congrasp.common.task.features import scene_of
from congrasp.common.task.readings import Readings
from congrasp.common.task.types import CONTACTS_PER_LINK, Goal, SceneState, Surface
from congrasp.services.client.limiter import Limiter
from congrasp.services.client.limits import JointLimits
from congrasp.services.export import policy as exports
from congrasp.services.train.command import untrained
from tests.children import python
from tests.examples import EXAMPLES, example
from tests.exported_policies import difference

EXAMPLE = EXAMPLES / "onnx_grasp.py"


@pytest.fixture(scope="module")
def bundle() -> PolicyBundle:
    """A policy whose normalisation and biases do something."""
    spec = policy_spec(TaskConfig(), NetworkConfig(hidden=(32, 16), encoder=8))
    rng = np.random.default_rng(0)
    size = sum(width for _, width in spec.layout)
    params = network.init(1, spec.layout, spec.action_size, spec.network, spec.privileged_size)
    for layer in params["actor"]["network"].values():
        layer["bias"] = rng.normal(size=layer["bias"].shape).astype(np.float32)
    seen = Statistics(np.float64(1000), rng.normal(size=size), 1000 * rng.uniform(0.1, 4.0, size))
    return PolicyBundle(spec, TaskConfig(), params, seen, Statistics(*np.ones(3)), 7, "e", 1)


@pytest.mark.parametrize("kind", ["onnx", "stablehlo"])
def test_exported_policies_answer_as_the_flax_policy(
    bundle: PolicyBundle, kind: str, tmp_path: pathlib.Path
) -> None:
    path = tmp_path / "policy"
    exports.export_policy(bundle, kind, path)
    assert difference(bundle, path) <= 3e-6
    if kind == "stablehlo":
        with zipfile.ZipFile(path) as archive:
            assert archive.read("policy.mlirbc")[:4] == b"ML\xefR"  # MLIR bytecode
            assert json.loads(archive.read("meta.json"))["hand"] == "human"


def test_the_exported_file_describes_every_number(
    bundle: PolicyBundle, tmp_path: pathlib.Path
) -> None:
    exports.export_policy(bundle, "onnx", tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    meta = {
        name: json.loads(text) for name, text in session.get_modelmeta().custom_metadata_map.items()
    }
    hand = get_hand("human")
    for block, size in bundle.spec.layout:
        assert (
            sum(field["size"] for field in meta["observation"] if field["block"] == block) == size
        )
    assert [entry["joint"] for entry in meta["action"]] == [
        *(j.name for j in hand.joints),
        *meta["wrist_joints"],
    ]
    assert session.get_inputs()[0].shape == [
        "batch",
        sum(field["size"] for field in meta["observation"]),
    ]
    assert session.get_outputs()[0].shape == ["batch", len(meta["action"])]
    assert "w, x, y, z" in meta["units"]
    assert meta["version"] == 7
    units = [entry["unit"] for entry in meta["action"]]
    assert units == ["rad"] * 20 + ["m"] * 3 + ["rad"] * 3
    assert meta["rate_hz"] == 100.0


def test_the_file_s_limits_and_gains_are_those_of_the_hand(
    bundle: PolicyBundle, tmp_path: pathlib.Path
) -> None:
    exports.export_policy(bundle, "onnx", tmp_path / "policy.onnx")
    stored = (
        onnxruntime.InferenceSession(tmp_path / "policy.onnx").get_modelmeta().custom_metadata_map
    )
    limits = JointLimits(**json.loads(stored["robot_limits"]))
    joints = get_hand("human").joints
    for name, field in {"torque": "torque_limit", "kp": "kp", "kv": "kv"}.items():
        np.testing.assert_allclose(
            getattr(limits, name)[:-6], [getattr(joint, field) for joint in joints]
        )
    q_open = np.append(get_hand("human").q_open, np.zeros(6))
    limited = Limiter(limits, q_open).limit(np.full(26, np.nan), q_open, np.zeros(26), 0.0)
    assert np.isfinite(limited.target).all()
    assert limited.by == ("not_finite",)


@pytest.fixture(scope="module")
def pretrained_onnx(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    path = tmp_path_factory.mktemp("onnx") / "policy.onnx"
    pretrained = bundles.load(policy_file(None))
    exports.export_policy(pretrained, "onnx", path)
    assert difference(pretrained, path) <= 3e-6
    return path


def test_the_example_grasps_with_onnxruntime_alone(
    pretrained_onnx: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    absent = "import sys, runpy; sys.modules.update(dict.fromkeys(['jax', 'flax', 'congrasp'])); "
    code = (
        f"{absent}sys.argv[1:] = [{str(pretrained_onnx)!r}]; runpy.run_path({str(EXAMPLE)!r}, "
        f"run_name='__main__')"
    )
    done = python("-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the cylinder is held" in done.stdout


def example_grasp(path: pathlib.Path) -> tuple[Any, Any]:
    """The example as a module, and its grasp with a policy's file."""
    module = example("onnx_grasp")
    return module, module.Grasp(onnxruntime.InferenceSession(path))


def observed(example: Any, grasp: Any, task: TaskConfig) -> np.ndarray:
    """(D,) what the policy of a task is to observe in the state of the example's grasp."""
    hand = get_hand("human")
    data = grasp.data
    force, touching = grasp.forces()
    contacts = np.zeros((1, len(hand.links), CONTACTS_PER_LINK, 3))
    contacts[0, :, 0] = force  # one contact a link that carries its whole force
    contact_found = np.zeros(contacts.shape[:-1], bool)
    contact_found[0, :, 0] = touching > 0

    def turn(m: np.ndarray) -> np.ndarray:
        return Rotation.from_matrix(m).as_quat(scalar_first=True)

    now = data.xmat[grasp.object].reshape(3, 3)
    state = SceneState(
        q=data.qpos[grasp.fingers],
        u=data.qpos[grasp.wrist],
        q_velocity=data.qvel[grasp.finger_speeds],
        u_velocity=data.qvel[grasp.wrist_speeds],
        q_target=grasp.q_target,
        u_target=grasp.u_target,
        object_position=data.xpos[grasp.object],
        object_quaternion=turn(now),
        object_velocity=data.qvel[grasp.free : grasp.free + 3],
        object_angular_velocity=now @ data.qvel[grasp.free + 3 : grasp.free + 6],
        contact_force=contacts[0],
        contact_position=contacts[0],
        contact_found=contact_found[0],
        base_position=grasp.base_position,
        base_quaternion=turn(grasp.base),
        q_initial=hand.q_open,
        object_position_initial=grasp.object_position,
        object_quaternion_initial=turn(grasp.object_matrix),
        wrist_load=np.zeros(6),
        time=np.float32(grasp.time),
        table=np.bool_(grasp.time < task.approach_steps),
    )
    rows = [grasp.read(), *grasp.readings][: task.history]
    *read, matrices = (np.array(field) for field in zip(*rows, strict=True))
    readings = Readings(*read, np.array([turn(m) for m in matrices]))
    heading = {
        "position": grasp.heading_position,
        "direction": example.HEADING,
        "cross": np.zeros(3),
    }
    goal = goal_of(hand, task, GraspRequest({"heading": heading}))
    goal = dataclasses.replace(goal, active=dict.fromkeys(blocks(task), np.bool_(False)))

    def batch(tree: Any) -> Any:
        return jax.tree.map(
            lambda x: np.asarray(x)[None].astype(bool if np.asarray(x).dtype == bool else "f4"),
            tree,
        )

    def observe(state: SceneState, surface: Surface, goal: Goal, readings: Readings) -> Any:
        return observation.observe(scene_of(hand, task, state, surface, goal, readings))

    surface = Surface(grasp.points, np.zeros(len(grasp.points), bool), grasp.normals)
    return np.asarray(jax.jit(observe)(batch(state), batch(surface), batch(goal), batch(readings)))[
        0
    ]


def test_the_example_observes_the_training_layout(pretrained_onnx: pathlib.Path) -> None:
    example, grasp = example_grasp(pretrained_onnx)
    for _ in range(57):  # the hand holds the object, and the table is gone
        grasp.step()
    assert grasp.forces()[1].sum() >= 2
    expected = observed(example, grasp, bundles.load(policy_file(None)).task)
    np.testing.assert_allclose(grasp.observe(), expected, atol=2e-5)


def test_the_example_looks_back_as_a_student_does(tmp_path: pathlib.Path) -> None:
    """Its file says what the policy sees of the past, which is no force and no velocity."""
    task = TaskConfig(constraints=("heading",), observation="tracked", history=4)
    config = RunConfig(task=task, network=NetworkConfig(hidden=(16,), encoder=4))
    path = tmp_path / "student.onnx"
    exports.export_policy(untrained(config), "onnx", path)
    assert difference(untrained(config), path) <= 3e-6
    example, grasp = example_grasp(path)
    assert not {"force", "q_velocity"} & {field["field"] for field in grasp.meta["observation"]}
    for _ in range(8):
        grasp.step()
        # So that the object moves
        grasp.data.qvel[grasp.free : grasp.free + 6] += [
            0.1,
            0.0,
            0.2,
            0.5,
            0.0,
            1.0,
        ]
    names = np.repeat(
        *zip(*((field["field"], field["size"]) for field in grasp.meta["observation"]), strict=True)
    )
    assert (names == "past object_rotation").sum() == 9
    one = names != "nearest"  # of two surface points that are as near as each other either will do
    np.testing.assert_allclose(grasp.observe()[one], observed(example, grasp, task)[one], atol=2e-5)
