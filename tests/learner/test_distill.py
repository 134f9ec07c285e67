"""Distillation: the loss against numbers worked out by hand, a student that comes to its teacher,
bad teachers.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.config import DistillConfig, NetworkConfig, RunConfig
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.bundle import PolicySpec, mean_action, policy_spec
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.privileged import extra, student_action
from congrasp.learner.algorithms.distill import Distillation
from congrasp.learner.algorithms.protocol import NonFiniteUpdate
from congrasp.services.train.students import TRACKERS
from tests.policies import random_bundle

NETWORK = NetworkConfig(hidden=(32,), encoder=4)
TASK = TaskConfig(hand="allegro", constraints=("heading",), surface_points=64)
WORLDS = 32
STEPS = 8


def save_teacher(path):
    """Its actions depend on what it sees, and spread by 0.5 in one entry and 0.1 in the others."""
    bundles.save(random_bundle(TASK, NETWORK, 30.0, std=[0.5] + [0.1] * 21), path)


@pytest.fixture(scope="module")
def teacher(tmp_path_factory):
    """A teacher's file."""
    path = tmp_path_factory.mktemp("teacher") / "policy.safetensors"
    save_teacher(path)
    return path


def run_of(teacher, **distill):
    task = dataclasses.replace(TASK, observation="tracked", sensing=TRACKERS, history=3)
    config = DistillConfig(teacher=str(teacher), minibatches=4, **distill)
    return RunConfig(task=task, network=NETWORK, algorithm="distill", distill=config, updates=100)


def batch(run, seed, worlds=WORLDS):
    """Random observations of both, of which the teacher's first entries are the student's: what it
    can learn from.
    """
    rng = np.random.default_rng(seed)

    def observation_size(task):
        return sum(size for _, size in policy_spec(task, NETWORK).layout)

    student_seen = observation_size(run.task)
    teacher_seen = observation_size(dataclasses.replace(run.task, observation="full"))
    seen = rng.normal(size=(STEPS, worlds, max(student_seen, teacher_seen))).astype(np.float32)
    # One for all: it can be learnt
    mean = np.random.default_rng(1).normal(0.0, 0.01, extra(get_hand("allegro"))).astype(np.float32)
    mean = np.broadcast_to(mean, (STEPS, worlds, len(mean)))
    taught = np.concatenate([seen[..., :teacher_seen], mean], -1)
    return {
        "observation": seen[..., :student_seen].astype(np.float16),
        "teacher_observation": taught,
    }


def algorithm(run):
    return Distillation(policy_spec(run.task, NETWORK), run)


def test_the_loss_is_the_squared_difference_in_the_teacher_s_deviations(teacher):
    """Of a student whose mean is zero: half the sum of (mean / deviation)^2 over the action,
    averaged over all.
    """
    run = run_of(teacher, epochs=1, learning_rate=0.0)
    student = algorithm(run)
    rows = batch(run, 0)
    state = student.init(0)
    state.params["actor"]["network"]["output"] = jax.tree.map(
        jnp.zeros_like, state.params["actor"]["network"]["output"]
    )
    bundle = bundles.load(teacher)
    teacher_action = mean_action(
        bundle.spec.layout,
        bundle.inference_parameters,
        rows["teacher_observation"][..., : -extra(get_hand("allegro"))],
    )
    labels = np.asarray(
        student_action(
            get_hand("allegro"), TASK.control, rows["teacher_observation"], teacher_action
        )
    )
    deviation = np.where(np.arange(labels.shape[-1]) == 0, 0.5, 0.1)
    after, metrics = student.update(state, rows)
    np.testing.assert_allclose(
        metrics["imitation_kl"], 0.5 * ((labels / deviation) ** 2).sum(-1).mean(), rtol=1e-4
    )
    np.testing.assert_allclose(metrics["action_std"], deviation.mean(), rtol=1e-5)
    assert after.version == 1
    assert after.transitions == STEPS * WORLDS
    assert metrics["learning_rate"] == 0.0
    jax.tree.map(np.testing.assert_array_equal, after.params["critic"], state.params["critic"])


def test_a_student_comes_to_its_teacher_and_keeps_its_deviation(teacher):
    run = run_of(teacher)
    student = algorithm(run)
    state = student.init(0)
    losses = []
    rates = []
    for seed in range(60):
        state, metrics = student.update(state, batch(run, seed))
        losses.append(metrics["imitation_kl"])
        rates.append(metrics["learning_rate"])
    assert np.mean(losses[-5:]) < 0.25 * losses[0]  # on states that it has not seen
    np.testing.assert_allclose(rates, 1e-3 * (1.0 - np.arange(60) / 100))
    log_std = bundles.load(teacher).params["actor"]["log_std"]
    np.testing.assert_array_equal(student.policy(state).params["actor"]["log_std"], log_std)
    assert state.observation.count == 60 * STEPS * WORLDS


def test_a_batch_that_is_not_finite_changes_nothing(teacher):
    run = run_of(teacher)
    student = algorithm(run)
    rows = batch(run, 0)
    state = student.init(0)
    rows["teacher_observation"][3, 2] = np.nan
    with pytest.raises(
        NonFiniteUpdate, match="Diverged in the rollouts of update 1: imitation_kl"
    ) as caught:
        student.update(state, rows)
    assert caught.value.state is state
    with pytest.raises(
        CongraspError,
        match=r"8 transitions cannot be split into 16 minibatches\. Use fewer --distill",
    ):
        algorithm(dataclasses.replace(run, distill=DistillConfig(teacher=str(teacher)))).update(
            state, batch(run, 0, worlds=1)
        )


def test_a_teacher_that_does_not_fit_is_one_line(teacher):
    run = run_of(teacher)
    spec = policy_spec(run.task, NETWORK)

    def refused(match, spec=spec, **changed):
        with pytest.raises(CongraspError, match=match) as caught:
            Distillation(spec, dataclasses.replace(run, **changed))
        assert "\n" not in str(caught.value)

    refused(
        "Distillation needs a teacher. Pass a hand or a policy file with --teacher",
        distill=DistillConfig(),
    )
    refused("cannot be read", distill=DistillConfig(teacher="absent.safetensors"))
    refused(
        "cannot teach the hand 'human'", PolicySpec("human", spec.layout, spec.action_size, NETWORK)
    )
    refused("with another 'control_dt'", task=dataclasses.replace(run.task, control_dt=0.02))
    refused(
        "has other observations than",
        task=dataclasses.replace(run.task, constraints=("heading", "pose")),
    )


def test_the_command_line_s_teacher_is_the_whole_task(teacher, monkeypatch):
    """`--teacher FILE` takes its task, adds what a robot's sensors do, and names the file by its
    place.
    """
    from congrasp.services.cli.train import defaults

    monkeypatch.chdir(teacher.parent)
    config = defaults(["--preset", "quickstart", "--teacher", teacher.name, "--updates", "7"])[
        "config"
    ]
    assert config.algorithm == "distill"
    assert config.distill.teacher == str(teacher)
    assert config.name == "quickstart-student"
    assert config.task.method == "student"
    assert config.task.observation == "tracked"
    assert config.task.sensing == TRACKERS
    assert config.task.hand == "allegro"
    assert config.task.surface_points == TASK.surface_points
    assert config.task.approach_steps == 2 * TASK.approach_steps
    assert config.curriculum.weights(config.task.reward, 1) == config.task.reward
    full = defaults(["--preset", "human", "--teacher", teacher.name])["config"]
    assert full.curriculum.weights(full.task.reward, 1) == full.curriculum.reward
    Distillation(policy_spec(config.task, config.network), config)
