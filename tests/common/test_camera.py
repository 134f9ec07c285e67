"""Clouds of a depth camera: what is visible, and a policy that depends on neither their order nor
the object's pose.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common import rotations as module
from congrasp.common.config import NetworkConfig, RunConfig
from congrasp.common.hands import get_hand
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy import network
from congrasp.common.policy.bundle import full_layout, mean_action, policy_spec
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.constraints import known
from congrasp.common.task.privileged import extra
from congrasp.common.task.sensors import get_sensor, images
from congrasp.common.task.sensors.base import EpisodeStart, Moment
from congrasp.common.task.sensors.parameters import draw_parameters
from congrasp.common.task.types import Goal, SceneState, Surface
from congrasp.learner.algorithms.distill import Distillation
from congrasp.services.export.policy import export_policy
from tests.compiled import Compiled
from tests.exported_policies import difference
from tests.policies import random_bundle

HAND = get_hand("allegro")
rotations = Compiled(module)
NETWORK = NetworkConfig(hidden=(32,), encoder=4, points=(8, 16))
POINTS = 64
TASK = TaskConfig(hand="allegro", surface_points=POINTS, observation="camera", history=2)


def cube():
    """Six faces of 8 x 8 points of a cube of 6 cm: those at -x, +x, -y, +y, -z and +z."""
    grid = np.linspace(-0.029, 0.029, 8)
    a, b = (axis.ravel() for axis in np.meshgrid(grid, grid))
    faces = [
        np.insert(np.stack([a, b], 1), axis, side, 1)
        for axis, side in itertools.product(range(3), (-0.03, 0.03))
    ]
    return jnp.asarray(np.concatenate(faces)[None], jnp.float32)


_facing = jax.jit(images.facing)
FRONTS = [((0.5, 0.0, 0.0), [1]), ((0.0, -0.5, 0.0), [2]), ((0.3, 0.3, 0.3), [1, 3, 5])]


@pytest.mark.parametrize(("eye", "front"), FRONTS)
def test_the_faces_towards_the_camera_are_visible(eye, front):
    """Hidden faces show at most their rim, within two rows of 8.3 mm: the grid's cells are 11
    mm.
    """
    seen = np.asarray(_facing(jnp.array([eye]), cube()))[0]
    assert seen.reshape(6, 64).mean(1)[front].min() > 0.9
    points = np.asarray(cube())[0][seen]
    depth = np.min([0.03 - points[:, face // 2] * (1 if face % 2 else -1) for face in front], 0)
    assert depth.max() <= 0.018
    assert (depth > 1e-3 + 1e-6).mean() < 0.25


def test_a_capsule_hides_what_is_behind_it():
    """From 1 m: the ray to a point 0.05 m off the axis passes a capsule half-way at 0.025 m, beyond
    its 0.02 m.
    """
    points = jnp.array(
        [[[0.0, 0.0, 0.0], [0.0, 0.03, 0.0], [0.0, 0.05, 0.0], [0.7, 0.0, 0.0], [0.0, 0.0, 0.05]]]
    )
    ends = jnp.array([[[[0.5, 0.0, -0.1], [0.5, 0.0, 0.1]]]])
    hidden = images.behind(
        jnp.array([[1.0, 0.0, 0.0]]), points, images.Capsules(ends, jnp.array([0.02]))
    )
    assert hidden.tolist() == [[True, True, False, False, True]]


@functools.partial(jax.jit, static_argnums=0)
def cameras(sensing, pose, points, goal):
    """Parameters and first state of cameras."""
    task = dataclasses.replace(TASK, sensing=sensing)
    parameters = draw_parameters(sensing, 0.01, jax.random.key(0), len(pose))
    surface = Surface(points, points[..., 2] > 0.02)
    start = EpisodeStart(hand=HAND, task=task, pose=pose, surface=surface, goal=goal)
    return parameters, get_sensor(task).begin(parameters, start)


def heading_goal(batch):
    """Neutral goals with an active affordance."""
    values = {c.name: c.neutral(HAND, TASK) for c in known(TASK)}
    values = jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *x.shape)), values)
    return Goal(values, {"affordance": jnp.ones(batch, bool)})


def test_a_calibration_error_is_one_rigid_motion_of_cloud_and_goal():
    """The error of each image of an episode is the same, and that of the stated goal too."""
    pose = jnp.array([[0.1, 0.2, 0.05, 1.0, 0.0, 0.0, 0.0]])
    (_, exact), (parameters, off) = (
        cameras(
            SensingConfig(position_bias=(x, x), rotation_bias=(7 * x, 7 * x)),
            pose,
            cube(),
            heading_goal(1),
        )
        for x in (0.0, 0.005)
    )
    turn = rotations.from_rotation_vector(parameters.rotation_bias)
    moved = rotations.transform(
        pose[:, :3] + parameters.position_bias, turn, exact.cloud.points - pose[:, None, :3]
    )
    np.testing.assert_allclose(off.cloud.points, moved, atol=1e-6)
    np.testing.assert_array_equal(off.cloud.avoid, exact.cloud.points[..., 2] - 0.05 > 0.02)
    np.testing.assert_allclose(exact.goal["heading"].position, pose[:, :3], atol=1e-7)
    np.testing.assert_allclose(
        off.goal["heading"].position, pose[:, :3] + parameters.position_bias, atol=1e-6
    )
    down = rotations.rotate(turn, exact.goal["heading"].direction)
    np.testing.assert_allclose(off.goal["heading"].direction, down, atol=1e-6)
    path = exact.goal["trajectory"]
    turned = rotations.multiply(
        jnp.broadcast_to(turn[:, None], path.quaternion.shape), path.quaternion
    )
    np.testing.assert_allclose(off.goal["trajectory"].quaternion, turned, atol=1e-6)
    np.testing.assert_array_equal(off.goal["force"].limit, exact.goal["force"].limit)


def test_images_follow_their_period(monkeypatch):
    """At 10 Hz in steps of 10 ms: two or three in 25 steps. Half of the points are dropped. Three
    at most together.
    """
    monkeypatch.setattr(images, "IMAGES_TOGETHER", 3)
    pose = jnp.tile(jnp.array([[0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0]]), (4, 1))
    points = jnp.repeat(cube(), 4, 0)
    unknown = dict.fromkeys(SceneState._fields)
    far = {  # hands far from their objects
        "object_position": pose[:, :3],
        "object_quaternion": pose[:, 3:],
        "q": jnp.zeros((4, len(HAND.joints))),
        "u": jnp.zeros((4, 6)),
        "base_position": jnp.full((4, 3), 3.0),
        "base_quaternion": pose[:, 3:],
    }
    true = SceneState(**{**unknown, **far})
    surface = Surface(points, points[..., 2] > 0.02)

    @jax.jit
    def look(parameters, state, time):
        moment = Moment(
            hand=HAND,
            task=TASK,
            time=time,
            state=true,
            object_position=pose[:, :3],
            lift=None,
            surface=surface,
        )
        return get_sensor(TASK).step(parameters, state, moment)

    for single, expected in ((0.0, {2, 3}), (1.0, {0})):
        sensing = SensingConfig(period=(0.1, 0.1), dropout=(0.5, 0.5), single_image=single)
        parameters, state = cameras(sensing, pose, points, heading_goal(4))
        count = np.zeros(4, int)
        for step in range(1, 26):
            after = look(parameters, state, jnp.full(4, step))
            count += np.any(after.cloud.points != state.cloud.points, (1, 2))
            state = after
        assert set(count.tolist()) <= expected
        local = state.cloud.points - pose[:, None, :3]
        nearest = jnp.linalg.norm(local[:, :, None] - points[:, None], axis=-1).min(-1)
        np.testing.assert_allclose(nearest, 0.0, atol=1e-5)


def test_images_in_parts_equal_single_images(monkeypatch):
    """Other objects, poses and hands in each of seven, every second one due; arrays of NumPy
    outside of a program.
    """
    rng = np.random.default_rng(0)
    pose = np.tile(np.float32([0, 0, 0.05, 1, 0, 0, 0]), (7, 1))
    pose[:, :3] += rng.normal(size=(7, 3))
    points = rng.uniform(-0.04, 0.04, (7, POINTS, 3)).astype(np.float32)
    surface = Surface(points, points[..., 2] > 0.02, points / 0.07)
    task = dataclasses.replace(TASK, surface_normals=True)
    drawn = draw_parameters(SensingConfig(dropout=(0.2, 0.5)), 0.01, jax.random.key(0), 7)
    parameters = jax.tree.map(np.asarray, drawn)
    start = EpisodeStart(hand=HAND, task=task, pose=pose, surface=surface, goal=heading_goal(7))
    first = get_sensor(task).begin(parameters, start).cloud
    ends = (
        pose[:, None, None, :3]
        + 0.5 * parameters.eye[:, None, None]
        + rng.normal(size=(7, 1, 2, 3)) * (0, 0, 0.03)
    )
    ends = ends.astype(np.float32)
    due = np.arange(7) % 2 == 0
    taken = images.Images(
        parameters=parameters,
        origin=pose[:, :3],
        time=np.arange(7),
        pose=pose,
        surface=surface,
    )
    inputs = first, taken, due

    @jax.jit
    def image(inputs, ends):
        return images.with_images(
            *inputs, lambda rows: images.Capsules(ends[rows], jnp.array([0.02]))
        )

    def alone(i):
        return image(*jax.tree.map(lambda x: x[i : i + 1], (inputs, ends)))

    expected = jax.tree.map(lambda *clouds: jnp.concatenate(clouds), *map(alone, range(7)))
    monkeypatch.setattr(images, "IMAGES_TOGETHER", 3)
    cloud = image(inputs, ends)
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-3), cloud, expected)
    np.testing.assert_array_equal(np.any(cloud.points != first.points, (1, 2)), due)
    assert np.any(cloud.points != image(inputs, ends + 9.0).points, (1, 2)).any()


@functools.cache
def bundle():
    return random_bundle(TASK, NETWORK, 100.0)


def cloud_block():
    start = 0
    for name, size in bundle().spec.layout:
        if name == network.CLOUD:
            return slice(start, start + size)
        start += size
    raise AssertionError


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_order_of_the_points_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    policy = bundle()
    block = cloud_block()
    seen = rng.normal(size=(2, sum(size for _, size in policy.spec.layout))).astype(np.float32)
    seen[:, -1] = 1.0
    other = seen.copy()
    points = seen[:, block].reshape(2, POINTS, 4)
    other[:, block] = points[:, rng.permutation(POINTS)].reshape(2, -1)
    act = functools.partial(mean_action, policy.spec.layout, policy.inference_parameters)
    np.testing.assert_allclose(act(other), act(seen), atol=1e-6)
    other[:, block] = rng.normal(size=(2, POINTS * 4))
    assert np.abs(act(other) - act(seen)).max() > 1e-3


def test_bundles_and_exports_keep_the_cloud_s_layers(tmp_path):
    path = tmp_path / "camera.safetensors"
    bundles.save(bundle(), path)
    loaded = bundles.load(path)
    assert loaded.spec == bundle().spec
    assert loaded.spec.network.points == (8, 16)
    other = dataclasses.replace(loaded.spec, network=dataclasses.replace(NETWORK, points=(8, 8)))
    assert other.schema != loaded.spec.schema
    for kind in ("onnx", "stablehlo"):
        export_policy(loaded, kind, tmp_path / kind)
        assert difference(loaded, tmp_path / kind) <= 3e-6


def test_student_learns_from_its_cloud(tmp_path):
    """A teacher of the full state acts by where the object is; the student's one informative input
    is the cloud.
    """
    full = dataclasses.replace(TASK, observation="full")
    teacher = random_bundle(full, NETWORK, 30.0, seed=2, std=0.2)
    path = tmp_path / "teacher.safetensors"
    bundles.save(teacher, path)
    run = RunConfig(task=TASK, network=NETWORK, algorithm="distill", updates=1000)
    run = dataclasses.replace(
        run,
        distill=dataclasses.replace(
            run.distill, teacher=str(path), minibatches=4, learning_rate=3e-3
        ),
    )
    spec = policy_spec(TASK, NETWORK)
    student = Distillation(spec, run)
    block = cloud_block()
    size = sum(width for _, width in full_layout(TASK))
    assert sum(width for _, width in teacher.spec.layout) == size

    def batch(seed):
        rng = np.random.default_rng(seed)
        middle = rng.normal(size=(4, 32, 3))
        taught = np.zeros((4, 32, size + extra(get_hand(TASK.hand))), np.float32)
        taught[..., :3] = middle
        seen = np.zeros((4, 32, sum(width for _, width in spec.layout)), np.float16)
        points = 0.1 * rng.normal(size=(4, 32, POINTS, 4)) + np.append(np.zeros(3), 1.0)
        points[..., :3] += middle[..., None, :]
        seen[..., block] = points.reshape(4, 32, -1)
        return {"observation": seen, "teacher_observation": taught}

    state = student.init(0)
    losses = []
    first = jax.tree.map(np.asarray, state.params["actor"]["network"])
    for seed in range(60):
        state, metrics = student.update(state, batch(seed))
        losses.append(metrics["imitation_kl"])
    assert np.mean(losses[-5:]) < 0.5 * losses[0]
    learnt = state.params["actor"]["network"]
    for layer in ("cloud_0", "cloud_1"):
        assert np.abs(learnt[layer]["kernel"] - first[layer]["kernel"]).max() > 0.01
