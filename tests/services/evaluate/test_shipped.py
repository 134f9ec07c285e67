"""The policies that come with the package do on other objects what their figures of record say."""

import math

import pytest

from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import policy_file, pretrained_hands
from congrasp.services.evaluate.exams import exam_pool
from congrasp.services.evaluate.experiment import Experiment, Variation
from congrasp.services.evaluate.intervals import NORMAL_95
from congrasp.services.evaluate.published import read_all_results

_SIGMAS = 3
"""Standard deviations of each bound: with two, one of the thirty that are checked would break half
of the time.
"""
EPISODES = 16
"""Of a row, one for each object of the development exam: so many are independent."""
RESULTS = read_all_results()


def farthest(rate, episodes, independent):
    """Lower bound of a mean of `episodes`: `_SIGMAS` standard deviations of it and of the figure
    below the figure.

    Two successes and two failures are added to the figure (Agresti and Coull), so that 100 % has a
    deviation too. A mean of numbers between 0 and 1 spreads at most as much as such a rate (Bhatia
    and Davis).
    """
    rate = (rate * independent + 2) / (independent + 4)
    return rate - _SIGMAS * math.sqrt(rate * (1 - rate) * (1 / episodes + 1 / independent))


def ceiling(row, name, episodes):
    """Upper bound of a mean error, likewise; most shares are 0, and no normal distribution
    describes their mean.
    """
    successes = row.success * row.episodes
    if name.endswith("_ratio"):
        return 1 - farthest(1 - row.errors[name], episodes, successes)
    deviation = row.margins[name] / NORMAL_95 * math.sqrt(successes)
    return row.errors[name] + _SIGMAS * deviation * math.sqrt(1 / episodes + 1 / successes)


@pytest.mark.timeout(600)
@pytest.mark.slow
@pytest.mark.parametrize("hand", pretrained_hands())
def test_a_shipped_policy_is_as_good_as_its_figures(hand):
    """A broken bundle, or physics that it does not know, falls below these floors."""
    recorded_rows = {row.constraint: row for row in RESULTS[hand].rows if not row.group}
    policy = bundles.load(policy_file(None, hand))
    names = [
        name
        for name in policy.task.constraints
        if hand == "human" or name in ("heading", "affordance")
    ]
    pool = exam_pool("development", EPISODES)
    hold = policy.task.hold_steps
    experiment = Experiment(policy, pool, episodes=EPISODES, hold=hold)
    results = experiment.run([Variation(name) for name in names])
    for row in (result.row for result in results):
        record = recorded_rows[row.constraint]
        assert row.success >= farthest(record.success, row.covered, record.independent), (
            row.constraint
        )
        assert row.plausibility["hand_hand_mm"] < 2, row.constraint
        assert row.plausibility["hand_table_mm"] < 2, row.constraint
        for name, error in row.errors.items():
            if error is not None:
                assert error <= ceiling(record, name, row.covered * row.success), name
