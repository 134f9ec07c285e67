"""What every constraint must keep to, so that all that is derived from its one file fits
together.
"""

import dataclasses
import functools
import itertools
from collections import Counter
from collections.abc import Callable

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from congrasp.actors.draws import sample
from congrasp.actors.initial import InitialConditions
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand, kinematics
from congrasp.common.request import GraspRequest
from congrasp.common.task import metrics
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.constraints import (
    CONSTRAINTS,
    OURS,
    PAPER,
    blocks,
    get_constraint,
    goal_of,
    known,
    require_known,
)
from congrasp.common.task.constraints.priority import active_blocks
from congrasp.common.task.control import decode
from congrasp.common.task.features import scene_of as traced_scene
from congrasp.common.task.observation import fields, layout, observe
from congrasp.common.task.reward import GRASP, reward_terms, terms
from congrasp.common.task.types import Goal
from tests import task as suite
from tests.scenes import HAND, F, active, evaluated, moved, scene, scene_of
from tests.task import TASK

NAMES = tuple(constraint.name for constraint in CONSTRAINTS)
OPTIONAL = tuple(constraint for constraint in CONSTRAINTS if constraint.optional)
DRAWN = 256
CHANGES = {"fingers": {"heading", "distance", "heading_position"}, "force": {"force_excess"}}
"""Blocks and reward terms of others that a constraint changes: hand centre and distance of the set,
and f_max.
"""
each = pytest.mark.parametrize("constraint", CONSTRAINTS, ids=NAMES)
each_optional = pytest.mark.parametrize(
    "constraint", OPTIONAL, ids=lambda constraint: constraint.name
)


@pytest.fixture(scope="module")
def full_scene():
    """A scene in which every constraint is active."""
    return scene_of(TASK, *scene(9))


def _without(full_scene, constraint):
    """The scene with this constraint's blocks inactive."""
    others = itertools.chain(*(other.blocks for other in OPTIONAL if other is not constraint))
    return full_scene._replace(goal=dataclasses.replace(full_scene.goal, active=active(*others)))


@each
def test_block_sizes_equal_the_sum_of_their_fields(constraint, full_scene):
    described = fields(HAND, TASK)
    sizes = dict(layout(HAND, TASK))
    names = constraint.blocks or (constraint.name,)
    observed = evaluated(constraint.observe, full_scene)
    assert len(observed) == len(names) == len(constraint.fields(HAND, TASK))
    for name, parts in zip(names, observed, strict=True):
        assert [part.shape[-1] for part in parts] == [field.size for field in described[name]], name
        assert sum(part.shape[-1] for part in parts) == sizes[name]
        assert all(field.name and field.meaning for field in described[name])


def test_names_are_unique_over_all_constraints():
    arrays = []
    errors = []
    weights = []
    block_names = []
    options = []
    for constraint in CONSTRAINTS:
        arrays += [f"{constraint.name}_{name}" for name in constraint.arrays]
        errors += constraint.errors
        weights += [weight.name for weight in constraint.weights]
        block_names += constraint.blocks or (constraint.name,)
        options += [option.name for option in constraint.options]
    groups = {
        "constraints": NAMES,
        "goal arrays": arrays,
        "errors": [error.name for error in errors],
        "columns": [error.column or error.name for error in errors],
        "weights": [*weights, *(term.name for term in GRASP)],
        "blocks": ["state", *block_names, "mask"],
        "options": options,
    }
    for group, names in groups.items():
        twice = [name for name, count in Counter(names).items() if count > 1]
        assert not twice, f"{group}: {twice}"


@each
def test_terms_and_errors_match_declarations(constraint, full_scene):
    paid = evaluated(constraint.reward, full_scene)
    measured = evaluated(constraint.measure, full_scene)
    assert sorted(paid) == sorted(weight.name for weight in constraint.weights)
    assert sorted(measured) == sorted(error.name for error in constraint.errors)
    for error in constraint.errors:
        # Ratios have no unit
        assert isinstance(measured[error.name], tuple) == (error.unit == ""), error.name
        assert error.tolerance >= 0
        assert error.scale > 0
        assert error.unit in ("rad", "m", "")
    for value in jax.tree.leaves((paid, measured)):
        assert value.shape == (4,)
        assert np.isfinite(value).all()
    for weight in constraint.weights:
        assert getattr(RewardWeights(), weight.name) == weight.default
    assert not constraint.optional or getattr(TASK, f"p_{constraint.name}") == 0.5


@each_optional
def test_inactive_constraint_has_no_effect(constraint, full_scene):
    off = _without(full_scene, constraint)
    start = 0
    mask = dict(zip(blocks(TASK), range(len(blocks(TASK))), strict=True))
    on_observation = evaluated(observe, full_scene)
    off_observation = evaluated(observe, off)
    for name, size in layout(HAND, TASK):
        block = slice(start, start + size)
        start += size
        if name in constraint.blocks:
            assert on_observation[:, block].any(), name
            assert not off_observation[:, block].any(), name
        elif name == "mask":
            silent = [mask[block] for block in constraint.blocks]
            np.testing.assert_array_equal(
                off_observation[:, block] == 0, np.tile(np.isin(range(6), silent), (4, 1))
            )
        elif name not in CHANGES.get(constraint.name, ()):
            np.testing.assert_array_equal(
                on_observation[:, block], off_observation[:, block], err_msg=name
            )
    assert not any(np.any(value) for value in evaluated(constraint.reward, off).values())
    touching = full_scene.features.touching
    force = full_scene.features.force
    for before, after in zip(
        (touching, force), constraint.earning(off, touching, force), strict=True
    ):
        np.testing.assert_array_equal(before, after)
    # Nor does it change what the others are paid, but for contacts that it forbids and what it
    # declares.
    others, paid = (evaluated(reward_terms, one, RewardWeights()) for one in (full_scene, off))
    terms_of_constraint = {weight.name for weight in constraint.weights}
    for name in (
        set(terms(TASK))
        - terms_of_constraint
        - {"contact", "force"}
        - CHANGES.get(constraint.name, set())
    ):
        np.testing.assert_array_equal(others[name], paid[name], err_msg=name)


@pytest.mark.parametrize(
    ("hand", "sizes"),
    [("human", {"F": 20, "G": 5, "K": 15}), ("allegro", {"F": 16, "G": 4, "K": 15})],
)
@each
def test_neutral_arrays_match_declarations(constraint, hand, sizes):
    neutral = constraint.neutral(get_hand(hand), TASK)
    assert neutral._fields == tuple(constraint.arrays) == constraint.goal._fields
    for name, array in constraint.arrays.items():
        value = getattr(neutral, name)
        assert value.shape == tuple(sizes.get(n, n) for n in array.shape), name
        assert value.dtype == (bool if array.kind == "flag" else np.float32)
        if array.kind in ("direction", "quaternion"):
            assert value.shape[-1] == {"direction": 3, "quaternion": 4}[array.kind]
            np.testing.assert_allclose(np.linalg.norm(value, axis=-1), 1.0, rtol=1e-6)
    # What a person begins with fits in their place.
    suggested = constraint.suggested(get_hand(hand), TASK)
    assert {name: np.shape(value) for name, value in suggested.items()} == {
        name: getattr(neutral, name).shape for name in neutral._fields
    }
    labels = constraint.labels(get_hand(hand))
    assert {name: len(words) for name, words in labels.items()} == {
        name: getattr(neutral, name).shape[0]
        for name, array in constraint.arrays.items()
        if array.kind == "flag"
    }


@each
def test_names_that_it_gives_are_there(constraint):
    weaker = CONSTRAINTS[: NAMES.index(constraint.name)]
    overridable = set()
    for other in weaker:
        overridable |= {other.name, *other.blocks}
    assert set(constraint.overrides) <= overridable
    assert set(constraint.overridden_by) <= {*NAMES} - {constraint.name}
    assert {relation.weaker for relation in constraint.relations} <= {
        other.name for other in weaker
    }
    assert constraint.guides in ("", constraint.name, *constraint.blocks)
    assert constraint.title
    assert constraint.options
    assert constraint.name.isidentifier()


def test_constraints_of_the_paper_are_first():
    assert PAPER == NAMES[:4] == ("heading", "affordance", "pose", "trajectory")
    assert OURS == NAMES == TaskConfig().constraints
    assert [c.name for c in known(TaskConfig(constraints=("trajectory", "heading")))] == [
        "heading",
        "trajectory",
    ]


def test_unknown_constraint_is_named():
    with pytest.raises(
        CongraspError, match=r"no constraint 'glove'.*Choose from: heading, affordance"
    ):
        get_constraint("glove")
    with pytest.raises(CongraspError, match="lack the heading, which is always active"):
        known(TaskConfig(constraints=("pose",)))
    with pytest.raises(
        CongraspError,
        match=r"The policy does not support the constraint 'fingers'.*constraints … fingers",
    ):
        require_known(["heading", "fingers"], TaskConfig(constraints=PAPER))


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 1000))
def test_nothing_depends_on_where_the_scene_is(seed):
    """With every constraint active; as heights decide on `drop`, rewards allow only level
    motions.
    """
    state, surface, goal = scene(seed)
    rng = np.random.default_rng(seed)
    action = rng.normal(size=(4, F + 6)).astype(np.float32)
    level = moved(
        state, np.append(rng.normal(size=2), 0.0), Rotation.from_euler("z", rng.uniform(-3, 3))
    )
    free = moved(state, rng.normal(size=3), Rotation.random(rng=rng))
    here, turned, anywhere = (_judged(each, surface, goal, action) for each in (state, level, free))
    jax.tree.map(
        lambda *values: np.testing.assert_allclose(*values, rtol=2e-3, atol=5e-3),
        turned[0],
        here[0],
    )
    jax.tree.map(
        lambda *values: np.testing.assert_allclose(*values, atol=2e-3), anywhere[1], here[1]
    )


@jax.jit
def _judged(state, surface, goal, action):
    """Reward terms of a scene; and its observation, errors and targets."""
    traced = traced_scene(HAND, TASK, state, surface, goal)
    return reward_terms(traced, RewardWeights()), (
        observe(traced),
        metrics.errors(traced),
        decode(traced, TASK.control, action),
    )


def test_task_ignores_unsupported_constraints():
    """A choice of fingers and a limit of the force: f_max stays a number."""
    task = TaskConfig(constraints=PAPER)
    state, surface, goal = scene(5)
    known_blocks = itertools.chain(*(get_constraint(name).blocks for name in PAPER))
    flags = {block: goal.active[block] for block in known_blocks}
    known_alone = Goal({name: goal[name] for name in PAPER}, flags)
    some, more = (scene_of(task, state, surface, each) for each in (known_alone, goal))
    np.testing.assert_array_equal(
        some.features.center, kinematics.hand_center(HAND, some.features.keypoints)
    )
    np.testing.assert_array_equal(evaluated(observe, some), evaluated(observe, more))
    paid = evaluated(reward_terms, some, task.reward)
    assert not {"force_over", "fingers_contact"} & {*paid}
    jax.tree.map(np.testing.assert_array_equal, paid, evaluated(reward_terms, more, task.reward))
    total = np.linalg.norm(more.features.force, axis=-1)
    np.testing.assert_allclose(
        paid["force_excess"], -0.01 * np.clip(total - 5.0, 0, 50).sum(-1), rtol=1e-5
    )


def test_requests_fill_the_arrays_that_they_give():
    request = GraspRequest(
        {
            "heading": {"direction": np.array([0.0, 1.0, 0.0])},
            "fingers": {"allowed": [1, 0, 1, 0, 0]},
        }
    )
    goal = goal_of(HAND, TASK, request)
    np.testing.assert_array_equal(goal["heading"].direction, np.array([0, 1, 0], np.float32))
    np.testing.assert_array_equal(goal["heading"].position, np.zeros(3))
    np.testing.assert_array_equal(goal["fingers"].allowed, [True, False, True, False, False])
    assert goal["fingers"].allowed.dtype == bool
    assert goal["heading"].direction.dtype == np.float32
    names = set()
    for constraint in CONSTRAINTS:
        names |= {f"{constraint.name}_{name}" for name in constraint.arrays}
    assert set(goal.flat()) == names


def test_active_blocks():
    """The paper's figure of priorities; the choice of fingers yields to a reference pose as the
    affordance does.
    """
    for flags in itertools.product([False, True], repeat=5):
        affordance, pose, trajectory, fingers, force = flags
        active = active_blocks(
            {c.name: np.full(2, flag) for c, flag in zip(OPTIONAL, flags, strict=True)}
        )
        expected = {
            "affordance": affordance and not pose,
            "pose_finger": pose,
            "pose_wrist": pose and not trajectory,
            "trajectory": trajectory,
            "fingers": fingers and not pose,
            "force_limit": force,
        }
        assert {name: flags.tolist() for name, flags in active.items()} == {
            n: [x, x] for n, x in expected.items()
        }


def _drawn(names: tuple[str, ...], never: str = "") -> InitialConditions:
    """Episodes under these constraints, each of which half of them request, but one that none
    requests.

    Not compiled as one program, in which the order of operations, and so the last bit, depends on
    the constraints.
    """
    shares = {f"p_{c.name}": 0.5 * (c.name != never) for c in OPTIONAL if c.name in names}
    task = dataclasses.replace(TASK, constraints=names, **shares)
    return jax.device_get(sample(HAND, task, suite.bank(), jax.random.key(3), DRAWN))


def _same(
    some: InitialConditions,
    more: InitialConditions,
    but: str,
    check: Callable = np.testing.assert_array_equal,
):
    """Everything that does not belong to one constraint is the same, but for places of hands whose
    fingers it chose.
    """
    moved = more.goal.active["fingers"] if but == "fingers" else np.zeros(1, bool)
    position = np.where(
        moved[:, None], some.goal["heading"].position, more.goal["heading"].position
    )
    base = np.where(moved[:, None], some.reset_state.base_position, more.reset_state.base_position)
    # Opened to the width at the heading
    q = np.where(moved[:, None], some.reset_state.q, more.reset_state.q)
    more = more._replace(
        goal=more.goal.replace("heading", position=position),
        reset_state=more.reset_state._replace(base_position=base, q=q),
    )
    goals = [dict(part.goal.flat().items()) for part in (some, more)]
    actives = [part.goal.active for part in (some, more)]
    excluded = {
        *get_constraint(but).blocks,
        *(f"{but}_{name}" for name in get_constraint(but).arrays),
    }
    assert goals[0]
    assert set(goals[1]) - set(goals[0]) <= excluded
    assert set(actives[1]) - set(actives[0]) == excluded & {*blocks(TASK)}
    for one, other in (goals, actives):
        for name in one:
            check(one[name], other[name], err_msg=name)
    for name in ("reset_state", "surface", "region", "hold"):
        jax.tree.map(check, getattr(some, name), getattr(more, name))


@pytest.mark.slow
@each_optional
def test_draws_are_independent_of_other_constraints(constraint):
    """A policy that knows a constraint, of which no episode has it, learns from the same
    episodes.
    """
    others = tuple(name for name in NAMES if name != constraint.name)
    some = _drawn(others)
    all_of_them = _drawn(NAMES, never=constraint.name)
    assert not any(np.any(all_of_them.goal.active[block]) for block in constraint.blocks)
    _same(some, all_of_them, constraint.name)


def test_fingers_change_no_other_draw():
    """By compiled programs, whose last bits depend on the constraints."""
    without = dataclasses.replace(
        TASK, constraints=tuple(name for name in NAMES if name != "fingers")
    )
    some = suite.episodes(DRAWN, task=without)
    more = suite.episodes(DRAWN)
    _same(
        some, more, "fingers", functools.partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-6)
    )
    chosen, pose = (np.asarray(more.goal.active[name]) for name in ("fingers", "pose_finger"))
    assert not chosen[pose].any()
    assert abs(chosen[~pose].mean() - 0.5) < 0.15


def test_constraint_without_blocks_is_active():
    *_, goal = scene(0)
    always = [constraint for constraint in known(TASK) if not constraint.blocks]
    assert always
    assert all(constraint.active(goal).tolist() == [True] * 4 for constraint in always)
