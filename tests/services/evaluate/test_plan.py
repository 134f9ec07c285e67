"""Rows of an evaluation: their objects and episodes, and what they do not depend on."""

import itertools

import jax
import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import FIGURES_SEED, HELD_OUT_SEED
from congrasp.common.task.constraints import blocks
from congrasp.services.evaluate import exams
from congrasp.services.evaluate.episodes import identity, reference
from congrasp.services.evaluate.plan import ALIGNED, batches, plan_row, protocol
from congrasp.services.evaluate.scores import TABLES
from tests import task


@pytest.fixture(scope="module")
def conditions():
    return task.episodes(64)


def test_an_exam_has_all_families_and_seeds_of_its_own(monkeypatch):
    first_seeds = []
    monkeypatch.setattr(
        procedural,
        "parallel_map",
        lambda make, seeds, families: first_seeds.append((list(seeds), families)),
    )
    exams.exam_pool("figures")
    exams.exam_pool("development", 5)
    (figures, families), (development, _) = first_seeds
    assert sorted(families) == sorted(procedural.FAMILIES), "one object of each family"
    assert figures == list(range(FIGURES_SEED, FIGURES_SEED + len(procedural.FAMILIES)))
    assert development == list(range(HELD_OUT_SEED, HELD_OUT_SEED + 5))


def test_the_development_exam_never_reaches_objects_for_figures():
    assert exams.first_seed("development", 1_000_000) == HELD_OUT_SEED
    with pytest.raises(CongraspError, match="smaller --pool"):
        exams.first_seed("development", 1_000_001)


def test_episodes_that_begin_alike_are_one(conditions):
    twice = jax.tree.map(lambda leaf: np.concatenate([leaf, leaf]), conditions)
    identities = identity(twice)
    np.testing.assert_array_equal(identities[:64], identities[64:])
    assert len(np.unique(identities)) == 64
    # The limit of a force that nothing asks for does not tell episodes apart; one that is asked for
    # does.
    goal = conditions.goal
    active = conditions.goal.active["force_limit"]
    other = conditions._replace(goal=goal.replace("force", limit=goal["force"].limit + 1))
    changed = identity(other) != identity(conditions)
    np.testing.assert_array_equal(changed, active)
    assert active.any()
    assert not active.all()


def test_episodes_of_one_reference_are_a_cluster(conditions):
    goal = conditions.goal
    index = conditions.reset_state.object_index
    clusters = reference(conditions)
    posed = goal.active["pose_finger"] | goal.active["trajectory"]
    plain = ~posed
    assert len(np.unique(clusters[plain])) == len(np.unique(index[plain])), (
        "without a reference, objects"
    )
    moved = conditions._replace(goal=goal.replace("pose", q=goal["pose"].q + 0.1))
    np.testing.assert_array_equal(
        reference(moved) != clusters, goal.active["pose_finger"] | goal.active["pose_wrist"]
    )


TASK = protocol(task.TASK, task.TASK.hold_steps)
# Affordance, fingers of the pose, wrist of the pose, trajectory; neither fingers nor a force
# limit
MASKS = {
    "heading": (0, 0, 0, 0),
    "pose": (0, 1, 1, 0),
    "trajectory": (0, 0, 0, 1),
    "affordance": (1, 0, 0, 0),
    "pose+trajectory": (0, 1, 0, 1),
    "trajectory+affordance": (1, 0, 0, 1),
}


@pytest.fixture(scope="module")
def bank():
    return task.bank()


def _all(bank, plan, seed=0, size=task.BATCH):
    """The conditions of all episodes of a plan."""
    parts = [
        jax.tree.map(lambda x, n=n: np.asarray(x)[:n], c)
        for c, n in batches(task.HAND, TASK, bank, plan, seed, size)
    ]
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


@pytest.mark.parametrize("name", MASKS)
def test_objects_have_equal_shares_and_the_rows_constraints(bank, name):
    plan = plan_row(TASK, bank, task.OBJECTS, name, 50)
    conditions = _all(bank, plan)
    index = conditions.reset_state.object_index
    np.testing.assert_array_equal(index, plan.episodes.objects)
    counts = np.bincount(index, minlength=len(task.OBJECTS))
    each = -(-50 // plan.covered.sum())
    np.testing.assert_array_equal(counts, np.where(plan.covered, each, 0))
    for obj in np.flatnonzero(plan.covered):
        rests = plan.episodes.rests[index == obj]
        of_each = np.unique(rests, return_counts=True)[1]
        assert of_each.max() - of_each.min() <= 1
        assert len(of_each) <= len(task.OBJECTS[obj].rest_poses)
    for block, active in zip(blocks(TASK), (*MASKS[name], 0, 0), strict=True):
        np.testing.assert_array_equal(
            conditions.goal.active[block], np.full(plan.total, bool(active))
        )


def test_episodes_are_independent_of_other_objects(bank):
    """Nor on how many there are, or in which batches they are simulated (but for the rounding of
    another program).
    """
    fewer = jax.tree.map(lambda x: np.asarray(x)[1:], bank)
    for name in ("affordance", "pose+trajectory"):
        among = plan_row(TASK, bank, task.OBJECTS, name, 30)
        alone = plan_row(TASK, fewer, task.OBJECTS[1:], name, 8)
        among_others = _all(bank, among)
        part = _all(fewer, alone, size=4)
        for i, (obj, number) in enumerate(
            zip(alone.episodes.objects, alone.episodes.episode_numbers, strict=True)
        ):
            (at,) = np.flatnonzero(
                (among.episodes.objects == obj + 1) & (among.episodes.episode_numbers == number)
            )
            for ours, theirs in zip(
                jax.tree.leaves((part.goal, part.reset_state.base_position)),
                jax.tree.leaves((among_others.goal, among_others.reset_state.base_position)),
                strict=True,
            ):
                np.testing.assert_allclose(ours[i], theirs[at], rtol=0, atol=1e-6)


def test_seeds_and_rows_draw_for_themselves(bank):
    heading = plan_row(TASK, bank, task.OBJECTS, "heading", 30)
    drawn = [_all(bank, heading, seed).goal["heading"].position for seed in (0, 1)]
    drawn.append(_all(bank, heading._replace(constraint="affordance")).goal["heading"].position)
    for other in drawn[
        1:
    ]:  # of the dozens of headings that an object has, two draws may well be the same
        assert (np.abs(drawn[0] - other).max(-1) > 0).mean() > 0.8


def test_pairs_are_independent_unless_aligned(bank):
    apart = {}
    for name in ("pose+trajectory", f"pose+trajectory{ALIGNED}"):
        plan = plan_row(TASK, bank, task.OBJECTS, name, 60)
        goal = _all(bank, plan).goal
        q, wrist = (
            np.asarray(field)[plan.episodes.objects, 0]
            for field in (bank.pose_q, bank.pose_position)
        )
        # Hands that close around nothing are alike: any pose with these fingers may be meant.
        is_aligned = np.abs(q - goal["pose"].q[:, None]).max(-1) < 1e-5
        away = np.linalg.norm(wrist - goal["trajectory"].position[:, -1:], axis=-1)
        apart[name] = np.where(is_aligned, away, np.inf).min(1)
    independent, aligned = apart.values()
    # The table leaves few references in some resting poses, so that two draws may well be the same.
    assert aligned.max() < 0.005
    assert np.mean(independent > 0.005) > 0.5


def test_trajectories_end_nearer_to_the_graspable_region(bank):
    conditions = _all(bank, plan_row(TASK, bank, task.OBJECTS, "trajectory+affordance", 60))
    end = conditions.goal["trajectory"].position[:, -1]
    distance = np.linalg.norm(conditions.surface.points - end[:, None], axis=-1)
    avoid = conditions.surface.avoid
    assert np.all(
        np.where(avoid, np.inf, distance).min(1) < np.where(avoid, distance, np.inf).min(1)
    )


def test_objects_that_allow_nothing_are_counted(bank):
    valid = np.array(bank.pose_valid)
    valid[1] = False
    plan = plan_row(TASK, bank._replace(pose_valid=valid), task.OBJECTS, "pose", 10)
    assert plan.covered.tolist() == [True, False, True, True]
    assert 1 not in plan.episodes.objects
    assert plan.total == 12


def test_the_tables_name_rows_that_can_be_planned(bank):
    for name in dict.fromkeys(itertools.chain.from_iterable(TABLES.values())):
        assert plan_row(TASK, bank, task.OBJECTS, name, 3).total >= 3
