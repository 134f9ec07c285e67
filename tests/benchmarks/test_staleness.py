"""The direction of the staleness benchmark; `congrasp bench staleness` has the figures."""

import numpy as np

from tests.benchmarks.staleness import returns, settings


def test_old_rollouts_cost_the_decoupled_objective_less_than_plain_ppo():
    curves = {setting.name: returns(setting, 0, 14, 32) for setting in settings(4)}
    on_policy, decoupled, plain = (np.mean(curve[4:]) for curve in curves.values())
    assert on_policy > decoupled > plain + 0.1
    assert all(curve[-1] > curve[0] + 1.0 for curve in curves.values())  # all of them learn
