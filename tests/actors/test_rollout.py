"""Episodes: sampling, protocol, success, and rollouts that continue."""

import dataclasses
import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.actors import rollout as rollout_module
from congrasp.actors.env import GraspEnv
from congrasp.actors.episode import object_pieces
from congrasp.actors.physics.engine import PhysicsState, where_environments
from congrasp.actors.physics.native import NativePhysics
from congrasp.actors.rollout import Programs, finished_episodes, no_probe
from congrasp.actors.worker import RolloutWorker
from congrasp.common import chance, rotations
from congrasp.common.hands.kinematics import capsules, grasp_frame, keypoints, link_transforms
from congrasp.common.objects import procedural
from congrasp.common.task.constraints import blocks
from congrasp.common.task.geometry import hand_center
from congrasp.common.task.metrics import episode_fields, metric_names
from congrasp.common.task.observation import layout
from congrasp.common.task.types import CONTACTS_PER_LINK, Action
from tests import task as suite
from tests.compiled import program_count
from tests.task import BATCH, HAND, TASK

STEPS = TASK.approach_steps + TASK.hold_steps
NOISY = suite.command(noise=0.3)
STILL = suite.command()


@pytest.fixture(scope="module")
def drawn():
    """So many episodes that shares of them can be counted."""
    return suite.episodes(2000)


def test_masks_have_the_shares_of_the_task(drawn):
    named = {block: np.asarray(active, float) for block, active in drawn.goal.active.items()}
    assert set(named) == set(blocks(TASK))
    for block, share in (("trajectory", TASK.p_trajectory), ("pose_finger", TASK.p_pose)):
        assert abs(named[block].mean() - share) < 0.08
    assert np.all(named["pose_wrist"] == named["pose_finger"] * (1 - named["trajectory"]))
    assert not np.any(named["affordance"] * named["pose_finger"])  # the pose overrides it
    assert np.all(np.asarray(drawn.hold) == TASK.hold_steps)


def test_the_hand_starts_at_the_first_waypoint_or_backed_off_along_the_heading(drawn):
    """Exactly, as far back as the random number of each episode says; a hand in the table is raised
    to 5 mm over it.
    """
    start, goal, *_ = drawn
    direction, v, center, target, lowest = jax.device_get(_heading(start, goal))
    near, far = TASK.back_off_range
    back = near + (far - near) * np.asarray(
        _distances(jax.random.split(jax.random.key(3), len(center) // BATCH))
    )
    turn = Rotation.from_quat(start.object_quaternion, scalar_first=True)
    first = turn.apply(goal["trajectory"].position[:, 0]) + start.object_position
    trajectory = goal.active["trajectory"][:, None]
    raised = np.where(
        trajectory, start.base_position - first, center - target + back.reshape(-1, 1) * direction
    )
    np.testing.assert_allclose(raised[:, :2], 0.0, atol=1e-4)
    np.testing.assert_allclose(
        raised[:, 2], np.maximum(0.005 - (lowest - raised[:, 2]), 0.0), atol=1e-4
    )
    assert 0.01 < (raised[:, 2] > 1e-4).mean() < 0.1
    np.testing.assert_allclose(np.where(trajectory, direction, v), direction, atol=1e-4)
    pose = goal.active["pose_finger"]
    np.testing.assert_allclose(start.q[pose], goal["pose"].q[pose], atol=1e-6)


@jax.jit
@jax.vmap
def _distances(key):
    """(B,) random numbers in [0, 1) that decide on the starts of a batch: sixth of those of
    training.
    """
    return chance.uniforms(key, {"training": 8}, BATCH)["training"][:, 5]


@jax.jit
def _heading(start, goal):
    """Desired and actual direction of the hand, its centre and the desired one, and its lowest
    point, world frame.
    """
    allowed = goal["fingers"].allowed | ~goal.active["fingers"][:, None]
    links = link_transforms(HAND, start.q)
    center = hand_center(HAND, keypoints(HAND, links), allowed)
    ends = capsules(HAND, links).reshape(len(center), -1, 3)
    ends = rotations.rotate(start.base_quaternion[:, None], ends) + start.base_position[:, None]
    return (
        rotations.rotate(start.object_quaternion, goal["heading"].direction),
        rotations.rotate(
            start.base_quaternion, jnp.broadcast_to(grasp_frame(HAND).heading, center.shape)
        ),
        rotations.rotate(start.base_quaternion, center) + start.base_position,
        rotations.rotate(start.object_quaternion, goal["heading"].position) + start.object_position,
        jnp.min(ends[..., 2] - np.repeat(HAND.capsule_radii, 2), -1),
    )


def test_rollouts_go_through_whole_episodes_and_on():
    worker = suite.worker()
    first = worker.collect(NOISY, STEPS)
    size = sum(size for _, size in layout(HAND, TASK))
    assert first.observation.shape == (STEPS, BATCH, size)
    assert first.observation.dtype == np.float16
    assert np.isfinite(np.asarray(first.observation, np.float32)).all()
    terminal = np.asarray(first.terminal)
    assert terminal[-1].all()
    assert not terminal[:-1].any()
    episodes = finished_episodes(first, TASK)
    assert set(episodes) == set(episode_fields(TASK))
    assert len(episodes["episode/return"]) == BATCH
    np.testing.assert_allclose(
        episodes["episode/return"], np.asarray(first.reward).sum(0), rtol=1e-3
    )
    terms = sum(values for name, values in episodes.items() if name.startswith("term/"))
    np.testing.assert_allclose(terms, episodes["episode/return"], rtol=1e-3, atol=1e-2)
    assert np.all(episodes["episode/length"] == STEPS)
    present = np.arange(1, STEPS + 1) < TASK.approach_steps
    np.testing.assert_array_equal(first.trace.table, np.tile(present[:, None], BATCH))
    second = worker.collect(NOISY, 30)
    assert not np.asarray(second.terminal).any()
    assert not len(finished_episodes(second, TASK)["episode/return"])
    # The first observation of a rollout is the last one of the rollout before.
    np.testing.assert_array_equal(second.observation[0], first.last_observation)
    assert np.all(np.asarray(worker.state.time) == 30)
    worker.restart()
    assert not np.asarray(worker.state.time).any()
    third = worker.collect(NOISY, 1)
    np.testing.assert_allclose(
        third.trace.object_position[0], worker.state.reset_state.object_position, atol=0.01
    )
    _replaced_objects_rest_where_they_were_placed(worker)
    worker.physics.close()


def _replaced_objects_rest_where_they_were_placed(worker):
    others = suite.OBJECTS[::-1]
    bank = jax.tree.map(lambda rows: rows[::-1], suite.bank())
    worker.replace_objects(others, bank)
    worker.restart()
    index = np.asarray(worker.state.reset_state.object_index)
    np.testing.assert_array_equal(worker.state.surface.points, np.asarray(bank.points)[index])
    heights = np.asarray(worker.state.reset_state.object_position)[:, 2]
    for i, height in zip(index, heights, strict=True):
        assert np.abs(others[i].rest_poses[:, 2] - height).min() < 1e-5
    worker.collect(NOISY, 3)
    # A wrong shape would fall, or the table would throw it up.
    np.testing.assert_allclose(
        np.asarray(worker.state.views.true.state.object_position)[:, 2], heights, atol=2e-3
    )


def test_success_needs_the_object_to_stay_up():
    """Hands that go up from half a metre above the table touch nothing: every object falls, and
    none succeeds.
    """
    worker = suite.worker()
    drawn = suite.episodes(BATCH)
    far = drawn.reset_state.base_position + np.array([0.0, 0.0, 0.5], np.float32)
    worker.begin(drawn._replace(reset_state=drawn.reset_state._replace(base_position=far)))
    rollout = worker.collect(suite.command(lift=20.0), STEPS)
    episodes = finished_episodes(rollout, TASK)
    assert np.asarray(rollout.terminal)[-1].all()
    assert not np.asarray(rollout.truncated).any()
    assert not episodes["episode/links_at_removal"].any()
    assert not episodes["episode/success"].any()
    assert (episodes["term/drop"] < 0).all()
    worker.physics.close()


@pytest.fixture
def follow():
    """A function that returns the state after steps whose readouts of the engine are invented, and
    its transitions.
    """
    worker = suite.worker()

    def run(hold, steps, shown):
        """`shown(step, first)` is the readout of a step, from 1 on, of episodes that hold for so
        long.
        """
        worker.begin(suite.episodes(BATCH)._replace(hold=np.full(BATCH, hold, np.int32)))
        programs = worker.programs
        key_data = np.asarray(jax.random.key_data(jax.random.key(0)))
        parameters, settings, key = suite.placed((STILL, worker.env.settings, jax.random.key(0)))
        first = jax.device_get(worker.physics.read(None))
        state = worker.state
        transitions = []
        decision = programs.decide(parameters, settings, state, key)
        state = state._replace(views=None)
        for step in range(1, steps + 1):
            changed, transition, _, decision = programs.advance(
                parameters, settings, state, shown(step, first), decision, key_data
            )
            state = state._replace(**changed)
            transitions.append(jax.device_get(transition))
        return dict(
            zip(episode_fields(TASK), np.asarray(state.finished).T, strict=True)
        ), transitions

    yield run
    worker.physics.close()


def _touched(first, force, fallen, drop=0.06):
    """A readout in which one link presses with a force, and objects fell by more than the 5 cm that
    count.
    """
    contact_found = np.zeros_like(first.contact_found)
    forces = np.zeros_like(first.contact_force)
    contact_found[:, 0, 0] = True
    forces[:, 0, 0, 0] = force
    position = first.object_position.copy()
    position[fallen, 2] -= drop
    return first._replace(
        contact_found=contact_found, contact_force=forces, object_position=position
    )


def test_a_lifted_object_that_stays_is_a_success(follow):
    finished, _ = follow(
        TASK.hold_steps,
        STEPS,
        lambda step, first: _touched(first, 1.0, [1] if step > TASK.approach_steps + 5 else []),
    )
    np.testing.assert_array_equal(finished["episode/success"], np.arange(BATCH) != 1)
    assert set(metric_names(TASK)) <= {name.removeprefix("episode/") for name in finished}


def test_a_longer_hold_changes_neither_success_nor_the_errors(follow):
    """Errors and forces are those of the paper's 25 steps; only `held` depends on the end of the
    hold.

    The first object falls in step 131 of 140, after these; its episode ends there.
    """

    def shown(step, first):
        return _touched(first, 3.0 if step <= STEPS else 30.0, [0] if step > STEPS + 5 else [])

    finished, transitions = follow(TASK.hold_steps + 15, STEPS + 15, shown)
    terminal = np.array([transition.terminal for transition in transitions])
    truncated = np.array([transition.truncated for transition in transitions])
    np.testing.assert_array_equal(
        np.argmax(terminal, 0) + 1, [STEPS + 6, *[STEPS + 15] * (BATCH - 1)]
    )
    # The clock ends the others: an end of an object that is up is a truncation.
    np.testing.assert_array_equal(
        np.argwhere(truncated), [[STEPS + 14, i] for i in range(1, BATCH)]
    )
    assert finished["episode/success"].all()
    np.testing.assert_array_equal(finished["episode/held"], np.arange(BATCH) > 0)
    np.testing.assert_allclose(finished["episode/force_sum"], 3.0, rtol=1e-5)


def test_a_fallen_object_ends_no_episode_without_end_when_fallen():
    """Without `end_when_fallen` the clock ends the episode of a fallen object, which is no
    truncation.
    """
    physics = NativePhysics(HAND, TASK, suite.OBJECTS, 1)
    first = jax.device_get(physics.start((drawn := suite.episodes(BATCH)).reset_state).read(None))
    env = GraspEnv(HAND, dataclasses.replace(TASK, end_when_fallen=False), None)
    state = env.state_of(drawn._replace(hold=np.full(BATCH, TASK.hold_steps + 1, np.int32)), None)
    state = state._replace(time=jnp.full(BATCH, STEPS - 1))
    advance = jax.jit(
        lambda state, after: env.advance(
            state, Action(state.q_target, state.u_target), after, env.settings
        )
    )
    for end in (False, True):
        state, transition = advance(state._replace(views=None), _touched(first, 1.0, slice(None)))
        assert (np.asarray(transition.terminal) == end).all()
        assert not np.asarray(transition.truncated).any()
    physics.close()


def test_workers_with_the_same_seed_agree_bit_for_bit():
    a, b = (suite.worker(seed=5).collect(NOISY, 20) for _ in range(2))
    np.testing.assert_array_equal(a.reward, b.reward)
    np.testing.assert_array_equal(a.observation, b.observation)


class _Touching:
    """A compiled engine in which every hand touches always, and whose `read` knows no contacts, as
    that of MJX.
    """

    name = "touching"
    compiled = True

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
        batch = start.q.shape[0]
        links = len(HAND.links)
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


def _compiled(caplog):
    """Names of the programs that this thread lowered or compiled."""
    compiled = [
        re.search(r"(conversion|compilation of) jit\((\w+)\)", record.getMessage())
        for record in caplog.records
    ]
    return {match[2] for match in compiled if match}


def test_a_continuing_environment_keeps_its_contacts_when_another_restarts(caplog):
    """A compiled engine's program is one loop, which shares nothing with other tests': here of
    headings alone.
    """
    physics = _Touching()
    task = dataclasses.replace(TASK, constraints=("heading",))
    worker = RolloutWorker(
        HAND,
        task,
        physics,
        None,
        suite.commanded,
        batch=2,
        seed=0,
        half_precision=False,
        traced="none",
    )
    with (
        jax.log_compiles()
    ):  # its programs are compiled before there is a bank or a policy, and not again
        worker.compile(
            jax.eval_shape(suite.bank), jax.ShapeDtypeStruct(NOISY.shape, NOISY.dtype), 7
        )
        ahead = _compiled(caplog)
        caplog.clear()
        worker.start(suite.bank())
        state = worker.state
        worker.state = state._replace(
            time=jnp.array([120, 120]),
            hold=jnp.array([25, 100]),
            success=state.success._replace(links_at_removal=jnp.ones(2)),
        )
        rollout = worker.collect(NOISY, 7)
    assert ahead == {"_scan", "_sample", "_begin", "renew"}
    assert not ahead & _compiled(caplog)
    flags = 3 * len(HAND.joints) + 18  # where the contact flags begin in the observation
    assert np.argwhere(rollout.truncated).tolist() == [[4, 0]]
    touching = np.asarray(rollout.observation)[..., flags : flags + len(HAND.links)].all(-1)
    assert np.asarray(rollout.terminal)[:, 0].tolist() == [False] * 4 + [True, False, False]
    # Environment 0 restarts at step 5 without contacts; the very first step has none either.
    assert touching[:, 0].tolist() == [False, True, True, True, True, False, True]
    assert touching[:, 1].tolist() == [False] + [True] * 6


def test_episodes_drawn_in_small_batches_equal_one_draw(monkeypatch):
    """A program of its own, of headings alone: five environments restart, two at a time."""
    task = dataclasses.replace(TASK, constraints=("heading",))
    settings = {
        "batch": BATCH,
        "half_precision": True,
        "probe": no_probe,
        "traced": "none",
        "taught": False,
    }
    monkeypatch.setattr(rollout_module, "LEAST_RENEWED", 2)
    programs = Programs(HAND, task, None, suite.commanded, **settings)
    bank = suite.bank()
    old, new = jax.random.split(jax.random.key(0))
    ended = np.array([True, False, True, True, False, True, False, True])
    state = programs.begin(programs.sample(bank, old, np.array(False)), None)._replace(
        time=jnp.full(BATCH, 9)
    )
    renewed = programs.renew(bank, state, new, np.array(False), ended)
    drawn = programs.begin(programs.sample(bank, new, np.array(False)), None)._replace(
        grasps=state.grasps
    )
    for after, fresh, before in zip(*map(jax.tree.leaves, (renewed, drawn, state)), strict=True):
        np.testing.assert_array_equal(after[~ended], before[~ended])
        np.testing.assert_allclose(after[ended], fresh[ended], rtol=1e-5, atol=1e-6)
    assert not np.array_equal(state.reset_state.q, drawn.reset_state.q)


def test_workers_of_one_task_share_programs_that_compile_once():
    """A worker's seed, the number of steps, and whether the parameters are committed to a device do
    not matter.
    """
    programs = suite.programs()
    sizes = set()
    for steps, parameters in enumerate((NOISY, jnp.asarray(NOISY), suite.placed(NOISY)), 1):
        worker = suite.worker(seed=steps)
        worker.collect(parameters, steps)
        worker.restart()
        before = program_count(programs.renew)
        worker.weigh_objects(np.asarray(worker.bank.weight))
        worker.restart()
        assert worker.programs is programs
        assert program_count(programs.renew) == before
        compiled = programs.decide, programs.advance, programs.sample, programs.with_scene
        sizes.add(tuple(map(program_count, compiled)))
        worker.physics.close()
    assert len(sizes) == 1


@pytest.mark.parametrize(("name", "most"), [("sample", 4100), ("advance", 4750), ("decide", 1630)])
def test_programs_stay_small(name, most):
    """Compiling costs in proportion to a program's equations; a bound is a tenth above what there
    is.
    """
    worker = suite.worker()
    programs = suite.programs()
    still, settings, key = suite.placed((STILL, worker.env.settings, jax.random.key(0)))
    readout = worker.physics.read(None)
    state = worker.state
    decision = programs.decide(still, settings, state, key)
    arguments = {
        "sample": (suite.bank(), key, np.array(False)),
        "decide": (still, settings, state, key),
        "advance": (
            still,
            settings,
            state._replace(views=None),
            readout,
            decision,
            jax.random.key_data(key),
        ),
    }
    counted = _equations(jax.make_jaxpr(getattr(programs, name))(*arguments[name]).jaxpr)
    assert 0.6 * most < counted <= most, counted
    worker.physics.close()


def _equations(program) -> int:
    """Equations of a jaxpr and of those within it."""
    count = 0
    for equation in program.eqns:
        inner = list(itertools.chain(*map(_programs_in, equation.params.values())))
        count += sum(map(_equations, inner)) if inner else 1
    return count


def _programs_in(value):
    values = value if isinstance(value, (tuple, list)) else (value,)
    return [
        getattr(one, "jaxpr", one)
        for one in values
        if hasattr(one, "eqns") or hasattr(one, "jaxpr")
    ]


def test_sizes_are_real_numbers_for_objects_of_meshes_too():
    bowl = procedural.generate(3, "bowl")
    assert {piece.kind for piece in bowl.pieces} == {"mesh"}
    assert object_pieces(bowl).size.dtype == float
