"""Episodes: sampling, protocol, success, and rollouts that continue."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.actors.env import GraspEnv, episode_fields, metric_names
from congrasp.actors.physics.engine import PhysicsState, where_environments
from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.rollout import finished_episodes
from congrasp.actors.worker import RolloutWorker
from congrasp.common import rotations
from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import grasp_frame, hand_center, keypoints, link_transforms
from congrasp.common.objects import procedural
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.constraints import PAPER
from congrasp.common.task.observation import layout
from congrasp.common.task.sampling.build import build_bank
from congrasp.common.task.types import CONTACTS_PER_LINK, Action
from tests import draws

HAND = get_hand("human")
TASK = TaskConfig(approach_steps=50, back_off_range=(0.15, 0.15), initial_speed=0.0, preshape=False)
OBJECTS = procedural.generate_many(4, 0, ("box", "cylinder", "mug", "hammer"))
BATCH = 8  # of most workers here, so that their programs are compiled once
DRAWN = 4000
SIZE = sum(size for _, size in layout(HAND, TASK))


@pytest.fixture(scope="module")
def bank():
    return build_bank(HAND, TASK, OBJECTS, 0)


@pytest.fixture(scope="module")
def drawn(bank):
    """So many episodes that shares of them can be counted."""
    task = dataclasses.replace(TASK, constraints=PAPER)
    return draws.sample(HAND, task, bank, jax.random.key(0), DRAWN)


def _noise(parameters, observation, key):
    action = 0.3 * jax.random.normal(key, (observation.shape[0], len(HAND.joints) + 6))
    return action, -jnp.sum(action**2, -1)


def _worker(bank, seed=0):
    physics = NativePhysics(HAND, TASK, OBJECTS, 2)
    return RolloutWorker(HAND, TASK, physics, bank, _noise, batch=BATCH, seed=seed, half_precision=True)


def test_masks_are_drawn_as_in_the_paper(drawn):
    named = {block: np.asarray(active, float) for block, active in drawn.goal.active.items()}
    assert list(named) == ["affordance", "pose_finger", "pose_wrist", "trajectory"]
    assert abs(named["trajectory"].mean() - 0.5) < 0.08
    assert abs(named["pose_finger"].mean() - 0.5) < 0.08
    assert np.all(named["pose_wrist"] == named["pose_finger"] * (1 - named["trajectory"]))
    assert not np.any(named["affordance"] * named["pose_finger"])  # the pose overrides it
    assert np.all(np.asarray(drawn.hold) == TASK.hold_steps)


def test_the_hand_starts_at_the_first_waypoint_or_backed_off_along_the_heading(drawn):
    start, goal, *_ = drawn
    trajectory = np.asarray(goal.active["trajectory"])
    first = rotations.compose_pose(
        start.object_position,
        start.object_quaternion,
        goal["trajectory"].position[:, 0],
        goal["trajectory"].quaternion[:, 0],
    )
    _raised_at_most(np.asarray(start.base_position - first[0])[trajectory])
    # Otherwise v points along v-bar, and the hand centre lies 15 cm before p-bar.
    direction = np.asarray(rotations.rotate(start.object_quaternion, goal["heading"].direction))
    v = np.asarray(rotations.rotate(start.base_quaternion, jnp.broadcast_to(grasp_frame(HAND).heading, (DRAWN, 3))))
    np.testing.assert_allclose(v[~trajectory], direction[~trajectory], atol=1e-4)
    center = hand_center(HAND, keypoints(HAND, link_transforms(HAND, start.q)))
    center = np.asarray(rotations.rotate(start.base_quaternion, center) + start.base_position)
    target = np.asarray(rotations.rotate(start.object_quaternion, goal["heading"].position) + start.object_position)
    _raised_at_most((center + TASK.back_off * direction - target)[~trajectory])
    pose = np.asarray(goal.active["pose_finger"])
    np.testing.assert_allclose(np.asarray(start.q)[pose], np.asarray(goal["pose"].q)[pose], atol=1e-6)
    np.testing.assert_allclose(np.asarray(start.q)[~pose], np.tile(HAND.q_open, (DRAWN - pose.sum(), 1)), atol=1e-6)


def _raised_at_most(difference: np.ndarray) -> None:
    """Differences (E, 3) are zero, but for a few starts that are raised out of the table."""
    np.testing.assert_allclose(difference[:, :2], 0.0, atol=1e-4)
    assert difference[:, 2].min() > -1e-4 and (difference[:, 2] < 1e-4).mean() > 0.9


def test_rollouts_go_through_whole_episodes_and_on(bank):
    worker = _worker(bank)
    first = worker.collect(None, 75)
    assert first.observation.shape == (75, BATCH, SIZE) and first.observation.dtype == np.float16
    assert np.isfinite(np.asarray(first.observation, np.float32)).all()
    terminal = np.asarray(first.terminal)
    assert terminal[-1].all() and not terminal[:-1].any()
    episodes = finished_episodes(first, TASK)
    assert set(episodes) == set(episode_fields(TASK)) and len(episodes["episode/return"]) == BATCH
    np.testing.assert_allclose(episodes["episode/return"], np.asarray(first.reward).sum(0), rtol=1e-3)
    terms = sum(values for name, values in episodes.items() if name.startswith("term/"))
    np.testing.assert_allclose(terms, episodes["episode/return"], rtol=1e-3, atol=1e-2)
    assert np.all(episodes["episode/length"] == 75)
    # The table goes after fifty steps.
    np.testing.assert_array_equal(first.trace.table, np.arange(1, 76) < TASK.approach_steps)
    second = worker.collect(None, 30)
    assert not np.asarray(second.terminal).any() and not len(finished_episodes(second, TASK)["episode/return"])
    # The first observation of a rollout is the last one of the rollout before.
    np.testing.assert_array_equal(second.observation[0], first.last_observation)
    assert np.all(np.asarray(worker.state.time) == 30)
    worker.restart()
    assert not np.asarray(worker.state.time).any()
    third = worker.collect(None, 1)
    np.testing.assert_allclose(third.trace.object_position[0], worker.state.reset_state.object_position[0], atol=0.01)
    _other_objects_take_the_place_of_the_first_ones(worker)
    worker.physics.close()


def _other_objects_take_the_place_of_the_first_ones(worker):
    others = procedural.generate_many(4, 50, ("can", "dish", "wrench", "piggy"))
    bank = build_bank(HAND, TASK, others, 1)
    worker.replace_objects(others, bank)
    worker.restart()
    index = np.asarray(worker.state.reset_state.object_index)
    np.testing.assert_array_equal(worker.state.surface.points, np.asarray(bank.points)[index])
    heights = np.asarray(worker.state.reset_state.object_position)[:, 2]
    for i, height in zip(index, heights, strict=True):
        assert np.abs(others[i].rest_poses[:, 2] - height).min() < 1e-5
    worker.collect(None, 3)
    # Each lies where it was put: a wrong shape would fall, or be thrown up by the table.
    np.testing.assert_allclose(np.asarray(worker.state.views.true.state.object_position)[:, 2], heights, atol=2e-3)


def test_success_needs_the_object_to_stay_up(bank):
    """With idle hands far away every object falls, and nobody is credited."""
    task = dataclasses.replace(TASK, back_off=0.5, p_pose=0.0, p_trajectory=0.0)
    away = build_bank(HAND, task, OBJECTS, 0)
    physics = NativePhysics(HAND, task, OBJECTS, 2)
    still = lambda p, o, k: (jnp.zeros((o.shape[0], 26)).at[:, 20:23].set(-20.0), jnp.zeros(o.shape[0]))  # noqa: E731
    worker = RolloutWorker(HAND, task, physics, away, still, batch=BATCH, seed=0, half_precision=True)
    rollout = worker.collect(None, 75)
    episodes = finished_episodes(rollout, task)
    assert np.asarray(rollout.terminal)[-1].all() and not np.asarray(rollout.truncated).any()
    untouched = episodes["episode/links_at_removal"] == 0
    assert untouched.any()
    assert not episodes["episode/success"][untouched].any()
    assert (episodes["term/drop"][untouched] < 0).all()
    physics.close()


def _begun(physics, task, conditions):
    """An environment, its state, and what the engine shows of it."""
    env = GraspEnv(HAND, task, None)
    return env, env.state_of(conditions, None), physics.start(conditions.reset_state).read(None)


def _advance(env, targets):
    """A control step of which the engine's part is given."""
    step = jax.jit(lambda state, after: env.advance(state, targets, after, env.settings))
    return lambda state, after: step(state._replace(views=None), after)


def test_a_lifted_object_that_stays_is_a_success(bank):
    """The protocol's bookkeeping on invented readouts: held up, against dropped by more than 5 cm."""
    physics = NativePhysics(HAND, TASK, OBJECTS, 1)
    env, state, after = _begun(physics, TASK, draws.sample(HAND, TASK, bank, jax.random.key(2), 2))
    found = np.zeros(after.contact_found.shape, bool)
    found[:, 0, 0] = True
    after = after._replace(contact_found=found)
    advance = _advance(env, Action(state.q_target, state.u_target))
    for step in range(75):
        position = np.array(after.object_position)
        if step >= 55:
            position[1, 2] = state.reset_state.object_position[1, 2] - 0.06
        state, _ = advance(state, after._replace(object_position=position))
    finished = dict(zip(episode_fields(TASK), np.asarray(state.finished).T, strict=True))
    np.testing.assert_array_equal(finished["episode/success"], [1.0, 0.0])
    assert set(metric_names(TASK)) <= {name.removeprefix("episode/") for name in finished}
    physics.close()


@pytest.mark.parametrize(("end_when_fallen", "ends"), [(False, [90, 90]), (True, [90, 81])])
def test_a_longer_hold_changes_neither_success_nor_the_errors(bank, end_when_fallen, ends):
    """Errors and forces are those of the paper's 25 steps; only `held` looks at the end of the hold."""
    task = dataclasses.replace(TASK, hold_steps_max=40, end_when_fallen=end_when_fallen)
    physics = NativePhysics(HAND, task, OBJECTS, 1)
    drawn = draws.sample(HAND, task, bank, jax.random.key(2), 2)
    env, state, after = _begun(physics, task, drawn._replace(hold=jnp.full(2, 40)))
    found, force = (
        np.zeros(after.contact_found.shape, bool),
        np.zeros(after.contact_force.shape, np.float32),
    )
    found[:, 0, 0] = True
    advance = _advance(env, Action(state.q_target, state.u_target))
    terminal, truncated = [], []
    for step in range(1, 91):
        position = np.array(after.object_position)
        position[1, 2] -= 0.06 if step > 80 else 0.0
        pressed = force.copy()
        pressed[:, 0, 0, 0] = 3.0 if step <= 75 else 30.0
        shown = after._replace(object_position=position, contact_found=found, contact_force=pressed)
        state, transition = advance(state, shown)
        terminal.append(np.asarray(transition.terminal))
        truncated.append(np.asarray(transition.truncated))
    finished = dict(zip(episode_fields(task), np.asarray(state.finished).T, strict=True))
    np.testing.assert_array_equal(np.argmax(terminal, 0) + 1, ends)
    # The clock ends both episodes at step 90: of an object that is up it is truncation, of a fallen one it is not.
    np.testing.assert_array_equal(np.argwhere(truncated), [[89, 0]])
    np.testing.assert_array_equal(finished["episode/success"], [1.0, 1.0])
    np.testing.assert_array_equal(finished["episode/held"], [1.0, 0.0])
    np.testing.assert_allclose(finished["episode/force_sum"], [3.0, 3.0], rtol=1e-5)
    physics.close()


def test_workers_with_the_same_seed_agree_bit_for_bit(bank):
    a, b = (_worker(bank, seed=5).collect(None, 20) for _ in range(2))
    np.testing.assert_array_equal(a.reward, b.reward)
    np.testing.assert_array_equal(a.observation, b.observation)


class _Touching:
    """A compiled engine in which every hand touches always, and whose `read` knows no contacts, as that of MJX."""

    name, compiled = "touching", True

    def start(self, start):
        return start

    def reset(self, state, mask, start):
        return where_environments(mask, start, state)

    def step(self, state, target, table):
        return state, self._physics_state(state, True)

    def read(self, state):
        return self._physics_state(state, False)

    def close(self):
        pass

    def _physics_state(self, start, touching):
        batch, links = start.q.shape[0], len(HAND.links)
        none = jnp.zeros((batch, 6))
        return PhysicsState(
            q=start.q,
            u=none,
            q_velocity=jnp.zeros_like(start.q),
            u_velocity=none,
            object_position=start.object_position,
            object_quaternion=start.object_quaternion,
            object_velocity=none[:, :3],
            object_angular_velocity=none[:, :3],
            contact_force=jnp.ones((batch, links, CONTACTS_PER_LINK, 3)),
            contact_position=jnp.zeros((batch, links, CONTACTS_PER_LINK, 3)),
            contact_found=jnp.full((batch, links, CONTACTS_PER_LINK), touching),
            diverged=jnp.zeros(batch, bool),
            occupancy=jnp.zeros(3),
        )


def test_an_environment_that_goes_on_keeps_its_contacts_when_another_restarts(bank):
    worker = RolloutWorker(HAND, TASK, _Touching(), bank, _noise, batch=2, seed=0, half_precision=False)
    state = worker.state
    worker.state = state._replace(
        time=jnp.array([70, 70]),
        hold=jnp.array([25, 100]),
        success=state.success._replace(links_at_removal=jnp.ones(2)),
    )
    rollout = worker.collect(None, 7)
    flags = 3 * len(HAND.joints) + 18  # where the contact flags begin in the observation
    assert np.argwhere(rollout.truncated).tolist() == [[4, 0]]
    touching = np.asarray(rollout.observation)[..., flags : flags + len(HAND.links)].all(-1)
    assert np.asarray(rollout.terminal)[:, 0].tolist() == [False] * 4 + [True, False, False]
    # World 0 begins anew at step 5 and has not touched yet; in the very first step nobody has.
    assert touching[:, 0].tolist() == [False, True, True, True, True, False, True]
    assert touching[:, 1].tolist() == [False] + [True] * 6


def test_workers_of_one_task_share_programs_that_compile_once(bank):
    """A worker's seed, the number of steps, and whether the parameters are committed to a device do not matter."""
    first = jnp.zeros(1)
    placed = (first, jax.device_put(first, jax.local_devices()[0]), np.zeros(1, np.float32))
    for steps, parameters in enumerate(placed, 1):
        worker = _worker(bank, seed=steps)
        worker.collect(parameters, steps)
        worker.restart()
        programs = worker.programs
    assert programs is _worker(bank).programs
    compiled = programs.decide, programs.advance, programs.sample, programs.with_scene
    assert [program._cache_size() for program in compiled] == [1, 1, 1, 1]
