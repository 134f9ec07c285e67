"""The constraint `fingers`, against numbers worked out by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from congrasp.common import rotations
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand, kinematics
from congrasp.common.objects import procedural
from congrasp.common.policy.bundle import load
from congrasp.common.policy.pretrained import policy_file, pretrained_hands
from congrasp.common.task import metrics
from congrasp.common.task.config import RewardWeights, TaskConfig
from congrasp.common.task.constraints import get_constraint
from congrasp.common.task.constraints.fingers import FingersGoal, finger_sets
from congrasp.common.task.geometry import hand_center
from congrasp.common.task.observation import fields, layout
from congrasp.common.task.reward import keypoint_weights, reward_terms, terms
from congrasp.common.task.sampling.bank import Draw
from congrasp.common.task.types import Surface
from congrasp.services.grasp.parse import read_request
from tests.scenes import HAND, L, active, evaluated, lone_scene, scene, scene_of

FINGERS = get_constraint("fingers")
HEADING = get_constraint("heading")
TASK = TaskConfig(constraints=("heading", "fingers"))
BOX = procedural.generate(0, "box")
PINCH = np.array([[True, True, False, False, False]])
# Links and tips in the order of the human hand: palm, then three links of thumb, index, middle,
# ring and little finger.
PALM = 0
THUMB = 3
INDEX = 6
MIDDLE = 9
RING = 12
THUMB_TIP = 16
MIDDLE_TIP = 18
RING_TIP = 19


def pinch(on: bool = True):
    """The object is 2 cm from the middle finger's skin, 4 mm from the ring finger's, and far from
    the rest.

    Palm, thumb, index, middle and ring finger touch it; index and middle with 3 and 5 N.
    """
    pinching = lone_scene(TASK, *["fingers"] * on, fingers={"allowed": PINCH})
    nearest = np.zeros((1, len(HAND.keypoints), 3), np.float32)
    nearest[..., 0] = 0.2
    nearest[0, THUMB_TIP] = [0.001, 0.0, 0.0]
    nearest[0, MIDDLE_TIP] = [0.0, 0.02 + 0.007, 0.0]
    nearest[0, RING_TIP] = [0.0, 0.0, -0.004 - 0.0068]
    touching = np.isin(np.arange(L), (PALM, THUMB, INDEX, MIDDLE, RING))[None]
    force = np.zeros((1, L, 3), np.float32)
    force[0, INDEX, 0] = 3.0
    force[0, MIDDLE, 2] = 5.0
    return pinching._replace(
        features=pinching.features._replace(nearest=nearest, touching=touching, force=force)
    )


def test_links_belong_to_fingers():
    assert HAND.fingers == ("thumb", "index", "middle", "ring", "little")
    np.testing.assert_array_equal(HAND.link_fingers, [-1, *np.repeat(np.arange(5), 3)])
    assert get_hand("allegro").fingers == ("thumb", "index", "middle", "ring")
    assert FINGERS.labels(HAND) == {"allowed": HAND.fingers}
    np.testing.assert_allclose(HAND.keypoint_radii[[MIDDLE_TIP, RING_TIP]], [0.007, 0.0068])


def test_observation_by_hand():
    ((allowed, room, force),) = evaluated(FINGERS.observe, pinch())
    np.testing.assert_array_equal(allowed, [[1, 1, 0, 0, 0]])
    # The thumb at the object may be there, and the little finger is more than 10 cm away.
    np.testing.assert_allclose(room, [[0.0, 0.0, 0.02, 0.004, 0.1]], atol=1e-6)
    expected = np.zeros((L, 3))
    expected[MIDDLE] = [0.0, 0.0, 0.5]  # 5 / (5 + 5); the index finger may press
    np.testing.assert_allclose(force, expected.reshape(1, -1), atol=1e-6)
    assert [field.size for field in fields(HAND, TASK)["fingers"]] == [5, 5, 48]


def test_reward_by_hand():
    paid = evaluated(FINGERS.reward, pinch())
    # softplus((10 - 20 mm) / 3 mm) = 0.03505, softplus((10 - 4 mm) / 3 mm) = 2.12693, and nothing
    # 19 cm away.
    np.testing.assert_allclose(paid["fingers_distance"], [-2.16198], rtol=1e-5)
    np.testing.assert_allclose(paid["fingers_contact"], [-2.0])
    assert not any(np.any(value) for value in evaluated(FINGERS.reward, pinch(on=False)).values())
    weighted = evaluated(reward_terms, pinch(), RewardWeights())
    np.testing.assert_allclose(weighted["fingers_contact"], [-0.6])
    np.testing.assert_allclose(weighted["fingers_distance"], [-0.0432396], rtol=1e-5)


def test_contacts_of_other_fingers_earn_nothing():
    weights = HAND.contact_weights
    unit = RewardWeights(**dict.fromkeys(terms(TASK), 1.0), force_max=5.0)
    paid = evaluated(reward_terms, pinch(), unit)
    free = evaluated(reward_terms, pinch(on=False), unit)
    np.testing.assert_allclose(paid["contact"], [weights[[PALM, THUMB, INDEX]].sum()], rtol=1e-6)
    np.testing.assert_allclose(paid["force"], [weights[INDEX] * 3 / 5], rtol=1e-6)
    np.testing.assert_allclose(
        free["contact"], [weights[[PALM, THUMB, INDEX, MIDDLE, RING]].sum()], rtol=1e-6
    )
    np.testing.assert_allclose(free["force"], [weights[INDEX] * 3 / 5 + weights[MIDDLE]], rtol=1e-6)


def test_error_is_the_share_of_other_fingers_links():
    for on in (True, False):  # measured whether or not it is active
        wrong, all_of_them = evaluated(FINGERS.measure, pinch(on))["fingers_ratio"]
        assert wrong == 2.0
        assert all_of_them == 5.0
    step = evaluated(metrics.errors, pinch())
    yes = np.ones(1, bool)
    no = np.zeros(1, bool)
    sums = metrics.empty_sums(TASK, 1)
    for hold in (no, yes, yes):
        sums = metrics.accumulate(TASK, sums, step, ~hold, hold)
    assert sums["fingers_ratio"] == 4.0
    assert sums["fingers_ratio/of"] == 10.0
    np.testing.assert_allclose(metrics.episode_errors(TASK, sums)["fingers_ratio"], [0.4])
    idle = metrics.episode_errors(TASK, metrics.empty_sums(TASK, 1))
    np.testing.assert_array_equal(idle["fingers_ratio"], [0.0])  # nothing touched: nothing wrong


def test_draws_are_the_thumb_with_any_of_the_others():
    """By hand: 15 sets of the human hand; half of the draws are pinch, tripod or all, the other
    half any of the 15.
    """
    zero = np.zeros(6000, int)
    uniform = np.random.default_rng(0).uniform(size=(6000, 1)).astype(np.float32)
    allowed = np.asarray(FINGERS.sample(HAND, Draw(None, zero, zero, zero, {}), uniform).allowed)
    assert allowed[:, 0].all()
    assert allowed[:, 1:].any(-1).all()
    number = allowed @ (1 << np.arange(5))
    shares = np.bincount(number, minlength=32) / len(number)
    expected = np.full(32, 1 / 30) * (np.arange(32) % 2)
    expected[1] = 0.0
    expected[[0b00011, 0b00111, 0b11111]] += 1 / 6
    np.testing.assert_allclose(shares, expected, atol=0.02)
    np.testing.assert_array_equal(FINGERS.suggested(HAND, TASK)["allowed"], PINCH[0])


@pytest.mark.parametrize(("hand", "count"), [("human", 15), ("allegro", 7)])
def test_sets_are_all_with_a_thumb_and_another_finger(hand, count):
    sets, shares = finger_sets(get_hand(hand))
    assert len(sets) == count == len({row.tobytes() for row in sets})
    assert shares.sum() == pytest.approx(1.0)
    assert sets[:, 0].all()
    assert sets[:, 1:].any(-1).all()
    likely = {tuple(row.nonzero()[0].tolist()) for row in sets[shares > 2 * shares.min()]}
    assert likely == {(0, 1), (0, 1, 2), tuple(range(sets.shape[1]))}


def test_a_set_needs_the_thumb_and_another_finger():
    surface = Surface(np.zeros((4, 4, 3)), np.zeros((4, 4), bool))
    allowed = np.array([[1, 0, 0, 0, 0], [0, 1, 1, 0, 0], [1, 0, 0, 1, 0], [1, 1, 1, 1, 1]], bool)
    np.testing.assert_array_equal(
        FINGERS.valid(surface, FingersGoal(allowed)), [False, False, True, True]
    )


def test_the_hand_centre_is_that_of_the_set():
    """By hand, of tips on a line: a pinch is midway between thumb and index, thumb and two others
    at their mean.
    """
    points = np.zeros((3, len(HAND.keypoints), 3), np.float32)
    points[:, len(HAND.links) :, 0] = [0.0, 0.2, 0.4, 0.6, 1.2]
    fingers = np.array([[1, 1, 0, 0, 0], [1, 0, 1, 0, 1], [1, 1, 1, 1, 1]], bool)
    np.testing.assert_allclose(hand_center(HAND, points, fingers)[:, 0], [0.1, 0.4, 0.3], atol=1e-6)
    np.testing.assert_array_equal(hand_center(HAND, points), kinematics.hand_center(HAND, points))
    with_pinch = pinch()
    without = pinch(on=False)
    tips = np.asarray(with_pinch.features.keypoints)[:, len(HAND.links) :]
    np.testing.assert_allclose(with_pinch.features.center, (tips[:, 0] + tips[:, 1]) / 2, atol=1e-6)
    np.testing.assert_allclose(
        without.features.center, (tips[:, 0] + tips[:, 1:].mean(1)) / 2, atol=1e-6
    )


def test_the_distance_reward_is_that_of_the_set():
    """By hand: 21 keypoints, of which 5 tips count four times, are 36 units; of a pinch 1 + 6 + 2 x
    4 = 15 count.
    """
    assert len(HAND.keypoints) == 21
    rewards = evaluated(reward_terms, pinch(), RewardWeights(**dict.fromkeys(terms(TASK), 1.0)))[
        "distance"
    ]
    # 6 link origins and the palm at 0.2 m, the thumb's tip at 1 mm, the index finger's at 0.2 m;
    # all weigh 21 together.
    np.testing.assert_allclose(rewards, [-21 / 15 * (7 * 0.2 + 4 * 0.001 + 4 * 0.2)], rtol=1e-5)
    free = evaluated(
        reward_terms, pinch(on=False), RewardWeights(**dict.fromkeys(terms(TASK), 1.0))
    )["distance"]
    far = 16 * 0.2 + 4 * (0.001 + 0.2 + 0.027 + 0.0108 + 0.2)
    np.testing.assert_allclose(free, [-21 / 36 * far], rtol=1e-5)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 14))
def test_fingers_that_may_not_touch_move_neither_centre_nor_distance(seed, which):
    chosen = np.broadcast_to(finger_sets(HAND)[0][which], (2, 5))
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(2, len(HAND.keypoints), 3)).astype(np.float32)
    owner = HAND.link_fingers[HAND.keypoint_links]
    other = (owner >= 0) & ~chosen[0][owner]
    moved = points + other[:, None] * rng.normal(size=points.shape).astype(np.float32)
    np.testing.assert_allclose(
        hand_center(HAND, points, chosen), hand_center(HAND, moved, chosen), atol=1e-6
    )
    weights = np.asarray(keypoint_weights(HAND, chosen))
    assert (weights[:, other] == 0).all()
    assert (weights[:, ~other] > 0).all()
    np.testing.assert_allclose(weights.sum(-1), HAND.keypoint_weights.sum(), rtol=1e-5)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_pinch_begins_and_ends_at_the_heading(seed):
    """The wrist is placed by the set's centre, so that a hand that only moves forward arrives with
    no error.
    """
    goal = dataclasses.replace(scene(seed)[2], active=active("fingers"))
    np.testing.assert_allclose(_arrived(goal), goal["heading"].position, atol=1e-5)


@jax.jit
def _arrived(goal):
    """The set's centre once the open hand has moved forward by the distance at which it begins."""
    q = jnp.tile(jnp.array(HAND.q_open), (4, 1))
    position, quaternion = HEADING.initial_wrist(HAND, jnp.full(4, TASK.back_off), goal, q)[1:]
    points = kinematics.keypoints(HAND, kinematics.link_transforms(HAND, q))
    center = hand_center(HAND, points, goal["fingers"].allowed)
    return (
        position + TASK.back_off * goal["heading"].direction + rotations.rotate(quaternion, center)
    )


@pytest.mark.parametrize("hand", pretrained_hands())
def test_layout_of_shipped_policies_is_unchanged(hand):
    bundle = load(policy_file(None, hand))
    assert layout(get_hand(hand), bundle.task) == bundle.spec.layout


def test_words():
    parsed = FINGERS.parse({"fingers": ("index", "thumb")}, HAND, BOX)
    np.testing.assert_array_equal(parsed["allowed"], PINCH[0])
    assert parsed["allowed"].dtype == bool
    for written in (
        ("thumb", "index"),
        "thumb index",
        "thumb, index",
        "thumb,index",
        ["thumb", "index"],
    ):
        np.testing.assert_array_equal(
            read_request(BOX, HAND, 15, fingers=written).given("fingers", "allowed"), PINCH[0]
        )
    assert read_request(BOX, HAND, 15).given("fingers", "allowed") is None
    assert FINGERS.parse({"fingers": ()}, HAND, BOX) is None
    assert FINGERS.parse({"fingers": ""}, HAND, BOX) is None
    with pytest.raises(
        CongraspError, match=r"has no finger 'pinky'.*from: thumb, index, middle, ring, little"
    ):
        FINGERS.parse({"fingers": ("thumb", "pinky")}, HAND, BOX)
    with pytest.raises(CongraspError, match="no finger 'little'"):
        FINGERS.parse({"fingers": ("thumb", "little")}, get_hand("allegro"), BOX)
    with pytest.raises(
        CongraspError, match=r"^--fingers lacks the thumb, which every grasp needs\. Add thumb\.$"
    ):
        FINGERS.parse({"fingers": ("index", "middle")}, HAND, BOX)
    for one in (("thumb",), ("thumb", "thumb")):
        with pytest.raises(CongraspError, match="has only one finger"):
            FINGERS.parse({"fingers": one}, HAND, BOX)


def test_features_of_a_whole_step_reach_it():
    """Against NumPy, on a random scene: the finger's room is that of its nearest keypoint's
    skin.
    """
    state, surface, goal = scene(4)
    scene_of_step = scene_of(TASK, state, surface, goal)
    ((_, room, _),) = evaluated(FINGERS.observe, scene_of_step)
    skin = np.linalg.norm(scene_of_step.features.nearest, axis=-1) - HAND.keypoint_radii
    for finger in range(5):
        per_step = [
            i
            for i, link in enumerate(HAND.keypoint_links)
            if (link - 1) // 3 == finger and link > 0
        ]
        assert len(per_step) == 4  # three joints and a tip
        expected = np.where(
            goal["fingers"].allowed[:, finger], 0.0, np.minimum(skin[:, per_step].min(-1), 0.1)
        )
        np.testing.assert_allclose(room[:, finger], expected, atol=1e-6)
