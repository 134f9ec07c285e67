"""The tracker: which pose it shows when, against numbers worked out by hand, and what policies see
of it.
"""

import dataclasses
import functools

import hypothesis.extra.numpy as npst
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common import rotations as module
from congrasp.common.ranges import task_faults
from congrasp.common.task import observation
from congrasp.common.task.config import SensingConfig, TaskConfig
from congrasp.common.task.constraints import get_constraint
from congrasp.common.task.constraints.specs import ObservationField
from congrasp.common.task.features import scene_of
from congrasp.common.task.readings import Readings, push, still
from congrasp.common.task.sensors import SENSORS, get_sensor
from congrasp.common.task.sensors.base import EpisodeStart, Moment
from congrasp.common.task.sensors.parameters import SensorParameters, draw_parameters, longest
from congrasp.common.task.sensors.tracker import Tracker
from congrasp.common.task.types import SceneState
from tests.compiled import Compiled
from tests.scenes import HAND, F, L, N, scene

TASK = TaskConfig(
    observation="tracked", surface_points=N, constraints=("heading", "affordance", "fingers")
)
FULL = dataclasses.replace(TASK, observation="full")
STEPS = 40
rotations = Compiled(module)


_draw_sensors = jax.jit(draw_parameters, static_argnums=(0, 1, 3))


def sensors(position_bias=(0.0, 0.0, 0.0), rotation_bias=(0.0, 0.0, 0.0), **options):
    """One tracker that shows each pose at once, without errors, but for what is given."""
    bias = {"position_bias": position_bias, "rotation_bias": rotation_bias}
    fields = {
        "period": 1.0,
        "phase": 0.0,
        "delay": 0,
        "position_noise": 0.0,
        "rotation_noise": 0.0,
        "dropout": 0.0,
        "latency": 0,
    }
    types = {"delay": np.int32, "latency": np.int32}
    arrays = {
        name: np.full(1, value, types.get(name, np.float32))
        for name, value in {**fields, **options}.items()
    }
    biases = {
        name: np.array([bias[name]], np.float32) for name in ("position_bias", "rotation_bias")
    }
    return SensorParameters(
        key=np.array([[3, 7]], np.uint32), **arrays, **biases, eye=np.ones((1, 3), np.float32)
    )


def truth(step):
    """Position and quaternion of the object after a control step; it rests before the first."""
    step = max(step, 0)
    half = 0.01 * step
    return np.array([step, 2.0 * step, -step], np.float32), np.array(
        [np.cos(half), 0, 0, np.sin(half)], np.float32
    )


def moment_of(task, time, pose, table=True):
    """Control steps (B,) with objects at poses (B, 7), all that a tracker measures."""
    unknown = dict.fromkeys(SceneState._fields)
    state = SceneState(**{**unknown, "object_quaternion": pose[:, 3:], "table": table})
    return Moment(
        hand=HAND,
        task=task,
        time=time,
        state=state,
        object_position=pose[:, :3],
        lift=None,
        surface=None,
    )


@functools.partial(jax.jit, static_argnames="room")
def shown(own, poses, room):
    """(1 + T, 7) poses that a tracker with room for so many shows at the start and after T steps (1
    + T, 7).
    """
    delay = (room - 1) * TASK.control_dt
    task = dataclasses.replace(TASK, sensing=SensingConfig(delay=(0.0, delay)))
    sensor = get_sensor(task)
    start = EpisodeStart(hand=HAND, task=task, pose=poses[:1], surface=None, goal=None)
    tracker = sensor.begin(own, start)

    def step(tracker, now):
        time, pose = now
        tracker = sensor.step(own, tracker, moment_of(task, time[None], pose[None]))
        return tracker, tracker.shown[0]

    _, rows = jax.lax.scan(step, tracker, (jnp.arange(1, len(poses)), poses[1:]))
    return jnp.concatenate([tracker.shown, rows])


PATH = np.array([np.concatenate(truth(step)) for step in range(STEPS)], np.float32)


def test_a_perfect_tracker_measures_the_true_pose():
    np.testing.assert_array_equal(shown(sensors(), PATH, 1), PATH)


@settings(max_examples=12, deadline=None)
@given(delay=st.integers(0, 12))
def test_a_delay_of_k_steps_measures_the_pose_of_k_steps_ago(delay):
    expected = [np.concatenate(truth(step - delay)) for step in range(STEPS)]
    np.testing.assert_array_equal(shown(sensors(delay=delay), PATH, 13), expected)


def test_samples_are_held_until_the_next_one_arrives():
    """At one sample in 2.5 control steps, which begin 0.6 periods after the last: floor(n / 2.5 +
    0.6) rises at n = 1 (1.0), 4 (2.2), 6 (3.0), 9 (4.2), 11 (5.0); each is shown three steps
    later."""
    measured = np.asarray(shown(sensors(period=2.5, phase=0.6, delay=3), PATH, 4))[:15, 0]
    np.testing.assert_array_equal(measured, [0, 0, 0, 0, 1, 1, 1, 4, 4, 6, 6, 6, 9, 9, 11])


@settings(max_examples=12, deadline=None)
@given(dropout=st.floats(0.0, 1.0), period=st.floats(1.0, 10.0))
def test_a_lost_sample_leaves_the_last_pose(dropout, period):
    """Every step shows what the step before it showed, or the present pose; all are lost at 1, none
    at 0.
    """
    measured = np.asarray(shown(sensors(dropout=dropout, period=period), PATH, 1))[:, 0]
    held = measured[1:] == measured[:-1]
    np.testing.assert_array_equal(measured[1:][~held], PATH[1:, 0][~held])
    assert held.mean() >= 1 - 1 / period - 2 / STEPS
    assert (
        held.all() if dropout == 1.0 else dropout > 0 or held.mean() <= 1 - 1 / period + 2 / STEPS
    )


def test_errors_have_their_declared_size():
    resting = np.broadcast_to(PATH[5], (4000, 7))
    measured = np.asarray(shown(sensors(position_noise=0.005, rotation_noise=0.05), resting, 1))
    away = measured[:, :3] - resting[:, :3]
    np.testing.assert_allclose(away.std(0), 0.005, rtol=0.05)
    np.testing.assert_allclose(away.mean(0), 0.0, atol=3e-4)
    turn = rotations.multiply(measured[:, 3:], rotations.conjugate(jnp.asarray(resting[:, 3:])))
    np.testing.assert_allclose(2.0 * np.std(turn[:, 1:], 0), 0.05, rtol=0.05)
    np.testing.assert_allclose(np.linalg.norm(measured[:, 3:], axis=1), 1.0, atol=1e-5)
    assert not np.array_equal(measured[0], measured[1])
    again = shown(sensors(position_noise=0.005, rotation_noise=0.05), resting, 1)
    np.testing.assert_array_equal(measured, again)


def test_an_offset_is_that_of_every_sample():
    """The object lies turned by 0.1 rad about z; half a turn about x more takes its z axis down."""
    resting = np.broadcast_to(np.append([0.1, 0.2, 0.3], PATH[5, 3:]), (20, 7)).astype(np.float32)
    measured = np.asarray(
        shown(
            sensors(position_bias=(0.01, 0.0, -0.02), rotation_bias=(np.pi, 0.0, 0.0)), resting, 1
        )
    )
    np.testing.assert_allclose(measured[:, :3], np.tile([0.11, 0.2, 0.28], (20, 1)), atol=1e-6)
    np.testing.assert_array_equal(measured, np.broadcast_to(measured[0], measured.shape))
    down = rotations.rotate(jnp.asarray(measured[0, 3:]), jnp.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(down, [0.0, 0.0, -1.0], atol=1e-5)
    config = SensingConfig(position_bias=(0.004, 0.004), rotation_bias=(0.03, 0.03))
    drawn = jax.device_get(_draw_sensors(config, 0.01, jax.random.key(0), 4000))
    np.testing.assert_allclose(drawn.position_bias.std(0), 0.004, rtol=0.05)
    np.testing.assert_allclose(drawn.rotation_bias.std(0), 0.03, rtol=0.05)


def test_resting_pose_is_the_mean_of_readings():
    """Readings at 0, 12, -6 and 2 mm; then one 5 cm away, after which 0 counts no more; a
    quaternion's sign is none.
    """
    at = [0.0, 0.012, -0.006, 0.002, 0.05, 0.0]
    tilt = [0.0, 0.02, -0.02, 0.0, 0.0, 0.0]
    rows = [[x, 0.0, 0.1, np.cos(a), np.sin(a), 0.0, 0.0] for x, a in zip(at, tilt, strict=True)]
    rows = np.array(rows, np.float32) * np.where(np.arange(6) % 2, -1.0, 1.0)[:, None] ** np.array(
        [[0, 0, 0, 1, 1, 1, 1]]
    )
    rows = rows.astype(np.float32)

    perfect = sensors()

    def means(table, settle):
        task = dataclasses.replace(TASK, sensing=SensingConfig(settle=settle))
        sensor = get_sensor(task)

        @jax.jit
        def track(tracker, time, pose, present):
            return sensor.step(perfect, tracker, moment_of(task, time, pose, present))

        start = EpisodeStart(hand=HAND, task=task, pose=rows[:1], surface=None, goal=None)
        tracker = sensor.begin(perfect, start)
        estimates = []
        for step, row in enumerate(rows[1:], 1):
            present = jnp.array([step < table])
            tracker = track(tracker, jnp.array([step]), row[None], present)
            estimates.append(np.asarray(tracker.first[0]))
        return np.array(estimates)

    estimates = means(9, 0.04)
    np.testing.assert_allclose(estimates[:, 0], [0.006, 0.002, 0.002, 0.002, 0.002], atol=1e-6)
    np.testing.assert_allclose(estimates[:, 4], [np.sin(0.01), 0.0, 0.0, 0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(estimates[:, 3:], axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(means(2, 0.04)[:, 0], [0.006] * 5, atol=1e-6)  # the table is gone
    np.testing.assert_array_equal(means(9, 0.0), np.broadcast_to(rows[0], (5, 7)))


def test_trackers_are_drawn_from_their_ranges():
    """60 ms are 6 control steps of 10 ms; a tracker that is faster than control samples once a
    step.
    """
    config = SensingConfig(
        (0.0, 0.1), (0.06, 0.1), (0.0, 0.01), (0.02, 0.1), (0.1, 0.3), latency=(0.0, 0.03)
    )
    drawn = jax.device_get(_draw_sensors(config, 0.01, jax.random.key(0), 500))
    assert set(np.unique(drawn.delay)) == {6, 7, 8, 9, 10}
    assert longest(config, 0.01) == 11
    assert drawn.period.min() == 1.0
    assert 9.9 < drawn.period.max() <= 10.0
    assert 0.1 <= drawn.dropout.min() < 0.11
    assert 0.29 < drawn.dropout.max() <= 0.3
    assert drawn.position_noise.max() <= 0.01
    assert drawn.rotation_noise.min() >= 0.02
    assert set(np.unique(drawn.latency)) == {0, 1, 2, 3}
    assert len(np.unique(drawn.key, axis=0)) == 500
    perfect = jax.device_get(_draw_sensors(SensingConfig(), 0.01, jax.random.key(0), 3))
    assert not any(np.any(field) for field in perfect[3:-1])
    assert (perfect.period == 1.0).all()


_push = jax.jit(push)


@settings(max_examples=8, deadline=None)
@given(
    pushed=npst.arrays(np.float32, (7, 2, 3), elements=st.floats(-1, 1, width=32)),
    steps=st.integers(1, 5),
)
def test_readings_are_the_last_ones_newest_first(pushed, steps):
    def reading(row):
        return Readings(*[row] * len(Readings._fields))

    readings = still(reading(pushed[0]), steps)
    for row in pushed[1:]:
        readings = _push(readings, reading(row))
    for field in readings:
        np.testing.assert_array_equal(field, np.stack(pushed[::-1][:steps], 1))


def readings_of(seed, state):
    """Random past readings behind the present ones of a state."""
    rng = np.random.default_rng(seed)

    def past(present, unit):
        drawn = rng.normal(size=(len(present), TASK.history - 1, present.shape[-1])).astype(
            np.float32
        )
        drawn = drawn / np.linalg.norm(drawn, axis=-1, keepdims=True) if unit else drawn
        return np.concatenate([np.asarray(present)[:, None], drawn], 1)

    return Readings(
        *(past(getattr(state, name), "quaternion" in name) for name in Readings._fields)
    )


@jax.jit
def both(state, surface, goal, readings):
    """The full observation of a state, and the tracked one."""
    seen = get_sensor(TASK).seen(TASK, state, readings)
    full = observation.observe(scene_of(HAND, FULL, state, surface, goal))
    return full, observation.observe(scene_of(HAND, TASK, seen, surface, goal, readings))


def tracked(*given):
    return both(*given)[1]


def named(row):
    """Parts of an observation by block and field."""
    blocks = {}
    start = 0
    for block, content in observation.fields(HAND, TASK).items():
        for field in content:
            blocks[block, field.name] = row[start : start + field.size]
            start += field.size
    assert start == len(row)
    return blocks


def test_tracked_observation_has_no_forces():
    """Nothing that only a simulator knows changes a bit of it."""
    state, surface, goal = scene(0)
    readings = readings_of(0, state)
    expected = np.asarray(tracked(state, surface, goal, readings))
    other, _, _ = scene(1)
    hidden = ("q_velocity", "u_velocity", "object_velocity", "object_angular_velocity")
    hidden += (
        "contact_force",
        "contact_position",
        "contact_found",
        "object_position",
        "object_quaternion",
    )
    changed = state._replace(**{name: getattr(other, name) for name in hidden})
    np.testing.assert_array_equal(tracked(changed, surface, goal, readings), expected)
    assert not {"force", "touching", "q_velocity", "force_minus", "force_other"} & {
        name for _, name in named(expected[0])
    }


def test_tracked_state_uses_the_tracked_pose():
    state, surface, goal = scene(2)
    readings = readings_of(2, state)
    full, observed = (np.asarray(vector)[1] for vector in both(state, surface, goal, readings))
    observed, start = named(observed), 0
    for block, content in observation.fields(HAND, FULL).items():
        for field in content:
            if not field.privileged:
                part = full[start : start + field.size]
                np.testing.assert_allclose(
                    observed.pop((block, field.name)), part, atol=1e-5, err_msg=field.name
                )
            start += field.size
    assert all(name.startswith("past") for _, name in observed)
    assert len(observed) == 6


def test_its_past_is_worked_out_by_hand():
    state, surface, goal = scene(3)
    state = state._replace(
        u=np.zeros_like(state.u), base_quaternion=np.tile([1, 0, 0, 0], (4, 1)).astype(np.float32)
    )
    present = Readings(*(jnp.asarray(getattr(state, name)) for name in Readings._fields))
    readings = still(present, TASK.history)
    quarter = np.array([np.cos(0.1), 0, 0, np.sin(0.1)], np.float32)  # 0.2 rad about z later
    now = present._replace(
        q=present.q + 0.1,
        object_position=present.object_position + jnp.array([0.0, 0.0, 0.02]),
        object_quaternion=rotations.multiply(jnp.asarray(quarter), present.object_quaternion),
    )
    state = state._replace(q=now.q)
    observed = named(np.asarray(tracked(state, surface, goal, push(readings, now)))[0])
    past = {
        name.removeprefix("past "): part.reshape(TASK.history - 1, -1)
        for (_, name), part in observed.items()
        if "past" in name
    }
    np.testing.assert_allclose(past["q - q"], -0.1, atol=1e-6)
    np.testing.assert_allclose(past["u - u"], 0.0)
    np.testing.assert_allclose(
        past["q_target - past q"][3], (present.q_target - present.q)[0], atol=1e-6
    )
    np.testing.assert_allclose(
        past["object_position"], np.tile([0.0, 0.0, -0.02], (7, 1)), atol=1e-6
    )
    np.testing.assert_allclose(
        past["object_rotation"], np.tile([0.0, 0.0, 2 * np.sin(0.1)], (7, 1)), atol=1e-6
    )


def test_wrist_velocity_is_the_last_displacement():
    state, _, _ = scene(4)
    readings = readings_of(4, state)
    seen = get_sensor(TASK).seen(TASK, state, readings)
    np.testing.assert_allclose(
        seen.u_velocity, (readings.u[:, 0] - readings.u[:, 1]) / 0.01, rtol=1e-5
    )
    assert not seen.contact_found.any()
    assert not seen.contact_force.any()
    assert not seen.object_velocity.any()
    full = get_sensor(FULL).seen(FULL, state, readings)
    np.testing.assert_array_equal(full.u_velocity, state.u_velocity)
    np.testing.assert_array_equal(full.contact_force, state.contact_force)
    assert full.q_velocity.shape == (4, F)
    assert full.contact_found.shape[1] == L


@pytest.mark.parametrize(("latency", "faults"), [(0.07, 0), (0.08, 1)])
def test_a_target_is_followed_within_the_history(latency, faults):
    """8 control steps of 10 ms: the oldest is 7 old."""
    task = TaskConfig(history=8, sensing=SensingConfig(latency=(0.0, latency)))
    assert len(list(task_faults(task))) == faults


class _BlockBeforeState(Tracker):
    """A tracker that lists its own block before its addition to the block `state`."""

    def fields(self, hand, task):
        return {
            "switch": (ObservationField("switch", 1, "7"),),
            "state": (ObservationField("light", 1, "5"),),
        }

    def observe(self, scene):
        column = jnp.ones((len(scene.state.q), 1))
        return {"switch": [7 * column], "state": [5 * column]}


def test_blocks_of_a_sensor_may_have_any_order(monkeypatch):
    monkeypatch.setitem(SENSORS, "tracked", _BlockBeforeState())
    state, surface, goal = scene(0)
    readings = readings_of(0, state)
    row = observation.observe(scene_of(HAND, TASK, state, surface, goal, readings))[0]
    sizes = dict(observation.layout(HAND, TASK))
    assert list(sizes)[:2] == ["state", "switch"]
    assert row.shape == (sum(sizes.values()),)
    assert row[sizes["state"] - 1] == 5
    assert row[sizes["state"]] == 7


def test_block_of_privileged_fields_is_empty_for_a_robot(monkeypatch):
    fingers = get_constraint("fingers")
    (fields,) = fingers.fields(HAND, TASK)
    privileged = tuple(field._replace(privileged=True) for field in fields)
    monkeypatch.setattr(fingers, "fields", lambda hand, task: (privileged,))
    state, surface, goal = scene(0)
    readings = readings_of(0, state)
    row = observation.observe(scene_of(HAND, TASK, state, surface, goal, readings))[0]
    sizes = dict(observation.layout(HAND, TASK))
    assert sizes["fingers"] == 0
    assert row.shape == (sum(sizes.values()),)
