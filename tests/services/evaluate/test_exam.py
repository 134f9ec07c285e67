"""What the exam is made of: objects, and which episodes are the same."""

import jax
import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.common.objects.pool import FIGURES_SEED, HELD_OUT_SEED
from congrasp.services.evaluate import pools
from congrasp.services.evaluate.episodes import identity, reference
from tests import task


@pytest.fixture(scope="module")
def conditions():
    return task.episodes(64)


def test_an_exam_has_all_families_and_seeds_of_its_own(monkeypatch):
    asked = []
    monkeypatch.setattr(procedural, "parallel_map", lambda make, seeds, families: asked.append((list(seeds), families)))
    pools.exam_pool("figures")
    pools.exam_pool("development", 5)
    (figures, families), (development, _) = asked
    assert sorted(families) == sorted(procedural.FAMILIES), "one object of each family"
    assert figures == list(range(FIGURES_SEED, FIGURES_SEED + len(procedural.FAMILIES)))
    assert development == list(range(HELD_OUT_SEED, HELD_OUT_SEED + 5))


def test_the_development_exam_never_reaches_objects_for_figures():
    assert pools.first_seed("development", 1_000_000) == HELD_OUT_SEED
    with pytest.raises(CongraspError, match="smaller --pool"):
        pools.first_seed("development", 1_000_001)


def test_episodes_that_begin_alike_are_one(conditions):
    twice = jax.tree.map(lambda leaf: np.concatenate([leaf, leaf]), conditions)
    found = identity(twice)
    np.testing.assert_array_equal(found[:64], found[64:])
    assert len(np.unique(found)) == 64
    # The limit of a force that nothing asks for does not tell episodes apart; one that is asked for does.
    goal, active = conditions.goal, conditions.goal.active["force_limit"]
    other = conditions._replace(goal=goal.replace("force", limit=goal["force"].limit + 1))
    changed = identity(other) != identity(conditions)
    np.testing.assert_array_equal(changed, active)
    assert active.any() and not active.all()


def test_episodes_of_one_reference_are_a_cluster(conditions):
    goal, index = conditions.goal, conditions.reset_state.object_index
    found = reference(conditions)
    posed = goal.active["pose_finger"] | goal.active["trajectory"]
    plain = ~posed
    assert len(np.unique(found[plain])) == len(np.unique(index[plain])), "without a reference, objects"
    moved = conditions._replace(goal=goal.replace("pose", q=goal["pose"].q + 0.1))
    np.testing.assert_array_equal(reference(moved) != found, goal.active["pose_finger"] | goal.active["pose_wrist"])
