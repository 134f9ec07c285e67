"""The search on a function with a known optimum, the counts, and the episodes of an evaluation."""

import numpy as np
import pytest

from congrasp.services.evaluate.experiment import Experiment, Variation
from congrasp.services.evaluate.plan import batches
from tests import task as suite
from tests.benchmarks import ceiling_search
from tests.benchmarks.ceiling_counts import Lost, by_object, by_row, counts_of, table
from tests.benchmarks.ceiling_rollouts import PHASES, Simulator, Trials
from tests.task import HAND, OBJECTS, TASK

EPISODES = [
    *[("heading", "mug"), ("heading", "plate"), ("heading", "plate")],
    *[("pose", "mug"), ("pose", "plate"), ("pose", "book")],
]


def lost_of(row, name, episode, **attempts):
    return Lost(row, name, episode, success=False, **attempts)


LOST = [
    lost_of("heading", "plate", 1, noise_attempts=64, noise_held=2),
    lost_of("heading", "plate", 2, noise_attempts=64, search_attempts=384),
    lost_of("pose", "plate", 1, noise_attempts=64, search_attempts=128, search_held=3),
    lost_of("pose", "mug", 0, noise_attempts=64, search_attempts=384),
]


def test_search_finds_each_optimum():
    optima = np.array([[0.5, -0.3, 0.0, 0.2], [-0.4, 0.1, 0.6, -0.2]])
    rng = np.random.default_rng(0)
    search = ceiling_search.begin(2, 4, std=0.25)
    for _ in range(20):
        drawn = ceiling_search.candidates(search, 64, rng)
        scores = -np.square(drawn - optima[:, None]).sum(-1)
        search = ceiling_search.refined(search, drawn, scores, elites=6)
    np.testing.assert_allclose(search.mean, optima, atol=0.03)


def test_search_first_candidate_is_its_mean():
    search = ceiling_search.Search(np.full((2, 3), 0.7), np.ones((2, 3)))
    drawn = ceiling_search.candidates(search, 8, np.random.default_rng(0))
    np.testing.assert_array_equal(drawn[:, 0], search.mean)
    assert np.ptp(drawn[:, 1:], axis=1).min() > 0


def test_search_ignores_scores_not_finite():
    drawn = np.array([[[9.0], [9.0], [1.0], [1.0]]])
    search = ceiling_search.begin(1, 1, std=1.0)
    scores = np.array([[np.nan, np.inf, 1.0, 0.0]])
    moved = ceiling_search.refined(search, drawn, scores, elites=2)
    assert 0 < moved.mean[0, 0] <= 1


def test_counts_by_object():
    counts = {one.name: one for one in by_object(EPISODES, LOST)}
    assert list(counts) == ["plate", "mug", "book"]
    assert counts["plate"][1:] == (3, 3, 1, 1)
    assert counts["plate"].unreached == 1
    assert counts["mug"][1:] == (2, 1, 0, 0)
    assert counts["mug"].unreached == 1
    assert counts["book"][1:] == (1, 0, 0, 0)
    assert counts["book"].ceiling == 1


def test_counts_by_row_and_ceiling():
    heading, pose = by_row(EPISODES, LOST)
    assert heading[:5] == ("heading", 3, 2, 1, 0)
    assert pose[:5] == ("pose", 3, 2, 0, 1)
    total = counts_of("all", len(EPISODES), LOST)
    assert total.held == pytest.approx(2 / 6)
    assert total.ceiling == pytest.approx(4 / 6)
    (row,) = table("", [total]).rows
    assert row == ["all", "6", "4", "1", "1", "2", "33.3 %", "66.7 %"]


def test_unmodified_trials_are_the_evaluation():
    # With as many environments as the tests of the evaluation, whose programs are compiled already
    batch = len(OBJECTS)
    experiment = Experiment(
        suite.policy(), OBJECTS, suite.bank(), episodes=batch, batch=batch, hold=TASK.hold_steps
    )
    (result,) = experiment.run([Variation()])
    plan = experiment.plan(Variation())
    ((begun, count),) = batches(
        HAND, experiment.task, experiment.bank, plan, experiment.seed, batch
    )
    with Simulator(experiment, batch) as simulator:
        outcomes = simulator.run(begun, simulator.unmodified(count))
        offset = np.full((3, len(PHASES), simulator.action_size), 0.5)
        trials = Trials(np.zeros(3, int), offset, np.array([0.0, 0.0, 0.3]))
        modified = simulator.run(begun, trials)
    np.testing.assert_allclose(outcomes.total, result.sample.values["return"], rtol=1e-4)
    np.testing.assert_array_equal(outcomes.held, result.sample.values["held"] > 0)
    assert len(modified.total) == 3
    assert abs(modified.total[0] - outcomes.total[0]) > 1e-2
    assert modified.total[0] == pytest.approx(modified.total[1], rel=1e-4)
    assert abs(modified.total[2] - modified.total[0]) > 1e-4
