"""What actors train on: procedural objects, folders, captured constraints, and mixtures of them."""

import dataclasses
from typing import get_args

import jax
import numpy as np
import pytest

from congrasp.actors import harvest
from congrasp.actors.harvest import Grasps
from congrasp.actors.training_set import training_set
from congrasp.common.config import ObjectsConfig, RunConfig, Split
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.outline import outline
from congrasp.common.objects import procedural
from congrasp.common.objects.store import Catalogue
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.sampling.bank import rows_of, stacked
from congrasp.common.task.sampling.build import headings_of
from congrasp.common.task.sampling.sets import load, load_for
from congrasp.common.task.sampling.write_sets import make_sets, save
from tests import task as suite

HAND = get_hand("human")
OBJECTS = [procedural.generate(7, "mug"), procedural.generate(0, "box")]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A folder of two objects, and one of the constraint set of the first."""
    objects, sets = tmp_path_factory.mktemp("objects"), tmp_path_factory.mktemp("sets")
    for obj in OBJECTS:
        Catalogue(objects).add(obj)
    save(make_sets(HAND, TaskConfig(), OBJECTS[:1], 5)[0], sets)
    return str(objects), str(sets)


def _run(**objects) -> RunConfig:
    return RunConfig(objects=ObjectsConfig(count=2, **objects))


@pytest.fixture(scope="module")
def scanned(folders):
    """The training set of the folder alone."""
    return training_set(HAND, _run(folder=folders[0]), 0)


def test_a_folder_replaces_procedural_objects_or_is_mixed_with_them(folders, scanned):
    names = [obj.name for obj in training_set(HAND, _run(), 0).objects]
    assert names == [obj.name for obj in procedural.generate_many(2, 0)]
    assert [obj.name for obj in scanned.objects] == ["box_0", "mug_7"]
    mixed = training_set(HAND, _run(folder=folders[0], procedural=2, folder_share=0.75), 0)
    assert len(mixed.objects) == 4 and len(mixed.bank.points) == 4
    np.testing.assert_allclose(mixed.bank.weight, [0.375] * 2 + [0.125] * 2)


def test_constraint_sets_keep_their_split_and_their_references(folders):
    """Grasps of the policy in training replace references of its procedural objects, never captured ones."""
    objects, sets = folders
    found = training_set(HAND, _run(folder=objects, constraints=sets, procedural=1), 0)
    assert found.objects[0].name == "mug_7" and len(found.objects) == 2
    assert np.asarray(found.bank.renewable).tolist() == [False, True]
    apart = [
        np.asarray(training_set(HAND, _run(folder=objects, constraints=sets, split=split), 0).bank.pose_valid)
        for split in ("training", "held-out", "all")
    ]
    assert not (apart[0] & apart[1]).any() and np.array_equal(apart[0] | apart[1], apart[2])
    index = np.array([0, 1], np.int32)
    poses = np.asarray(found.bank.pose_q)[:, 0, 0], np.asarray(found.bank.pose_position)[:, 0, 0]
    grasps = Grasps(
        np.ones(2, bool), index, 0 * index, poses[0] + 0.01, poses[1], np.asarray(found.bank.pose_quaternion)[:, 0, 0]
    )
    for _ in range(4):  # a random place each time
        renewed = harvest.renew(HAND, TaskConfig(), found.bank, grasps, jax.random.key(0))
        np.testing.assert_array_equal(renewed.pose_q[0], found.bank.pose_q[0])


def test_an_object_without_a_heading_of_the_split_is_left_out(tmp_path):
    for obj, made in zip(OBJECTS, make_sets(HAND, TaskConfig(), OBJECTS, 5), strict=True):
        if obj is OBJECTS[0]:
            made.arrays["heading/allowed"] &= made.arrays["heading/training"][:, None]
        save(made, tmp_path)
    kept = {split: [obj.name for obj in load_for(tmp_path, OBJECTS, split)[0]] for split in get_args(Split)}
    every = [obj.name for obj in OBJECTS]
    assert kept == {"all": every, "training": every, "held-out": every[1:]}


def test_sets_without_normals_get_estimated_ones(tmp_path):
    """As of versions whose sets have none; most are near those of the mesh."""
    (made,) = make_sets(HAND, TaskConfig(), OBJECTS[1:], 5)
    exact = made.arrays.pop("surface/normals")
    normals = load(save(made, tmp_path)).arrays["surface/normals"]
    assert normals.dtype == np.float32 and np.median(np.sum(normals * exact, -1)) > 0.99


@pytest.mark.parametrize("family", procedural.HOUSEHOLD_FAMILIES)
def test_household_objects_can_be_approached_and_grasped_by_a_part(family):
    row = headings_of(TaskConfig(), procedural.generate(1, family), (0, 1), None, 1.0, outline(HAND))
    # Eyeglasses lie so flat that no hand closes on a part of them without the other.
    assert row["has_affordance"].any() == (family != "eyeglasses")


@pytest.mark.parametrize(
    ("objects", "text"),
    [({"constraints": "x"}, "objects.folder"), ({"folder": 0, "constraints": 0}, "no constraint set")],
)
def test_what_cannot_be_trained_on_is_said(folders, objects, text):
    given = {name: folders[0] if value == 0 else value for name, value in objects.items()}
    with pytest.raises(CongraspError, match=text):
        training_set(HAND, _run(**given), 0)


def test_sets_of_another_hand_are_refused(folders):
    config = dataclasses.replace(_run(folder=folders[0], constraints=folders[1]), task=TaskConfig(hand="allegro"))
    with pytest.raises(CongraspError, match="for the hand 'human'"):
        training_set(get_hand("allegro"), config, 0)


def test_an_object_that_lies_too_flat_is_in_no_episode():
    """A board of 24 x 13 cm, 8 mm thick: fingers find opposite surfaces only above and beneath it."""
    board = procedural.generate(1_000_045, "board")
    assert np.ptp(board.points, axis=0).min() < 0.009
    row = headings_of(TaskConfig(), board, (0, 1), None, 1.0, outline(HAND))
    assert row["weight"] == 0 and np.isfinite(row["heading_position"]).all()


def test_objects_of_different_sizes_stack_and_come_apart_again(scanned):
    bank = scanned.bank
    rows = rows_of(bank)
    for a, b in zip(stacked(rows), bank, strict=True):
        np.testing.assert_array_equal(a, b)
    first = rows[0]._replace(
        pose_valid=rows[0].pose_valid[:, :, :3],
        **{name: getattr(rows[0], name)[:, :3] for name in bank._fields if name in ("pose_q", "pose_position")},
        pose_quaternion=rows[0].pose_quaternion[:, :3],
        trajectory_position=rows[0].trajectory_position[:, :3],
        trajectory_quaternion=rows[0].trajectory_quaternion[:, :3],
    )
    both = stacked([first, rows[1]])
    np.testing.assert_array_equal(both.pose_q[0], first.pose_q[:, np.arange(20) % 3])
    np.testing.assert_array_equal(both.pose_q[1], rows[1].pose_q)


def test_objects_are_drawn_as_often_as_their_weights_say():
    bank = suite.bank()._replace(weight=np.array([1.0, 3.0, 0.0, 4.0], np.float32))
    drawn = suite.episodes(2000, bank).reset_state.object_index
    assert np.bincount(drawn, minlength=4) / len(drawn) == pytest.approx([1 / 8, 3 / 8, 0.0, 1 / 2], abs=0.03)
