"""Lift and pushes: the frame's profile, forces in every engine, what the policy sees, and what
counts as survival.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from congrasp.actors import stress as protocols
from congrasp.actors.attempts import Attempts, Phases
from congrasp.actors.initial import RequestedEpisodes
from congrasp.actors.physics import make_physics
from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.physics.scene import compile_scene
from congrasp.actors.stress import Frame, Protocol
from congrasp.common.objects.distance import distance_field
from congrasp.common.task import plausibility
from congrasp.common.task.constraints import optional
from congrasp.common.task.types import Surface
from tests import task as suite
from tests.task import BATCH, HAND, OBJECTS, TASK, warp_engine

WITHOUT_MESHES = set(protocols.ASSESSED_NAMES) - {"hand_mesh_mm"}
"""What is measured of a hand whose file has no visual meshes."""
NEVER = 10_000
"""Control steps after which no test goes on."""
MASSES = tuple(obj.mass for obj in OBJECTS)


def protocol(height: float = 0.15, start: int = 0, masses: tuple[float, ...] = MASSES) -> Protocol:
    steps = protocols.lift_steps(TASK, height)
    return Protocol(
        np.float32(start),
        np.float32(height),
        np.float32(start + steps),
        np.array(masses, np.float32),
    )


def frames(height: float) -> Frame:
    """The carried frame at every step from the table's removal to the end of the lift."""
    time = TASK.approach_steps + np.arange(200, dtype=np.float32)
    frame = _frame(protocol(height), time)
    return Frame(*(np.asarray(field)[: protocols.lift_steps(TASK, height) + 1] for field in frame))


_frame = jax.jit(lambda protocol, time: protocols.frame(protocol, TASK, time))


def test_the_lift_is_of_15_cm_at_30_cm_a_second():
    lift = frames(0.15)
    # 3 m/s^2 for 0.1 s (1.5 cm), 0.3 m/s for 0.4 s, 3 m/s^2 downwards for 0.1 s; then 0.1 s of
    # rest.
    assert len(lift.height) == 71
    at = [0, 5, 10, 30, 50, 55, 60, 70]
    heights = [0, 0.00375, 0.015, 0.075, 0.135, 0.14625, 0.15, 0.15]
    np.testing.assert_allclose(lift.height[at], heights, atol=1e-6)
    np.testing.assert_allclose(lift.speed[at], [0, 0.15, 0.3, 0.3, 0.3, 0.15, 0, 0], atol=1e-5)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.005, 0.5))
def test_every_lift_is_smooth_and_ends_where_it_should(height):
    lift = frames(height)
    assert lift.height[-1] == pytest.approx(height, abs=1e-5)
    assert abs(lift.speed[-1]) < 1e-4
    assert lift.speed.max() <= protocols.LIFT_SPEED_M_S + 1e-5
    assert (np.diff(lift.height) > -1e-6).all()
    assert (
        np.abs(np.diff(lift.speed)).max()
        <= protocols.LIFT_ACCELERATION_M_S2 * TASK.control_dt + 1e-4
    )
    way = 0.5 * TASK.control_dt * (lift.speed[1:] + lift.speed[:-1])
    # Where the speed has a kink within a step, the trapezoid is off by a dt^2 / 8 at most.
    kink = protocols.LIFT_ACCELERATION_M_S2 * TASK.control_dt**2 / 8
    np.testing.assert_allclose(np.diff(lift.height), way, atol=kink + 1e-6)


_push = jax.jit(
    lambda protocol, time, index, scale: protocols.push(protocol, TASK, time, index, scale)
)


def test_pushes_follow_one_another_along_the_axes_of_the_world():
    steps = protocols.push_steps(TASK)
    first = TASK.approach_steps + protocols.lift_steps(TASK)
    index = np.array([1])
    scale = np.array([1.5], np.float32)
    forces = [
        np.asarray(_push(protocol(masses=(0.2, 0.4)), np.float32([time]), index, scale))[0]
        for time in [
            0,
            first - 1,
            *(first + steps * np.arange(12) + steps // 2),
            first + 12 * steps,
        ]
    ]
    assert not np.any([forces[0], forces[1], forces[-1]])
    half = 0.5 * 9.81 * 0.4 * 1.5
    directions = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    np.testing.assert_allclose(forces[2:8], half * np.array(directions), rtol=1e-5)
    np.testing.assert_allclose(forces[8:14], 1.0 * np.array(directions), rtol=1e-5)
    assert protocols.stress_steps(TASK) == protocols.lift_steps(TASK) + 12 * steps == 70 + 12 * 25


@functools.cache
def start():
    """Objects at rest under headings alone, with the hand far above them and turned away from the
    heading by up to 40 degrees: so little that its wrist has come to it, and lags behind by the
    servos' acceleration alone, when it is lifted."""
    drawn = suite.episodes(8 * BATCH)
    headed = np.flatnonzero(~(drawn.goal.active["pose_finger"] | drawn.goal.active["trajectory"]))[
        :BATCH
    ]
    fresh = jax.tree.map(lambda rows: rows[headed], drawn)
    goal = dataclasses.replace(fresh.goal, active=jax.tree.map(np.zeros_like, fresh.goal.active))
    aligned = Rotation.from_quat(fresh.reset_state.base_quaternion, scalar_first=True)
    turns = aligned * Rotation.from_euler("x", np.linspace(-40, 40, BATCH)[:, None], degrees=True)
    state = fresh.reset_state._replace(
        base_position=fresh.reset_state.object_position + np.float32([0.0, 0.0, 0.4]),
        base_quaternion=turns.as_quat(scalar_first=True).astype(np.float32),
        u_velocity=np.zeros((BATCH, 6), np.float32),
        q=np.tile(HAND.q_open, (BATCH, 1)).astype(np.float32),
    )
    return fresh._replace(reset_state=state, goal=goal)


def falls(physics, force: np.ndarray, steps: int = 10):
    """Objects after `steps` control steps without a table under a force, and without one before."""
    target = np.concatenate([np.zeros((BATCH, 6)), np.tile(HAND.q_open, (BATCH, 1))], 1).astype(
        np.float32
    )
    state = physics.start(start().reset_state)
    step = jax.jit(physics.step) if physics.compiled else physics.step
    for _ in range(steps):
        state, after = step(state, target, np.zeros(BATCH, bool), force)
    return after


def check_fall(physics):
    """A free object under gravity and a force moves by (f / m + g) t^2 / 2, and does not turn."""
    force = np.tile(np.float32([[0.6, -0.4, 1.0], [0.0, 0.8, -0.5]]), (BATCH // 2, 1))
    after = falls(physics, force)
    masses = np.array([OBJECTS[i].mass for i in start().reset_state.object_index])[:, None]
    seconds = 10 * TASK.control_dt
    expected = (force / masses + [0.0, 0.0, -9.81]) * seconds
    np.testing.assert_allclose(after.object_velocity, expected, rtol=0.01, atol=0.01)
    np.testing.assert_allclose(after.object_angular_velocity, 0.0, atol=0.02)


def test_native_pushes_with_a_force_and_forgets_it_at_a_reset():
    physics = NativePhysics(HAND, TASK, OBJECTS, 1)
    check_fall(physics)
    after = falls(physics, np.zeros((BATCH, 3), np.float32))
    np.testing.assert_allclose(after.object_velocity[:, :2], 0.0, atol=1e-3)
    state = start().reset_state
    target = np.concatenate([np.zeros((BATCH, 6)), np.tile(HAND.q_open, (BATCH, 1))], 1)
    physics.step(None, target, np.zeros(BATCH, bool), np.full((BATCH, 3), 5.0))
    physics.reset(None, np.ones(BATCH, bool), state)
    _, after = physics.step(None, target, np.zeros(BATCH, bool))
    np.testing.assert_allclose(after.object_velocity[:, :2], 0.0, atol=1e-3)
    physics.close()


@pytest.mark.slow
def test_mjx_gets_the_same_force(monkeypatch):
    """What MJX makes of `xfrc_applied` is MuJoCo's; compiling it takes over a minute."""
    monkeypatch.setattr("congrasp.actors.physics.mjx.mjx.step", lambda model, data: data)
    physics = make_physics("jax", HAND, TASK, OBJECTS, threads=1)
    force = np.random.default_rng(0).normal(size=(BATCH, 3)).astype(np.float32)
    state = physics.start(start().reset_state)
    target = np.zeros((BATCH, 6 + len(HAND.joints)), np.float32)
    pushed, _ = jax.jit(physics.step)(state, target, np.zeros(BATCH, bool), force)
    expected = np.zeros_like(pushed.data.xfrc_applied)
    expected[:, compile_scene(HAND, TASK, OBJECTS[0]).body("object").id, :3] = force
    np.testing.assert_array_equal(pushed.data.xfrc_applied, expected)


@pytest.mark.slow
def test_warp_pushes_with_the_same_force():
    check_fall(warp_engine(OBJECTS, mesh_slots=0))


class Seen(NamedTuple):
    """Recorded samples of the plausibility, and what the policy's frame shows."""

    sample: plausibility.Sample
    wrist_position: Any
    u: Any
    u_velocity: Any
    object_position: Any


def seen(scene, index, data) -> Seen:
    state = scene.state
    sample = plausibility.sample(scene, index, data)
    return Seen(
        sample, scene.features.wrist_position, state.u, state.u_velocity, state.object_position
    )


def under(stress: Protocol, conditions, time: int = 0):
    """Environments under a protocol from a step of their episodes on; they have programs of their
    own.
    """
    worker = suite.worker(probe=seen, renewed=False)
    worker.begin(conditions)
    worker.state = worker.state._replace(time=jnp.full_like(worker.state.time, time))
    worker.adjust(protocol=stress, probe_data=distance_field(OBJECTS))
    return worker


def released(stress: Protocol, steps: int):
    """A rollout from the table's removal on, in which the wrist comes to its guidance."""
    worker = under(stress, start(), TASK.approach_steps)
    rollout = worker.collect(suite.command(), steps)
    worker.physics.close()
    return rollout


def test_a_lift_moves_the_wrist_but_not_the_observation():
    """It begins when the wrist has come to its guidance. Objects fall, in the world; the frame
    leaves them below.
    """
    still, moving = (
        released(protocol(start=begin)._replace(push_start=np.float32(NEVER)), 215)
        for begin in (NEVER, 145)
    )
    # The policy sees the same within half a millimetre: targets are held for a control step each.
    for name, size, tolerance in (
        ("wrist_position", 3, 5e-4),
        ("u", 6, 5e-4),
        ("u_velocity", 3, 0.01),
    ):
        both = (getattr(rollout.probed, name)[..., :size] for rollout in (moving, still))
        np.testing.assert_allclose(*both, atol=tolerance, err_msg=name)
    height = np.zeros(215)
    height[145:] = frames(0.15).height[1:71]
    up = height[:, None, None] * np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(
        moving.probed.object_position, moving.trace.object_position - up, atol=1e-6
    )
    np.testing.assert_allclose(
        moving.trace.wrist_position - up, moving.probed.wrist_position, atol=1e-6
    )
    assert height[-1] == pytest.approx(0.15, abs=1e-6)
    turns = Rotation.from_quat(start().reset_state.base_quaternion, scalar_first=True)
    risen = turns.apply((moving.trace.u - still.trace.u)[-1, :, :3])
    np.testing.assert_allclose(risen, np.tile([0.0, 0.0, 0.15], (BATCH, 1)), atol=5e-4)


def test_pushes_reach_the_object_through_the_environment():
    """Half of the weight along x from the third step on."""
    rollout = released(protocol(start=NEVER)._replace(push_start=np.float32(2)), 12)
    way = np.diff(rollout.trace.object_position, axis=0) / TASK.control_dt
    np.testing.assert_allclose(way[0, :, 0], 0.0, atol=1e-3)
    # The speed over a control step is that in its middle, but for half a substep.
    np.testing.assert_allclose(way[-1, :, 0], 0.5 * 9.81 * 9.5 * TASK.control_dt, rtol=0.03)
    np.testing.assert_allclose(way[-1, :, 1], 0.0, atol=5e-3)


def test_steps_after_the_hold_change_no_metric(monkeypatch):
    monkeypatch.setattr(protocols, "PUSH_S", 0.05)
    steps = TASK.approach_steps + TASK.hold_steps
    after = protocols.stress_steps(TASK)
    plain = suite.worker(renewed=False)
    conditions = suite.episodes(BATCH)
    acts = suite.command(fingers=0.5)
    plain.begin(conditions)
    ended, measured = (
        under(protocols.stress(TASK, OBJECTS, TASK.hold_steps), conditions) for _ in range(2)
    )
    measured.state = measured.state._replace(after=jnp.full_like(measured.state.after, after))
    bare, one, other = (each.collect(acts, steps) for each in (plain, ended, measured))
    np.testing.assert_array_equal(one.observation, other.observation)
    assert one.has_episode.all()
    assert one.terminal[-1].all()
    assert other.has_episode.all()
    np.testing.assert_array_equal(one.episodes, other.episodes)
    # A program without the probe may round otherwise, and what is left of two lengths is as wrong
    # as these are.
    np.testing.assert_allclose(bare.episodes, one.episodes, rtol=1e-5, atol=1e-5)
    assert not other.terminal.any()
    rest = measured.collect(acts, after)
    np.testing.assert_array_equal(rest.episodes, one.episodes)
    assert not rest.has_episode.any()
    assert rest.terminal[-1].all()
    assert not rest.terminal[:-1].any()
    samples = jax.tree.map(lambda *x: np.concatenate(x), other.probed.sample, rest.probed.sample)
    measures = protocols.assess(samples, np.ones(BATCH, bool), TASK, TASK.hold_steps)
    assert set(measures) == WITHOUT_MESHES
    assert all(np.isfinite(value).all() for value in measures.values())
    short = protocols.assess(other.probed.sample, np.ones(BATCH, bool), TASK, TASK.hold_steps)
    assert np.isnan(short["push_survival"]).all()
    assert short["wrist_speed"] == pytest.approx(measures["wrist_speed"])
    for each in (plain, ended, measured):
        each.physics.close()


def path(**moves: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """The way of one grasp whose object moves (m) and turns (degrees) against the wrist at some of
    the steps.
    """
    steps = protocols.stress_steps(TASK) + 1
    position = np.zeros((steps, 1, 3))
    angle = np.zeros(steps)
    for step, (metres, degrees) in moves.items():
        position[int(step[1:]) :, 0, 1] += metres
        angle[int(step[1:]) :] += degrees
    return position, Rotation.from_euler("z", angle[:, None], degrees=True).as_quat(
        scalar_first=True
    )[:, None]


@pytest.mark.parametrize(
    ("moves", "survived"),  # lift, pushes by weight, all pushes
    [
        ({}, (1, 1, 1)),
        ({"s30": (0.051, 0.0)}, (0, 0, 0)),
        ({"s100": (0.051, 0.0)}, (1, 0, 0)),
        ({"s300": (0.0, 15.1)}, (1, 1, 0)),
        # Each from where it began
        (
            {"s30": (0.03, 10.0), "s100": (0.03, 10.0), "s300": (0.03, 10.0)},
            (1, 1, 1),
        ),
        # At any time
        (
            {"s300": (0.03, 8.0), "s310": (0.03, 0.0), "s320": (-0.03, 0.0)},
            (1, 1, 0),
        ),
    ],
)
def test_survival_is_within_5_cm_and_15_degrees(moves, survived):
    survival = protocols.survival(*path(**moves), np.array([True]), TASK)
    assert tuple(survival[name][0] for name in protocols.SURVIVAL_NAMES) == survived
    lost = protocols.survival(*path(**moves), np.array([False]), TASK)
    assert not any(lost[name][0] for name in protocols.SURVIVAL_NAMES)


@pytest.mark.slow
def test_attempts_with_a_lift_end_higher_in_the_world():
    """They have programs of their own: a lift off the table, and the policy of a bundle."""
    obj = OBJECTS[1]
    count = TASK.surface_points
    hold = TASK.hold_steps
    drawn = suite.episodes(4 * BATCH)
    drawn = jax.tree.map(lambda rows: rows[drawn.reset_state.object_index == 1][:2], drawn)
    rest = np.concatenate(
        [drawn.reset_state.object_position, drawn.reset_state.object_quaternion], -1
    )
    surface = Surface(
        np.tile(obj.points[:count], (2, 1, 1)), np.tile(obj.non_graspable_points[:count], (2, 1))
    )
    inactive = {constraint.name: np.zeros(2, bool) for constraint in optional(TASK)}
    attempts = Attempts(HAND, TASK, suite.policy(), threads=1, phases=Phases(lift=0.06, hold=0.0))
    outcome = attempts.run(obj, RequestedEpisodes(drawn.goal, inactive, surface, rest))
    attempts.close()
    approach = TASK.approach_steps
    lift = protocols.lift_steps(TASK, 0.06)
    assert attempts.steps == approach + lift + hold == len(outcome.trace.q)
    dt = TASK.control_dt
    assert attempts.begins == {
        "grasp": 0.0,
        "lift": approach * dt,
        "hold": pytest.approx((approach + lift) * dt),
    }
    assert set(outcome.metrics) > WITHOUT_MESHES
    way = outcome.trace.wrist_position[-1] - outcome.trace.wrist_position[approach - 1]
    slid = (outcome.trace.u[-1] - outcome.trace.u[approach - 1])[:, :3]
    assert (way[:, 2] > 0.04).all()
    assert np.diff(outcome.trace.wrist_position[approach:, :, 2], axis=0).max() < 0.02
    # The untrained hand leaves the object, and the table under it remains: it is where it was, and
    # not held.
    assert outcome.trace.table.all()
    assert not outcome.metrics["held"].any()
    assert (outcome.trace.object_position[-1, :, 2] > 0.5 * rest[:, 2]).all()
    np.testing.assert_allclose(
        np.linalg.norm(way, axis=-1), np.linalg.norm(slid, axis=-1), atol=1e-5
    )
