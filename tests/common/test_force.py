"""The constraint `force`, against numbers worked out by hand."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.task import metrics
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.constraints import get_constraint
from congrasp.common.task.constraints.force import ForceGoal, least_force
from congrasp.common.task.observation import fields
from congrasp.common.task.reward import reward_terms, terms
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.types import Surface
from congrasp.services.grasp.parse import read_request
from tests.scenes import HAND, L, evaluated, lone_scene

FORCE = get_constraint("force")
TASK = TaskConfig(constraints=("heading", "force"))
THUMB = 3
INDEX = 6
MIDDLE = 9


def pressing(on: bool = True, limit: float = 3.0):
    """Thumb, index and middle finger press with 5, 2 and 20 N; the limit is 3 N."""
    limited = lone_scene(
        TASK, *["force_limit"] * on, force={"limit": np.array([limit], np.float32)}
    )
    force = np.zeros((1, L, 3), np.float32)
    force[0, THUMB, 0] = 5.0
    force[0, INDEX, 1] = -2.0
    force[0, MIDDLE] = (12.0, 0.0, 16.0)
    touching = np.isin(np.arange(L), (THUMB, INDEX, MIDDLE))[None]
    return limited._replace(features=limited.features._replace(force=force, touching=touching))


def test_observation_by_hand():
    ((limit, over),) = evaluated(FORCE.observe, pressing())
    np.testing.assert_allclose(limit, [[0.15]])
    expected = np.zeros((1, L))
    # 2 and 17 N too much, over as much and 5 N
    expected[0, THUMB] = 2 / 7
    expected[0, MIDDLE] = 17 / 22
    np.testing.assert_allclose(over, expected, rtol=1e-6)
    assert [(field.size, field.privileged) for field in fields(HAND, TASK)["force_limit"]] == [
        (1, False),
        (L, True),
    ]


def test_reward_by_hand():
    # 2 N, and 10 of the 17
    np.testing.assert_allclose(evaluated(FORCE.reward, pressing())["force_over"], [-12.0])
    assert not np.any(evaluated(FORCE.reward, pressing(on=False))["force_over"])
    np.testing.assert_allclose(
        evaluated(reward_terms, pressing(), RewardWeights())["force_over"], [-0.6]
    )


@pytest.mark.parametrize(("limit", "most"), [(3.0, 3.0), (12.0, 5.0)])
def test_force_beyond_the_limit_earns_nothing(limit, most):
    """f_max is the smaller one of 5 N and the limit."""
    unit = RewardWeights(**dict.fromkeys(terms(TASK), 1.0), force_max=5.0)
    weights = HAND.contact_weights
    paid = evaluated(reward_terms, pressing(limit=limit), unit)
    free = evaluated(reward_terms, pressing(on=False, limit=limit), unit)
    expected = weights[THUMB] + weights[INDEX] * 2 / most + weights[MIDDLE]
    np.testing.assert_allclose(paid["force"], [expected], rtol=1e-6)
    np.testing.assert_allclose(paid["force_excess"], [-(5 - most) - (20 - most)], rtol=1e-6)
    np.testing.assert_allclose(
        free["force"], [weights[THUMB] + weights[INDEX] * 2 / 5 + weights[MIDDLE]], rtol=1e-6
    )
    np.testing.assert_allclose(free["force_excess"], [-15.0], rtol=1e-6)


def test_error_is_the_share_of_steps_above_limit():
    hard = evaluated(metrics.errors, pressing())
    soft = evaluated(metrics.errors, pressing(limit=20.5))
    assert hard["force_ratio"][0] == 1.0
    assert soft["force_ratio"][0] == 0.0
    sums = metrics.empty_sums(TASK, 1)
    yes = np.ones(1, bool)
    no = np.zeros(1, bool)
    for step, hold in ((hard, no), (hard, yes), (soft, yes), (soft, yes), (soft, yes)):
        sums = metrics.accumulate(TASK, sums, step, ~hold, hold)
    np.testing.assert_allclose(metrics.episode_errors(TASK, sums)["force_ratio"], [0.25])


def test_the_least_limit_carries_half_of_the_weight():
    """By hand: 1 kg under friction 1 and 0.5, 100 g, and 10 kg: 9.81 / 2, 9.81, 1 (not 0.49) and 20
    (not 49) N.
    """
    limits = least_force(np.array([1.0, 1.0, 0.1, 10.0]), np.array([1.0, 0.5, 1.0, 1.0]))
    np.testing.assert_allclose(limits, [4.905, 9.81, 1.0, 20.0], rtol=1e-6)


def _uniform(batch, seed):
    return np.random.default_rng(seed).uniform(size=(batch, 1)).astype(np.float32)


def test_draws_are_log_uniform():
    count = 4000
    zero = np.zeros(count, int)
    low = np.where(np.arange(count) % 2, 1.0, 5.0)
    limit = np.asarray(
        FORCE.sample(
            HAND, Draw(None, zero, zero, zero, {}, 2 * low / 9.81), _uniform(count, 0)
        ).limit
    )
    for least in (1.0, 5.0):
        of_group = limit[low == least]
        assert of_group.min() >= least * 0.999
        assert of_group.max() <= 20.001
        assert np.median(of_group) == pytest.approx(np.sqrt(20 * least), rel=0.1)
        assert np.log(of_group).std() == pytest.approx(np.log(20 / least) / np.sqrt(12), rel=0.1)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.001, 50.0), st.floats(0.2, 2.0), st.integers(0, 1000))
def test_a_drawn_limit_is_valid_and_enough(mass, friction, seed):
    weight = (np.full(3, mass), np.full(3, friction))
    zero = np.zeros(3, int)
    low = np.asarray(least_force(*weight))
    goal = FORCE.sample(HAND, Draw(None, zero, zero, zero, {}, *weight), _uniform(3, seed))
    assert np.asarray(FORCE.valid(Surface(np.zeros((3, 1, 3)), np.zeros((3, 1), bool)), goal)).all()
    assert (np.asarray(goal.limit) >= low * 0.999).all()
    assert (np.asarray(goal.limit) <= 20.001).all()


@settings(max_examples=25, deadline=None)
@given(st.floats(0.5, 30.0), st.floats(1.0, 3.0))
def test_a_lower_limit_never_pays_more(limit, factor):
    lower, higher = (
        evaluated(reward_terms, pressing(limit=x), RewardWeights()) for x in (limit, factor * limit)
    )
    assert lower["force_over"] <= higher["force_over"] + 1e-6
    assert lower["force_excess"] <= higher["force_excess"] + 1e-6


def test_limits_that_no_hand_keeps_are_not_valid():
    surface = Surface(np.zeros((4, 1, 3)), np.zeros((4, 1), bool))
    np.testing.assert_array_equal(
        FORCE.valid(surface, ForceGoal(np.array([0.0, -3.0, 0.5, 80.0]))),
        [False, False, True, False],
    )


def test_words():
    mug = procedural.generate(1, "mug")
    limit = read_request(mug, HAND, 15, force="3").given("force", "limit")
    assert limit.shape == ()
    assert limit.dtype == np.float32
    assert limit == 3.0
    assert read_request(mug, HAND, 15, force=2.5).given("force", "limit") == 2.5
    heavy = dataclasses.replace(mug, mass=1.0)
    assert read_request(heavy, HAND, 15, gentle=True).given("force", "limit") == pytest.approx(
        4.905
    )
    assert (
        read_request(dataclasses.replace(mug, mass=0.05), HAND, 15, gentle=True).given(
            "force", "limit"
        )
        == 1.0
    )
    assert set(read_request(mug, HAND, 15, gentle=False).constraints) == {"heading"}
    for text in ("soft", "0", "-1", "1000", "nan"):
        with pytest.raises(
            CongraspError, match=rf"--force is '{text}', not a number between 0\.5 and 50"
        ):
            read_request(mug, HAND, 15, force=text)
    with pytest.raises(CongraspError, match="--force and --gentle both set the force limit"):
        read_request(mug, HAND, 15, force="3", gentle=True)
