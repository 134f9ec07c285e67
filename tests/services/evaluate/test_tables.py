"""Tables whose rows are levels: what each level changes, and that all have the same episodes
otherwise.
"""

import contextlib
import dataclasses
import math
from unittest import mock

import jax
import numpy as np
import pytest
from PIL import Image

from congrasp.actors import draws
from congrasp.actors.physics.scene import scene_spec
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling import set_bank
from congrasp.common.task.sensors.parameters import longest
from congrasp.services.evaluate import experiment as experiments
from congrasp.services.evaluate.experiment import Experiment
from congrasp.services.evaluate.plan import protocol
from congrasp.services.evaluate.plots import draw_noise
from congrasp.services.evaluate.variations import (
    MASSES,
    NOISE,
    PEERS,
    SENSING,
    Load,
    Noise,
    payload,
)
from congrasp.services.grasp.grasper import Grasper
from congrasp.services.studio.grasping import PolicyGrasping
from congrasp.services.train.students import TRACKERS
from tests import task
from tests.task import HAND, OBJECTS

TASK = TaskConfig(constraints=("heading",))
"""Nothing of the other constraints has sensors."""


@pytest.fixture(scope="module")
def bank():
    return task.bank()


@pytest.fixture(scope="module")
def experiment(bank):
    return Experiment(task.policy(), OBJECTS, bank, episodes=4, batch=4)


def test_joint_noise_has_its_size_and_stays_within_the_limits(experiment, bank):
    noisy = Noise("pose", kind="joints", level=0.1).bank(experiment)
    q = np.asarray(bank.pose_q)
    away = (noisy.pose_q - q)[(q > HAND.lower + 0.4) & (q < HAND.upper - 0.4)]
    assert 0.095 < away.std() < 0.105
    assert abs(away.mean()) < 0.005
    assert np.all(noisy.pose_q >= HAND.lower)
    assert np.all(noisy.pose_q <= HAND.upper)
    np.testing.assert_array_equal(noisy.pose_position, bank.pose_position)


def test_poses_sink_along_the_heading(experiment, bank):
    noisy = Noise("pose", kind="depth", level=0.01).bank(experiment)
    moved = np.asarray(noisy.pose_position) - np.asarray(bank.pose_position)
    w, *v = np.moveaxis(np.asarray(bank.pose_quaternion, float), -1, 0)
    axis = np.broadcast_to(grasp_frame(HAND).heading, moved.shape)
    v = np.stack(v, -1)
    heading = axis + 2 * np.cross(v, np.cross(v, axis) + w[..., None] * axis)
    depth = (moved * heading).sum(-1)
    assert depth.min() >= 0
    assert 0.0095 < depth.max() <= 0.01001
    np.testing.assert_allclose(moved, depth[..., None] * heading, atol=1e-6)


def test_jitter_moves_every_waypoint(experiment, bank):
    noisy = Noise("trajectory", kind="jitter", level=0.01).bank(experiment)
    away = np.asarray(noisy.trajectory_position) - np.asarray(bank.trajectory_position)
    assert 0.0098 < away.std() < 0.0102
    assert np.all(np.abs(away).max((0, 1, 2, 4)) > 0)
    np.testing.assert_array_equal(noisy.trajectory_quaternion, bank.trajectory_quaternion)


def test_curves_show_every_kind_of_noise(tmp_path):
    errors = {"pose_rad": 0.1, "pose_m": 0.01, "traj_rad": 0.1, "traj_m": 0.01}
    row = mock.Mock(success=0.9, success_low=0.8, success_high=0.95, errors=errors)
    row.held_2s = 0.8
    row.held_2s_low = 0.7
    row.held_2s_high = 0.9
    draw_noise([row] * len(NOISE), tmp_path / "noise.png", "made up")
    picture = np.asarray(Image.open(tmp_path / "noise.png").convert("RGB")).astype(int)
    for part in np.array_split(picture, 3, axis=1):  # the lines of success in each panel
        red, _, blue = part.reshape(-1, 3).T
        assert (blue - red > 100).sum() > 50


def test_sensing_levels_match_their_labels(bank):
    """At 10 ms a step: 60 ms are 6 steps, 30 Hz a sample every 10/3 steps, and no rate is more than
    one a step.
    """
    sensed = SENSING[0].task(TASK)
    one = jax.tree.map(lambda array: np.asarray(array)[:1], bank)
    sample = jax.jit(draws.sample, static_argnames=("hand", "task", "batch"))
    drawn = sample(task.HAND, sensed, one, jax.random.key(0), 4)
    episodes = {level.label: jax.device_get(level.episodes(drawn, 0.01)) for level in SENSING}
    assert len(episodes) == len(SENSING)
    true, nominal = (episodes[level.label] for level in SENSING[:2])
    errors = set(true.sensors._fields) - {"key", "period", "phase", "eye"}
    assert not any(np.any(getattr(true.sensors, name)) for name in errors)
    assert (true.sensors.period == 1.0).all()
    assert (nominal.sensors.delay == 6).all()
    assert nominal.sensors.delay.dtype == np.int32
    np.testing.assert_allclose(nominal.sensors.period, 10 / 3, rtol=1e-6)
    np.testing.assert_allclose(nominal.sensors.position_noise, 0.005)
    np.testing.assert_allclose(nominal.sensors.rotation_noise, math.pi / 60, rtol=1e-6)
    assert (episodes["100 ms"].sensors.delay == 10).all()
    assert longest(sensed.sensing, sensed.control_dt) == 11, "room for the longest delay"
    np.testing.assert_allclose(episodes["10 Hz"].sensors.period, 10.0)
    np.testing.assert_allclose(episodes["30 % dropped"].sensors.dropout, 0.3)
    np.testing.assert_allclose(episodes["friction 0.5"].reset_state.friction, 0.5)
    np.testing.assert_allclose(episodes["gains -20 %"].reset_state.gain_scale, 0.8)
    for level in SENSING[2:]:
        changed = []
        for part in ("sensors", "reset_state"):
            before = getattr(nominal, part)
            after = getattr(episodes[level.label], part)
            for name, a, b in zip(before._fields, before, after, strict=True):
                if not np.array_equal(a, b):
                    changed.append(name)
        assert len(changed) == (
            2 if "noise" in level.label or "6\N{DEGREE SIGN}" in level.label else 1
        ), level.label


def test_a_policy_observes_trackers_only_there():
    ranged = dataclasses.replace(TASK, observation="tracked", sensing=TRACKERS)
    assert protocol(ranged, 25).sensed
    assert not TASK.sensed
    assert SENSING[0].task(TASK).sensed


def test_policies_run_with_stiff_friction_after_any_training():
    """One option of the scene, in training alone."""
    soft = dataclasses.replace(TASK, impratio=1.0)
    assert [scene_spec(HAND, one).option.impratio for one in (TASK, soft, protocol(soft, 25))] == [
        100.0,
        1.0,
        100.0,
    ]
    policy = dataclasses.replace(task.policy(), task=soft)
    with contextlib.closing(Grasper(policy, attempts=1)) as grasper:
        assert grasper.task.impratio == 100.0
    assert PolicyGrasping(lambda version: policy, "soft").task.impratio == 100.0


def test_a_load_sets_the_mass_of_objects_and_the_friction_of_the_same_episodes():
    conditions = task.episodes(64)
    for obj, heavy in zip(OBJECTS, Load(mass=(2.0, 2.0)).objects(OBJECTS), strict=True):
        assert heavy.mass == 2.0
        assert heavy.name == obj.name
        np.testing.assert_allclose(heavy.inertia * obj.mass, 2.0 * obj.inertia)
    for obj, half in zip(OBJECTS, Load(factor=0.5).objects(OBJECTS), strict=True):
        assert half.mass == pytest.approx(obj.mass / 2)
    many = [dataclasses.replace(OBJECTS[0], name=f"box_{i}") for i in range(64)]
    masses = np.array([obj.mass for obj in PEERS[1].objects(many)])
    assert 0.04 <= masses.min() < 0.1
    assert 0.44 < masses.max() <= 0.5
    assert 0.2 < masses.mean() < 0.34
    dexsuite = PEERS[1].episodes(conditions, 0.01).reset_state
    assert 0.5 <= dexsuite.friction.min() < 0.6
    assert 0.9 < dexsuite.friction.max() <= 1.0
    np.testing.assert_array_equal(dexsuite.q, conditions.reset_state.q)
    assert Load(mass=(2.0, 2.0)).episodes(conditions, 0.01) is conditions
    # An episode's friction does not depend on the others.
    last = jax.tree.map(lambda leaf: leaf[-1:], conditions)
    assert PEERS[1].episodes(last, 0.01).reset_state.friction[0] == dexsuite.friction[-1]


@pytest.mark.parametrize("constant_mass", [True, False])
def test_payload_has_the_literal_scaling_where_lengths_are_scaled(constant_mass):
    """Objects of 1.4 times the length are 2.744 times as heavy at the same density."""
    *masses, scaled, literal = payload(1.4, constant_mass=constant_mass)
    assert [load.mass for load in masses] == [(mass, mass) for mass in MASSES]
    assert literal.factor / scaled.factor == pytest.approx(2.744)
    assert (scaled if constant_mass else literal).factor == pytest.approx(1.0)
    assert len(payload(1.0, constant_mass=constant_mass)) == len(MASSES) + 1


def test_all_levels_have_the_same_episodes(experiment, monkeypatch):
    """Objects and initial conditions are those of the first level but for its change; progress
    counts the episodes of a running batch, too.
    """
    seen = []
    told = []
    variations = [*NOISE, *SENSING, *PEERS]

    class Running:
        batch = 4
        stressable = True
        objects = experiment.scaled

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def replace_objects(self, objects, field):
            self.objects = objects

        def run(self, begun, stressed, progress):
            assert stressed
            progress(0.5)
            seen.append((jax.device_get(begun), [obj.mass for obj in self.objects]))
            return mock.Mock()

    monkeypatch.setattr(Experiment, "simulator", lambda self, task, **options: Running())
    monkeypatch.setattr(
        Experiment,
        "row",
        lambda self, variation, sample: mock.Mock(group=variation.label, episodes=4),
    )
    monkeypatch.setattr(experiments, "join_samples", lambda samples: None)
    results = dataclasses.replace(experiment, track=lambda label, total: told.append).run(
        variations
    )
    assert [result.row.group for result in results] == [variation.label for variation in variations]
    # Half of a batch with one episode of each object, then all of it
    assert told == [2 * (i + 1) for i in range(2 * len(variations))]
    first = {}
    for variation, (begun, masses) in zip(variations, seen, strict=True):
        same = ("object_index", "object_position", "object_quaternion", "mass_scale")
        for name in same if isinstance(variation, Noise) else (*same, "q", "base_position"):
            other = getattr(first.setdefault(variation.constraint, begun).reset_state, name)
            np.testing.assert_array_equal(
                getattr(begun.reset_state, name), other, err_msg=f"{variation}: {name}"
            )
        assert isinstance(variation, Load) or masses == [obj.mass for obj in OBJECTS]
    keys = [
        begun.sensors.key
        for variation, (begun, _) in zip(variations, seen, strict=True)
        if variation in SENSING
    ]
    assert all(np.array_equal(key, keys[0]) for key in keys), "the same random numbers"


def test_a_constraint_bank_comes_back_from_its_files(bank, constraint_sets):
    sets = constraint_sets
    back = set_bank.bank_of(sets)
    for name in (
        "points",
        "avoid",
        "heading_position",
        "pose_q",
        "trajectory_position",
        "pose_quaternion",
    ):
        np.testing.assert_array_equal(getattr(back, name), getattr(bank, name))
    for n in range(len(OBJECTS)):
        rests = len(sets[n].arrays["rest"])
        np.testing.assert_array_equal(back.pose_valid[n, :, :rests], bank.pose_valid[n, :, :rests])
        for v, r in np.ndindex(2, rests):
            if v == 0 or bank.has_affordance[n, r]:
                before = bank.heading_index[n, v, r]
                after = back.heading_index[n, v, r]
                assert set(np.asarray(before)) == set(np.asarray(after))
                back_of = dict(
                    zip(np.asarray(before), np.asarray(bank.heading_back[n, v, r]), strict=True)
                )
                np.testing.assert_allclose([back_of[i] for i in after], back.heading_back[n, v, r])
        np.testing.assert_array_equal(
            back.has_affordance[n, :rests], bank.has_affordance[n, :rests]
        )
    held = set_bank.bank_of(sets, "held-out")
    training = set_bank.bank_of(sets, "training")
    assert not np.any(held.pose_valid[:, 0, 0] & training.pose_valid[:, 0, 0])
    assert 0 < held.pose_valid[:, 0].any(1).mean() < training.pose_valid[:, 0].any(1).mean()
