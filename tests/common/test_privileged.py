"""Privileged inputs of the critic, by hand."""

import dataclasses

import hypothesis
import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.hands import get_hand
from congrasp.common.hands.motors import tip_forces
from congrasp.common.policy.bundle import full_layout
from congrasp.common.task import privileged
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.privileged import Parameters
from congrasp.common.task.scene import Scene
from congrasp.common.task.types import SceneState

HAND = get_hand("human")
TASK = TaskConfig(approach_steps=50, hold_steps=25, hold_steps_max=200)


def observed(time, hold, mass=0.5, friction=0.8):
    """Values by name of one episode."""
    nothing = dict.fromkeys(SceneState._fields)
    state = SceneState(**{**nothing, "time": jnp.array([float(time)])})
    row = [jnp.array([x]) for x in (mass, friction, 1.1, False, hold)]
    scene = Scene(HAND, TASK, state, features=None, goal=None, surface=None)
    values = np.asarray(privileged.observe(scene, Parameters(*row, sensors=None)))
    return dict(
        zip((name for name, _ in privileged.layout(HAND, TASK)), values[0].tolist(), strict=True)
    )


def test_values_by_hand():
    inputs = observed(time=60, hold=100)
    strength = tip_forces(HAND).sum()
    expected = {
        "mass": 0.5,
        "friction": 0.8,
        "gain_scale": 1.1,
        "load": 0.5 * 9.81 / (0.8 * strength),
        "stationary": 0.0,
        "hold_remaining": 90 / 200,
    }
    assert inputs == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("time", "remaining"), [(0, 100), (50, 100), (51, 99), (150, 0), (175, 0)])
def test_the_hold_runs_down_once_the_table_is_gone(time, remaining):
    assert observed(time, 100)["hold_remaining"] == pytest.approx(remaining / 200)


@hypothesis.settings(max_examples=30, deadline=None)
@hypothesis.given(
    time=st.integers(0, 400),
    hold=st.integers(-50, 200),
    mass=st.floats(0.001, 1e3),
    friction=st.floats(0.0, 10.0),
)
def test_inputs_are_finite_and_bounded(time, hold, mass, friction):
    inputs = observed(time, hold, mass, friction)
    assert np.isfinite(list(inputs.values())).all()
    assert 0.0 <= inputs["hold_remaining"] <= 1.0
    assert 0.0 <= inputs["load"] <= privileged.MAX_LOAD


@pytest.mark.parametrize(
    "changes",
    [{"observation": "tracked"}, {"sensing": SensingConfig(position_noise=(0.001, 0.002))}],
)
def test_critic_of_sensors_sees_the_true_state(changes):
    task = dataclasses.replace(TASK, **changes)
    sizes = dict(privileged.layout(HAND, task))
    assert sizes["observation"] == sum(size for _, size in full_layout(task))
    assert list(sizes)[:6] == [name for name, _ in privileged.layout(HAND, TASK)]
