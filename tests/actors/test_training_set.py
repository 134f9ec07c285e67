"""What actors train on: procedural objects, folders, captured constraints, and mixtures of them."""

import dataclasses
from typing import get_args

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from congrasp.actors import harvest
from congrasp.actors.failure_weights import FailureWeights
from congrasp.actors.harvest import Grasps
from congrasp.actors.training_set import training_set
from congrasp.common.config import ObjectsConfig, RunConfig, Split
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.closure import outline
from congrasp.common.objects import procedural
from congrasp.common.objects.store import Catalogue
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling import cache
from congrasp.common.task.sampling.bank import rows_of, stacked
from congrasp.common.task.sampling.object_headings import headings_of
from congrasp.common.task.sampling.set_file import load, load_for, save
from congrasp.common.task.sampling.sets import make_sets
from congrasp.common.wire.codec import Message
from tests import task as suite
from tests.task import HAND, OBJECTS, TASK

FAMILIES = tuple(obj.family for obj in OBJECTS)
BOX, _, MUG, _ = OBJECTS


@pytest.fixture(scope="module", autouse=True)
def _banks_are_built_once(tmp_path_factory):
    """Also those of pools as small as these."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(cache, "MIN_OBJECTS", 1)
        yield


@pytest.fixture(scope="module")
def sets():
    """Constraint sets of the suite's objects."""
    return dict(
        zip(
            (obj.name for obj in OBJECTS),
            make_sets(HAND, TASK, OBJECTS, 5, suite.bank()),
            strict=True,
        )
    )


@pytest.fixture(scope="module")
def folders(tmp_path_factory, sets):
    """A folder of the suite's objects, and one of the mug's constraint set."""
    folder = tmp_path_factory.mktemp("objects")
    constraints = tmp_path_factory.mktemp("sets")
    for obj in OBJECTS:
        Catalogue(folder).add(obj)
    save(sets[MUG.name], constraints)
    return str(folder), str(constraints)


def _run(**objects) -> RunConfig:
    """Pools of the suite's size, whose references are made by its program."""
    return RunConfig(objects=ObjectsConfig(count=len(OBJECTS), families=FAMILIES, **objects))


@pytest.fixture(scope="module")
def scanned(folders):
    """The training set of the folder alone."""
    return training_set(HAND, _run(folder=folders[0]), 0)


def test_a_folder_replaces_procedural_objects_or_is_mixed_with_them(folders, scanned):
    training = training_set(HAND, _run(), 0)
    assert [obj.name for obj in training.objects] == [obj.name for obj in OBJECTS]
    jax.tree.map(np.testing.assert_array_equal, training.bank, suite.bank())
    assert [obj.name for obj in scanned.objects] == sorted(obj.name for obj in OBJECTS)
    mixed = training_set(HAND, _run(folder=folders[0], procedural=4, folder_share=0.75), 0)
    assert len(mixed.objects) == 8
    assert len(mixed.bank.points) == 8
    np.testing.assert_allclose(mixed.bank.weight, [0.75 / 4] * 4 + [0.25 / 4] * 4)


def test_constraint_sets_keep_their_split_and_their_references(folders):
    """Grasps of the policy in training replace references of its procedural objects, never captured
    ones.
    """
    objects, constraints = folders
    mixed = training_set(HAND, _run(folder=objects, constraints=constraints, procedural=4), 0)
    assert mixed.objects[0].name == MUG.name
    assert len(mixed.objects) == 5
    assert np.asarray(mixed.bank.renewable).tolist() == [False, True, True, True, True]
    apart = [
        np.asarray(
            training_set(
                HAND, _run(folder=objects, constraints=constraints, split=split), 0
            ).bank.pose_valid
        )
        for split in ("training", "held-out", "all")
    ]
    assert not (apart[0] & apart[1]).any()
    assert np.array_equal(apart[0] | apart[1], apart[2])
    index = np.array([0, 1], np.int32)
    q, position, quaternion = (
        np.asarray(getattr(mixed.bank, f"pose_{name}"))[:2, 0, 0]
        for name in ("q", "position", "quaternion")
    )
    grasps = Grasps(np.ones(2, bool), index, 0 * index, q + 0.01, position, quaternion)
    for _ in range(4):  # a random place each time
        renewed = harvest.renew(HAND, TASK, mixed.bank, grasps, jax.random.key(0))
        np.testing.assert_array_equal(renewed.pose_q[0], mixed.bank.pose_q[0])


def test_an_object_without_a_heading_of_the_split_is_left_out(tmp_path, sets):
    mug = sets[MUG.name].arrays
    allowed = mug["heading/allowed"] & mug["heading/training"][:, None]
    save(Message({**mug, "heading/allowed": allowed}, sets[MUG.name].meta), tmp_path)
    save(sets[BOX.name], tmp_path)
    left = {}
    for split in get_args(Split):
        objects, _ = load_for(tmp_path, [MUG, BOX], split)
        left[split] = [obj.name for obj in objects]
    every = [MUG.name, BOX.name]
    assert left == {"all": every, "training": every, "held-out": every[1:]}


def test_sets_without_normals_get_estimated_ones(tmp_path, sets):
    """As of versions whose sets have none; most are near those of the mesh."""
    arrays = dict(sets[BOX.name].arrays)
    exact = arrays.pop("surface/normals")
    normals = load(save(Message(arrays, sets[BOX.name].meta), tmp_path)).arrays["surface/normals"]
    assert normals.dtype == np.float32
    assert np.median(np.sum(normals * exact, -1)) > 0.99


@pytest.mark.parametrize(
    "family",
    [
        pytest.param(family, marks=[pytest.mark.slow] * (number % 5 > 0))
        for number, family in enumerate(procedural.HOUSEHOLD_FAMILIES)
    ],
)
def test_household_objects_can_be_approached_and_grasped_by_a_part(family):
    row = headings_of(TASK, procedural.generate(1, family), (0, 1), None, 1.0, outline(HAND))
    # Eyeglasses lie so flat that no hand closes on a part of them without the other.
    assert row["has_affordance"].any() == (family != "eyeglasses")


@pytest.mark.parametrize(
    ("objects", "text"),
    [
        ({"constraints": "x"}, "objects.folder"),
        ({"folder": 0, "constraints": 0}, "no constraint set"),
    ],
)
def test_unusable_training_objects_are_refused(folders, objects, text):
    options = {name: folders[0] if value == 0 else value for name, value in objects.items()}
    with pytest.raises(CongraspError, match=text):
        training_set(HAND, _run(**options), 0)


def test_sets_of_another_hand_are_refused(folders):
    config = dataclasses.replace(
        _run(folder=folders[0], constraints=folders[1]), task=TaskConfig(hand="allegro")
    )
    with pytest.raises(CongraspError, match="for the hand 'human'"):
        training_set(get_hand("allegro"), config, 0)


def test_an_object_that_lies_too_flat_is_in_no_episode():
    """A board of 24 x 13 cm, 8 mm thick: fingers find opposite surfaces only above and beneath
    it.
    """
    board = procedural.generate(1_000_045, "board")
    assert np.ptp(board.points, axis=0).min() < 0.009
    row = headings_of(TASK, board, (0, 1), None, 1.0, outline(HAND))
    assert row["weight"] == 0
    assert np.isfinite(row["heading_position"]).all()


def test_objects_of_different_sizes_stack_and_come_apart_again(scanned):
    bank = scanned.bank
    rows = rows_of(bank)
    for a, b in zip(stacked(rows), bank, strict=True):
        np.testing.assert_array_equal(a, b)
    first = rows[0]._replace(
        pose_valid=rows[0].pose_valid[:, :, :3],
        **{
            name: getattr(rows[0], name)[:, :3]
            for name in bank._fields
            if name in ("pose_q", "pose_position")
        },
        pose_quaternion=rows[0].pose_quaternion[:, :3],
        trajectory_position=rows[0].trajectory_position[:, :3],
        trajectory_quaternion=rows[0].trajectory_quaternion[:, :3],
    )
    both = stacked([first, rows[1]])
    np.testing.assert_array_equal(both.pose_q[0], first.pose_q[:, np.arange(20) % 3])
    np.testing.assert_array_equal(both.pose_q[1], rows[1].pose_q)


def test_objects_are_drawn_in_proportion_to_their_weights():
    bank = suite.bank()._replace(weight=np.array([1.0, 3.0, 0.0, 4.0], np.float32))
    drawn = suite.episodes(2000, bank).reset_state.object_index
    assert np.bincount(drawn, minlength=4) / len(drawn) == pytest.approx(
        [1 / 8, 3 / 8, 0.0, 1 / 2], abs=0.03
    )


def test_weights_by_hand():
    """Two mugs and a box, four episodes each: 4, 0 and 0 failures."""
    weights = FailureWeights(np.array([1.0, 1.0, 3.0]), ["mug", "mug", "box"])
    np.testing.assert_array_equal(weights.weights, [1, 1, 3])
    weights.add(np.repeat([0, 1, 2], 4), np.repeat([0.0, 1.0, 1.0], 4))
    # Nothing was counted before, so that nothing is forgotten. All: 4/12. Mugs: (4 + 5/3) / (8 +
    # 5), boxes: (5/3) / 9.
    mugs = 17 / 39
    boxes = 5 / 27
    rates = np.array([(4 + 5 * mugs) / 9, 5 * mugs / 9, 5 * boxes / 9])
    variance = rates * (1 - rates)
    factors = (variance + variance.mean()) / (2 * variance.mean())
    np.testing.assert_allclose(weights.weights, [1.0, 1.0, 3.0] * factors, rtol=1e-6)
    assert weights.metrics()["failure/mug"] == pytest.approx(mugs)
    assert weights.metrics()["failure/box"] == pytest.approx(boxes)


def test_old_outcomes_are_forgotten():
    """After 50 episodes of each object what came before counts e times less."""
    weights = FailureWeights(np.ones(2), ["box", "mug"])
    weights.add(np.zeros(100, int), np.zeros(100))
    assert weights.metrics()["failure/box"] == pytest.approx(1.0)
    weights.add(np.zeros(100, int), np.ones(100))
    old = 100 * np.exp(-1)
    mean = old / (100 + old)
    assert weights.metrics()["failure/box"] == pytest.approx((old + 5 * mean) / (100 + old + 5))


@given(st.lists(st.tuples(st.integers(0, 4), st.booleans()), max_size=200))
def test_weights_stay_within_a_factor_of_four_and_follow_uncertainty(episodes):
    failures = FailureWeights(np.ones(5), ["a", "a", "a", "b", "b"])
    index = np.array([i for i, _ in episodes], int)
    success = np.array([s for _, s in episodes], float)
    failures.add(index, success)
    weights = failures.weights
    assert weights.min() >= 0.5
    assert weights.max() <= 2.0
