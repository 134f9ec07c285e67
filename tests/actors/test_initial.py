"""What episodes start from: references that are drawn, and a hand that begins where its constraints
let it.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.actors.draws import sample
from congrasp.actors.initial import InitialConditions
from congrasp.actors.initial_hand import initial_hand
from congrasp.common.hands.kinematics import hand_center, keypoints, link_transforms
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import optional
from congrasp.common.task.constraints.heading import heading_wrist_pose
from congrasp.common.task.constraints.priority import resolve
from congrasp.common.task.constraints.trajectory import closing
from congrasp.common.task.features import scene_of
from congrasp.common.task.geometry import in_world
from congrasp.common.task.metrics import errors
from congrasp.common.task.reward import reward_terms
from congrasp.common.task.sampling.bank import ConstraintBank
from congrasp.common.task.types import Goal, Surface
from tests import task as suite
from tests.scenes import F, K, quaternions, scene, units
from tests.task import HAND

TASK = dataclasses.replace(suite.TASK, surface_points=16)
"""Surfaces of two points each, in which most of the time would go."""
BATCH = 2000
M = 6


def _bank(valid: np.ndarray) -> ConstraintBank:
    """Two objects with a graspable point at x = 10 cm and one to avoid at -10 cm, in one resting
    pose.

    Pose m has the angle m in all its joints, and trajectory m ends at x = m - 2.5 cm: nearer to the
    graspable point from m = 3 on.

    Args:
      valid: (M,) bool, the references that the table leaves room for.
    """
    rng = np.random.default_rng(0)
    points = np.zeros((2, TASK.surface_points, 3), np.float32)
    points[..., 0] = np.where(np.arange(TASK.surface_points) % 2, -0.1, 0.1)
    number = np.broadcast_to(np.arange(M, dtype=np.float32)[:, None], (2, 2, M, 1))
    path = np.zeros((2, 2, M, K, 3), np.float32)
    path[..., 0] = 0.01 * (number - 2.5)
    headings = (2, 2, 8)
    return ConstraintBank(
        points=points,
        avoid=points[..., 0] < 0,
        normals=np.sign(points),
        rest=np.tile(np.array([0, 0, 0.1, 1, 0, 0, 0], np.float32), (2, 1, 1)),
        heading_position=np.zeros((*headings, 3), np.float32),
        heading_direction=units(rng, *headings),
        heading_cross=units(rng, *headings),
        heading_index=np.tile(np.arange(8, dtype=np.int32), (2, 2, 1, 1)),
        heading_back=np.zeros((2, 2, 1, 8), np.float32),
        pose_q=np.tile(number, F),
        pose_position=np.zeros((2, 2, M, 3), np.float32),
        pose_quaternion=quaternions(rng, 2, 2, M),
        trajectory_position=path,
        trajectory_quaternion=quaternions(rng, 2, 2, M, K),
        pose_valid=np.broadcast_to(valid, (2, 2, 1, M)),
        has_affordance=np.ones((2, 1), bool),
        weight=np.ones(2, np.float32),
        mass=np.array([0.1, 1.0], np.float32),
        renewable=np.ones(2, bool),
        grasps=np.zeros((2, 2), int),
    )


# Hundreds of episodes at once, of a bank whose references are known: a program of its own.
@functools.partial(jax.jit, static_argnums=0)
def _sample(task: TaskConfig, bank: ConstraintBank, together: float) -> InitialConditions:
    """Initial conditions of many episodes; `together` is the task's `p_together`."""
    return sample(
        HAND, dataclasses.replace(task, p_together=together), bank, jax.random.key(3), BATCH
    )


@jax.jit
def _begun(
    surface: Surface, requested: Goal, constraints: dict[str, np.ndarray]
) -> tuple[Any, ...]:
    """The goal after the priority rules, the fingers at the start, and the wrist that aligns them
    with the heading.
    """
    goal = resolve(HAND, surface, requested, constraints).goal
    rest = jnp.tile(jnp.array([0, 0, 0.1, 1.0, 0, 0, 0]), (4, 1))
    q = initial_hand(HAND, TASK, goal, surface, rest)[0]
    center = hand_center(HAND, keypoints(HAND, link_transforms(HAND, q)))
    return goal, q, heading_wrist_pose(HAND, goal["heading"], center)


_in_world = jax.jit(in_world)


@functools.cache
def _heading(task: TaskConfig) -> Callable:
    """Reward and error of the heading's position, from state, surface and goal."""

    def found(*step: Any) -> tuple[jax.Array, jax.Array]:
        here = scene_of(HAND, task, *step)
        return reward_terms(here, task.reward)["heading_position"], errors(here)["heading_m"][0]

    return jax.jit(found)


@functools.cache
def _drawn(
    task: TaskConfig, valid: tuple[int, ...] = tuple(range(M)), together: float = 0.0
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Which blocks are active, and numbers of pose and trajectory, in many episodes; an affordance
    that a pose overrides is not active, but is told by the region."""
    drawn = jax.device_get(_sample(task, _bank(np.isin(np.arange(M), valid)), together))
    active = {name: np.asarray(block) for name, block in drawn.goal.active.items()} | {
        "region": np.asarray(drawn.region) == 1
    }
    trajectory = np.asarray(drawn.goal["trajectory"].position)[:, -1, 0] / 0.01 + 2.5
    return (
        active,
        np.asarray(drawn.goal["pose"].q)[:, 0].round().astype(int),
        trajectory.round().astype(int),
    )


def test_trajectories_ending_near_the_avoid_region_exclude_affordances():
    active, _, trajectory = _drawn(TASK)
    both = active["trajectory"] & active["region"]
    alone = active["trajectory"] & ~active["region"]
    assert set(trajectory[both]) == {3, 4, 5}
    assert set(trajectory[alone]) == set(range(M))
    assert 0.2 < both.mean() < 0.3


def test_a_disturbance_never_makes_a_trajectory_contradict_an_affordance():
    """Trajectories 3, 4 and 5 end 5, 15 and 25 mm on the graspable side, and disturbances have up
    to 10 mm.
    """
    task = dataclasses.replace(TASK, disturbed_references=1.0)
    drawn = jax.device_get(_sample(task, _bank(np.ones(M, bool)), 0.0))
    region = np.asarray(drawn.region) == 1
    on = np.asarray(drawn.goal.active["trajectory"])
    end = np.asarray(drawn.goal["trajectory"].position)[:, -1]
    both = region & on
    assert (end[both, 0] > 0).all()
    # Those that would have contradicted it are as they were; the rest, and those without
    # affordance, are disturbed.
    exact = np.isclose(end[:, 0], 0.005, atol=1e-6) & np.isclose(end[:, 1], 0.0, atol=1e-9)
    assert 0.02 < exact[both].mean() < 0.2
    assert not exact[on & ~region].any()
    assert end[both, 1].std() > 0.003
    assert (end[on & ~region, 0] < 0).any()


@pytest.mark.parametrize("share", [0.6, 1.0])
def test_a_share_of_the_affordances_gets_a_trajectory_as_well(share):
    """By hand: 1/2 of the episodes have an affordance, 1/2 of these no pose, 1/2 of these a
    trajectory anyway.
    """
    active, _, trajectory = _drawn(TASK, together=share)
    both = active["trajectory"] & active["affordance"]
    assert both.mean() == pytest.approx(0.25 * (0.5 + 0.5 * share), abs=0.03)
    assert set(trajectory[both]) == {3, 4, 5}
    before = _drawn(TASK)[0]
    for name in ("affordance", "pose_finger", "region"):
        np.testing.assert_array_equal(active[name], before[name])
    # Only episodes whose affordance counts get one more; the others are those of independent draws.
    assert not (active["trajectory"] & ~before["trajectory"] & ~active["affordance"]).any()
    assert not (before["trajectory"] & ~active["trajectory"]).any()


@pytest.mark.parametrize("together", [0.0, 1.0])
def test_no_trajectory_is_drawn_if_all_contradict_the_affordance(together):
    active, pose, trajectory = _drawn(TASK, (0, 1, 2), together=together)
    assert not (active["trajectory"] & active["region"]).any()
    assert active["affordance"].any()
    assert set(pose[active["pose_finger"] & active["region"]]) == {0, 1, 2}
    assert set(trajectory[active["trajectory"]]) == {0, 1, 2}


def test_pose_and_trajectory_are_drawn_independently():
    active, pose, trajectory = _drawn(TASK)
    both = active["pose_finger"] & active["trajectory"] & ~active["region"]
    pairs = np.histogram2d(pose[both], trajectory[both], bins=np.arange(M + 1) - 0.5)[0]
    assert pairs.min() > 0
    # 36 cells of some seven each: chi squared with 35 degrees of freedom
    expected = pairs.sum() / M**2
    assert ((pairs - expected) ** 2 / expected).sum() < 80


@pytest.mark.parametrize("few", [False, True])
def test_aligned_pairs_are_drawn_on_request(few):
    active, pose, trajectory = _drawn(
        dataclasses.replace(TASK, aligned_references=True),
        (0, 1, 2, 3, 5) if few else tuple(range(M)),
    )
    both = active["pose_finger"] & active["trajectory"]
    np.testing.assert_array_equal(pose[both], trajectory[both])
    assert set(pose[both & active["region"]]) == ({3, 5} if few else {3, 4, 5})
    assert set(pose[both & ~active["region"]]) == ({0, 1, 2, 3, 5} if few else set(range(M)))
    alone = active["pose_finger"] & ~active["trajectory"] & active["region"]
    assert set(pose[alone]) == ({0, 1, 2, 3, 5} if few else set(range(M)))


@pytest.mark.parametrize("on", [{"pose"}, {"pose", "trajectory"}, {"trajectory"}, set()])
@pytest.mark.parametrize("dynamic", [True, False])
def test_heading_guidance_and_reward_share_the_hand_centre(dynamic, on):
    """Where the hand is at its target, the heading that the rules made is met to 0 m.

    With the fingers of its start, but under a trajectory alone with those of the partly closed
    hand.
    """
    task = dataclasses.replace(TASK, dynamic_center=dynamic)
    state, surface, goal = scene(21)
    goal, q, aligned = _begun(
        surface, goal, {c.name: np.full(4, c.name in on) for c in optional(TASK)}
    )
    if on == {"trajectory"}:
        q = np.tile(closing(HAND), (4, 1))
    wrist = goal["trajectory"] if "trajectory" in on else goal["pose"] if on else aligned
    here = (np.asarray(array).reshape(4, -1, array.shape[-1])[:, -1] for array in wrist[-2:])
    position, quaternion = _in_world(state.object_position, state.object_quaternion, *here)
    there = state._replace(
        q=np.asarray(q),
        q_initial=np.asarray(q),
        u=np.zeros((4, 6), np.float32),
        base_position=np.asarray(position),
        base_quaternion=np.asarray(quaternion),
    )
    for value in _heading(task)(there, surface, goal):
        np.testing.assert_allclose(value, 0.0, atol=1e-5)
    still = _heading(task)(there._replace(q=state.q_target), surface, goal)[1]
    assert (np.asarray(still) < 1e-5).all() != dynamic
