"""Left hands: mirror images of right ones in kinematics, surface, objects and policies."""

import dataclasses
from unittest import mock

import mujoco
import numpy as np
import pytest

from congrasp.common import mirror
from congrasp.common.config import NetworkConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import VARIABLE, get_hand, known_hand, right_name
from congrasp.common.hands.files import hand_text
from congrasp.common.hands.mjcf import add_hand
from congrasp.common.hands.skin import skin_of
from congrasp.common.objects.procedural import generate
from congrasp.common.objects.shapes import mesh_of
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import own_policy_file
from congrasp.common.request import GraspRequest
from congrasp.common.task.config import TaskConfig
from congrasp.services.client.left_policy import LeftPolicy, mirrored_request
from congrasp.services.client.policy import Answer
from congrasp.services.grasp.grasper import Grasper
from congrasp.services.grasp.interface import open_grasper
from congrasp.services.serve.inference import LocalPolicy, load_policy
from congrasp.services.train.command import untrained

SIDES = np.diag([-1.0, 1.0, 1.0])


def model_of(name: str) -> mujoco.MjModel:
    """A hand alone."""
    spec = mujoco.MjSpec()
    add_hand(spec, get_hand(name))
    return spec.compile()


@pytest.mark.parametrize("name", ["human", "allegro", "sharpa"])
def test_equal_angles_and_mirrored_wrists_give_mirrored_links(name):
    right = model_of(name)
    left = model_of(f"{name}:left")
    rng = np.random.default_rng(0)
    hand = get_hand(name)
    u = rng.uniform(-0.5, 0.5, 6)
    q = rng.uniform(hand.lower, hand.upper)
    poses = []
    for model, wrist in ((right, u), (left, u * [-1, 1, 1, 1, -1, -1])):
        data = mujoco.MjData(model)
        data.qpos[:] = np.concatenate([wrist, q])
        mujoco.mj_forward(model, data)
        poses.append((data.xpos.copy(), data.xmat.reshape(-1, 3, 3).copy(), data.geom_xpos.copy()))
    (position, turn, geoms), (mirrored, mirrored_turn, mirrored_geoms) = poses
    np.testing.assert_allclose(mirrored, position @ SIDES, atol=1e-12)
    np.testing.assert_allclose(mirrored_turn, SIDES @ turn @ SIDES, atol=1e-12)
    np.testing.assert_allclose(mirrored_geoms, geoms @ SIDES, atol=1e-12)


def test_a_left_hand_is_one_object_by_either_name_and_messages_may_name_it():
    assert get_hand("human:left") is get_hand("human_left") is known_hand("human_left")
    assert get_hand("human:left").reference == "human_left"
    with pytest.raises(CongraspError, match="no hand 'paw:left'"):
        get_hand("paw:left")


def test_names_of_left_hands():
    assert right_name("human_left") == right_name("human:left") == ("human", True)
    assert right_name("human") == ("human", False)
    assert right_name("runs/mug_left") == ("runs/mug_left", False)
    assert right_name("runs/mug:left") == ("runs/mug", True)


def test_a_custom_hand_named_left_has_its_own_policy(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    get_hand.cache_clear()
    bundles_by_name = {}
    for name in ("paw", "paw_left"):
        hand = dataclasses.replace(get_hand("human"), name=name)
        (tmp_path / f"{name}.json").write_text(hand_text(hand))
        task = TaskConfig(hand=get_hand(name).reference, constraints=("heading",))
        config = RunConfig(task=task, network=NetworkConfig(hidden=(8,), encoder=4))
        bundles_by_name[name] = untrained(config)
        bundles.save(bundles_by_name[name], own_policy_file(name))
    grasper = open_grasper(None, "paw_left", attempts=1)
    assert grasper.hand is get_hand("paw_left")
    assert not grasper.left
    with load_policy("paw_left") as policy:
        assert isinstance(policy, LocalPolicy)
        assert policy.metadata()["hand"] == "paw_left"
    # The mirror image of a custom hand is not the custom hand of a similar name.
    with pytest.raises(CongraspError, match="no hand 'paw:left'"):
        Grasper(bundles_by_name["paw"], attempts=1, left=True)
    get_hand.cache_clear()


def test_the_surface_of_a_left_hand_is_closed_to_the_outside_and_mirrored():
    right = skin_of(get_hand("human"))
    left = skin_of(get_hand("human:left"))
    np.testing.assert_allclose(left.points, right.points * [-1, 1, 1], atol=1e-6)
    for skin in (right, left):
        a, b, c = (skin.points[skin.faces[:, i]] for i in range(3))
        outward = np.einsum("fi,fi->f", np.cross(b - a, c - a), skin.normals[skin.faces[:, 0]])
        assert (outward > 0).mean() > 0.95


def test_a_mirrored_object_is_its_mirror_image_and_twice_itself():
    obj = generate(7, "mug")
    image = obj.mirrored()
    vertices, _ = mesh_of(image.pieces)
    expected, _ = mesh_of(obj.pieces)
    np.testing.assert_allclose(vertices.min(0), (expected @ SIDES).min(0), atol=1e-6)
    np.testing.assert_allclose(vertices.max(0), (expected @ SIDES).max(0), atol=1e-6)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(image.inertia), np.linalg.eigvalsh(obj.inertia), rtol=1e-9
    )
    again = image.mirrored()
    for name in ("points", "normals", "rest_poses", "visual_vertices", "visual_faces", "inertia"):
        np.testing.assert_array_equal(getattr(again, name), getattr(obj, name))
    assert [piece.quat for piece in again.pieces] == [piece.quat for piece in obj.pieces]


class Lopsided:
    """In place of a policy of the right hand: answers what no symmetry makes of all that it is
    given.
    """

    def reset(self, request):
        self.begun = request

    def act(self, state):
        goal = self.begun.constraints["heading"]["direction"]
        target = (
            np.concatenate([state["object_position"] + 2 * goal, state["object_quaternion"][1:]])
            + state["u"]
        )
        return Answer(state["q"] + 1, target, np.arange(22.0), 1, (), 0.0, 0.0)


def test_mirrored_inputs_give_mirrored_actions():
    rng = np.random.default_rng(1)
    x, v, r, u, q = (rng.normal(size=size) for size in (3, 3, 4, 6, 16))
    right = Lopsided()
    left = LeftPolicy(Lopsided())
    flip = np.array([-1, 1, 1])
    turn = np.array([1, 1, -1, -1])
    wrist = np.concatenate([flip, -flip])
    answers = []
    for policy, m, t, w in ((right, np.ones(3), np.ones(4), np.ones(6)), (left, flip, turn, wrist)):
        policy.reset(
            GraspRequest(
                {"heading": {"direction": m * v}}, surface=m * x[None], q=q, wrist=(m * x, t * r)
            )
        )
        answers.append(
            policy.act({"q": q, "u": w * u, "object_position": m * x, "object_quaternion": t * r})
        )
    np.testing.assert_allclose(answers[1].u_target, wrist * answers[0].u_target, atol=1e-12)
    np.testing.assert_array_equal(answers[1].q_target, answers[0].q_target)
    np.testing.assert_array_equal(answers[1].action[-6:], wrist * answers[0].action[-6:])
    np.testing.assert_array_equal(answers[1].action[:-6], answers[0].action[:-6])


def test_angular_velocities_are_mirrored_as_rotations():
    """A wheel that rolls forwards does so in the mirror too, where x is the axle."""
    mirrored = mirror.fields(
        {"object_angular_velocity": [1.0, 2.0, 3.0], "object_velocity": [1.0, 2.0, 3.0]}
    )
    np.testing.assert_array_equal(mirrored["object_angular_velocity"], [1, -2, -3])
    np.testing.assert_array_equal(mirrored["object_velocity"], [-1, 2, 3])


def test_limits_of_the_left_hand_are_those_of_the_right_one_mirrored():
    """By hand: slides along x and hinges about y and z change their sign, so that their bounds
    change places.
    """
    lower = [0.0, -1.0, -2.0, -3.0, -0.1, -0.2, -0.3]
    upper = [1.0, 4.0, 5.0, 6.0, 0.4, 0.5, 0.6]
    limits = {"lower": lower, "upper": upper, "palm": [[0.01, 0.02, 0.03, 0.04]]}
    right = mock.Mock(metadata=lambda: {"hand": "human", "limits": limits, "period": 0.01})
    metadata = LeftPolicy(right).metadata()
    assert metadata["hand"] == "human:left"
    assert metadata["period"] == 0.01
    np.testing.assert_array_equal(
        metadata["limits"]["lower"], [0.0, -4.0, -2.0, -3.0, -0.1, -0.5, -0.6]
    )
    np.testing.assert_array_equal(metadata["limits"]["upper"], [1.0, 1.0, 5.0, 6.0, 0.4, 0.2, 0.3])
    assert metadata["limits"]["palm"] == [[-0.01, 0.02, 0.03, 0.04]]


def test_everything_that_a_camera_sees_is_mirrored():
    points = np.array([[1.0, 2.0, 3.0]])
    request = GraspRequest({}, cloud=points, normals=points, camera=points[0])
    mirrored = mirrored_request(request)
    for vectors in (mirrored.cloud[0], mirrored.normals[0], mirrored.camera):
        np.testing.assert_array_equal(vectors, [-1.0, 2.0, 3.0])
    state = mirror.fields(
        {"cloud": points, "surface_normals": points, "camera_position": points[0]}
    )
    assert all(np.array_equal(np.ravel(array), [-1.0, 2.0, 3.0]) for array in state.values())
