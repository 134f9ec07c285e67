"""The constraint `fingers`, against numbers worked out by hand."""

import dataclasses

import jax
import numpy as np
import pytest

from common.config import RewardWeights, TaskConfig
from common.errors import CongraspError
from common.hands import get_hand
from common.task import metrics
from common.task.bank import Draw
from common.task.constraints import get_constraint
from common.task.constraints.fingers import FingersGoal
from common.task.features import features, scene_of
from common.task.observation import fields
from common.task.reward import reward_terms, terms
from common.task.types import Surface
from tests.scenes import HAND, L, active, scene

FINGERS = get_constraint("fingers")
TASK = TaskConfig(constraints=("heading", "fingers"))
PINCH = np.array([[True, True, False, False, False]])
# Links and tips in the order of the human hand: palm, then three links of thumb, index, middle, ring and little finger.
PALM, THUMB, INDEX, MIDDLE, RING = 0, 3, 6, 9, 12
THUMB_TIP, MIDDLE_TIP, RING_TIP = 16, 18, 19


def pinch(on: bool = True):
    """The object is 2 cm from the middle finger's skin, 4 mm from the ring finger's, and far from the rest.

    Palm, thumb, index, middle and ring finger touch it; index and middle with 3 and 5 N.
    """
    state, surface, goal = (jax.tree.map(lambda array: array[:1], part) for part in scene(0))
    goal = dataclasses.replace(
        goal.replace("fingers", allowed=PINCH), active=active(*(["fingers"] if on else []), batch=1)
    )
    made = scene_of(HAND, TASK, state, surface, goal)
    nearest = np.zeros((1, len(HAND.keypoints), 3), np.float32)
    nearest[..., 0] = 0.2
    nearest[0, THUMB_TIP] = [0.001, 0.0, 0.0]
    nearest[0, MIDDLE_TIP] = [0.0, 0.02 + 0.007, 0.0]
    nearest[0, RING_TIP] = [0.0, 0.0, -0.004 - 0.0068]
    touching = np.isin(np.arange(L), (PALM, THUMB, INDEX, MIDDLE, RING))[None]
    force = np.zeros((1, L, 3), np.float32)
    force[0, INDEX, 0], force[0, MIDDLE, 2] = 3.0, 5.0
    return made._replace(features=made.features._replace(nearest=nearest, touching=touching, force=force))


def test_the_hand_knows_which_finger_a_link_belongs_to():
    assert HAND.fingers == ("thumb", "index", "middle", "ring", "little")
    np.testing.assert_array_equal(HAND.link_fingers, [-1, *np.repeat(np.arange(5), 3)])
    assert get_hand("allegro").fingers == ("thumb", "index", "middle", "ring")
    assert FINGERS.labels(HAND) == {"allowed": HAND.fingers}
    np.testing.assert_allclose(HAND.keypoint_radii[[MIDDLE_TIP, RING_TIP]], [0.007, 0.0068])


def test_observation_by_hand():
    ((allowed, room, force),) = FINGERS.observe(pinch())
    np.testing.assert_array_equal(allowed, [[1, 1, 0, 0, 0]])
    # The thumb at the object may be there, and the little finger is more than 10 cm away.
    np.testing.assert_allclose(room, [[0.0, 0.0, 0.02, 0.004, 0.1]], atol=1e-6)
    expected = np.zeros((L, 3))
    expected[MIDDLE] = [0.0, 0.0, 0.5]  # 5 / (5 + 5); the index finger may press
    np.testing.assert_allclose(force, expected.reshape(1, -1), atol=1e-6)
    assert [field.size for field in fields(HAND, TASK)["fingers"]] == [5, 5, 48]


def test_reward_by_hand():
    paid = FINGERS.reward(pinch())
    # softplus((10 - 20 mm) / 3 mm) = 0.03505, softplus((10 - 4 mm) / 3 mm) = 2.12693, and nothing 19 cm away.
    np.testing.assert_allclose(paid["fingers_distance"], [-2.16198], rtol=1e-5)
    np.testing.assert_allclose(paid["fingers_contact"], [-2.0])
    assert not any(np.any(value) for value in FINGERS.reward(pinch(on=False)).values())
    weighted = reward_terms(pinch(), RewardWeights())
    np.testing.assert_allclose(weighted["fingers_contact"], [-0.6])
    np.testing.assert_allclose(weighted["fingers_distance"], [-0.0432396], rtol=1e-5)


def test_only_the_named_fingers_and_the_palm_earn():
    weights, unit = HAND.contact_weights, RewardWeights(**dict.fromkeys(terms(TASK), 1.0), force_max=5.0)
    paid, free = reward_terms(pinch(), unit), reward_terms(pinch(on=False), unit)
    np.testing.assert_allclose(paid["contact"], [weights[[PALM, THUMB, INDEX]].sum()], rtol=1e-6)
    np.testing.assert_allclose(paid["force"], [weights[INDEX] * 3 / 5], rtol=1e-6)
    np.testing.assert_allclose(free["contact"], [weights[[PALM, THUMB, INDEX, MIDDLE, RING]].sum()], rtol=1e-6)
    np.testing.assert_allclose(free["force"], [weights[INDEX] * 3 / 5 + weights[MIDDLE]], rtol=1e-6)


def test_error_is_the_share_of_other_fingers_links():
    for on in (True, False):  # measured whether or not it is active
        wrong, all_of_them = FINGERS.measure(pinch(on))["fingers_ratio"]
        assert (wrong, all_of_them) == (2.0, 5.0)
    step, yes, no = metrics.errors(pinch()), np.ones(1, bool), np.zeros(1, bool)
    sums = metrics.empty_sums(TASK, 1)
    for hold in (no, yes, yes):
        sums = metrics.accumulate(TASK, sums, step, ~hold, hold)
    assert (sums["fingers_ratio"], sums["fingers_ratio/of"]) == (4.0, 10.0)
    np.testing.assert_allclose(metrics.episode_errors(TASK, sums)["fingers_ratio"], [0.4])
    idle = metrics.episode_errors(TASK, metrics.empty_sums(TASK, 1))
    np.testing.assert_array_equal(idle["fingers_ratio"], [0.0])  # nothing touched: nothing wrong


def test_draws_are_the_thumb_with_one_or_more_of_the_others():
    count, zero = 4000, np.zeros(4000, int)
    allowed = np.asarray(FINGERS.sample(HAND, Draw(None, zero, zero, zero, {}), jax.random.key(0)).allowed)
    number = allowed.sum(-1)
    np.testing.assert_array_equal(allowed, np.arange(5) < number[:, None])
    shares = np.bincount(number, minlength=6) / count
    np.testing.assert_array_equal(shares[:2], 0.0)
    np.testing.assert_allclose(shares[2:], 0.25, atol=0.03)
    np.testing.assert_array_equal(FINGERS.suggested(HAND, TASK)["allowed"], PINCH[0])


def test_one_finger_is_not_valid():
    surface = Surface(np.zeros((3, 4, 3)), np.zeros((3, 4), bool))
    allowed = np.array([[1, 0, 0, 0, 0], [0, 1, 1, 0, 0], [1, 1, 1, 1, 1]], bool)
    np.testing.assert_array_equal(FINGERS.valid(surface, FingersGoal(allowed)), [False, True, True])


def test_words():
    parsed = FINGERS.parse({"fingers": ("index", "thumb")}, HAND)
    np.testing.assert_array_equal(parsed["allowed"], PINCH[0])
    assert parsed["allowed"].dtype == bool
    assert FINGERS.parse({"fingers": ()}, HAND) is None and FINGERS.parse({"fingers": ""}, HAND) is None
    with pytest.raises(CongraspError, match=r"has no finger 'pinky'.*Known: thumb, index, middle, ring, little"):
        FINGERS.parse({"fingers": ("thumb", "pinky")}, HAND)
    with pytest.raises(CongraspError, match="no finger 'little'"):
        FINGERS.parse({"fingers": ("thumb", "little")}, get_hand("allegro"))
    for one in (("thumb",), ("thumb", "thumb")):
        with pytest.raises(CongraspError, match="names one finger"):
            FINGERS.parse({"fingers": one}, HAND)


def test_features_of_a_whole_step_reach_it():
    """Against NumPy, on a random scene: the finger's room is that of its nearest keypoint's skin."""
    state, surface, goal = scene(4)
    geometry = features(HAND, TASK, state, surface, goal)
    ((_, room, _),) = FINGERS.observe(scene_of(HAND, TASK, state, surface, goal))
    skin = np.linalg.norm(geometry.nearest, axis=-1) - HAND.keypoint_radii
    for finger in range(5):
        own = [i for i, link in enumerate(HAND.keypoint_links) if (link - 1) // 3 == finger and link > 0]
        assert len(own) == 4  # three joints and a tip
        expected = np.where(goal["fingers"].allowed[:, finger], 0.0, np.minimum(skin[:, own].min(-1), 0.1))
        np.testing.assert_allclose(room[:, finger], expected, atol=1e-6)
