"""The frame in which fingers have closed, and references that no hand can take: synthetic motions."""

import dataclasses
import pathlib
import types

import jax.numpy as jnp
import numpy as np
import pytest

from congrasp.common.hands import get_hand
from congrasp.common.hands.closure import widest_gap
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.kinematics import capsules, grasp_frame, link_transforms
from congrasp.common.objects.procedural import generate, plain_object
from congrasp.common.objects.spec import Piece
from congrasp.services.assets.captures.extract import LATER, Surface, _before_carried, _opposed
from congrasp.services.assets.captures.references import DEEPEST, check_reference, depth, width
from congrasp.services.assets.captures.sequence import Dropped, Sequence
from tests.services.assets.captures import known
from tests.services.assets.captures.test_myohand import write

FRAMES, FIRST = 40, 5
BALL = plain_object("ball", (Piece("ellipsoid", (0.01, 0.01, 0.01), (0.5, 0.5, 0.5)),), 500.0)
"""Far from the hand."""
THUMB, INDEX = 0.010, 0.009
"""Radii of the thickest skin, m."""


class Slab:
    """A surface |x| = 2 cm of which all is known."""

    def distance(self, points):
        return np.abs(points[..., 0]) - 0.02

    def normals(self, points):
        return np.sign(points[..., :1]) * [1.0, 0.0, 0.0]


def moving(joints, lift, wrist=0.0, present=True):
    """An object that does not turn, at heights (T,), and a wrist so far above it, with fingers at (T, 5, 4, 3)."""
    count, up = len(joints), np.array([0.0, 0.0, 1.0])
    return Sequence(
        name="lift",
        object_name="box",
        mesh=pathlib.Path("box.stl"),
        wrist_position=np.outer(lift + wrist * np.ones(count), up),
        wrist_rotation=np.tile(np.eye(3), (count, 1, 1)),
        joints=joints,
        object_position=np.outer(lift * np.ones(count), up),
        object_rotation=np.tile(np.eye(3), (count, 1, 1)),
        present=np.broadcast_to(present, count),
    )


def opposed(thumb, index, lift=0.0, present=True, surface=None):
    """Frame found for skins of thumb and index so far (T,) from a slab, m, which rises by `lift` (T,)."""
    joints = np.full((FRAMES, 5, 4, 3), 0.3)  # other fingers stay away
    joints[:, 0, :, 0] = (0.02 + THUMB + thumb * np.ones(FRAMES))[:, None]
    joints[:, 1, :, 0] = -(0.02 + INDEX + index * np.ones(FRAMES))[:, None]
    return _opposed(moving(joints, lift, present=present), surface or Slab(), joints, FIRST)


AT = np.arange(FRAMES)
CLOSING = 0.0005 * np.maximum(FIRST + 8 - AT, 0)  # 4 mm off at the first touch, half a millimetre less a frame


def test_the_reference_is_taken_when_thumb_and_finger_have_closed():
    assert opposed(CLOSING, 0.0) == FIRST + 4  # 2 mm
    assert opposed(0.0, CLOSING) == FIRST + 4
    assert opposed(0.0, 0.0) == FIRST


def test_fingers_that_never_close_give_the_nearest_frame_within_reach():
    assert opposed(0.003 + CLOSING, 0.0) == FIRST + 8
    slow = 0.01 - 0.0001 * AT
    assert opposed(slow, 0.0) == FIRST + LATER
    # The object is lifted by 1 cm a frame from the eighth frame on: three centimetres at the eleventh.
    assert opposed(slow, 0.0, 0.01 * np.maximum(AT - 8, 0)) == 10
    assert opposed(CLOSING, 0.0, present=(AT != FIRST + 4)) == FIRST + 5


def test_fingers_on_one_side_do_not_oppose():
    side = Slab()
    side.normals = lambda points: np.tile([0, 1.0, 0], (*points.shape[:-1], 1))
    assert opposed(CLOSING, 0.0, surface=side) == FIRST


# For 11 frames the wrist comes down by 2 cm a frame; then the object rises by 6 mm a frame, 6 cm at frame 20.
WRIST = np.concatenate([np.arange(0.30, 0.095, -0.02), np.full(10, 0.10)])
LIFT = np.concatenate([np.zeros(11), 0.006 * np.arange(1, 11)])


def picked(wrist, lift, present=True):
    """Frame found for a grasp that is noticed at frame 20."""
    motion = moving(np.zeros((21, 5, 4, 3)), lift, wrist, present)
    return _before_carried(motion, np.outer(wrist, [0.0, 0.0, 1.0]), 20)


def test_a_grasp_that_is_noticed_late_belongs_to_where_the_object_was_picked_up():
    assert picked(WRIST, LIFT) == 11  # the last frame within a centimetre of the place
    # Missing frames do not count: at frame 9 the wrist is 2 cm from where it will be.
    assert picked(WRIST, LIFT, ~np.isin(np.arange(21), (10, 11))) == 9


@pytest.mark.parametrize(
    ("wrist", "lift"),
    [
        (WRIST, 0.45 * LIFT),  # 2.7 cm: nudged
        (WRIST, 0 * LIFT),
        (np.linspace(0.30, 0.10, 21), LIFT),  # another hand lifts it while this one comes
    ],
)
def test_an_object_that_this_hand_does_not_carry_leaves_the_frame_as_it_is(wrist, lift):
    assert picked(wrist, lift) == 20


@pytest.fixture
def pinch(tmp_path, run_import):
    """Imports a pinched box, of which `grow` m are added to the edge between the fingers."""

    def run(grow, code=0):
        case = known.make("MyoHand_box_lift", "box")
        write(case, tmp_path / "data" / f"{case.name}.npz")
        wider = dataclasses.replace(case, size=case.size + np.array([grow, 0, 0]))
        known.write_mesh(wider, tmp_path / "meshes" / "box.stl")
        return run_import("myohand", tmp_path / "data", "--meshes", tmp_path / "meshes", code=code)

    return run


def test_a_reference_that_is_deep_in_its_object_is_dropped_and_counted(pinch):
    sets, report = pinch(0.004)
    assert not report.dropped and list(sets) == ["box"]
    _, report = pinch(0.03, code=2)
    assert report.rules()[0][:2] == ("too deep", 1)
    assert "mm deep in the object (10 mm at most)" in report.rules()[0][2]


def straight(contact):
    """A demonstration with the hand's frame that of the object, which is touched at points (n, 3)."""
    return types.SimpleNamespace(
        name="wide",
        q=HUMAN.q_open,
        position=np.zeros((1, 3)),
        quaternion=np.array([[1.0, 0, 0, 0]]),
        contact=np.asarray(contact, float),
    )


def test_what_is_wider_than_the_hand_opens_is_too_wide():
    opening, cross = widest_gap(HUMAN), np.asarray(grasp_frame(HUMAN).cross)
    fitting, wide = (straight(np.outer([0, share * opening], cross)) for share in (0.97, 1.03))
    assert width(fitting) == pytest.approx(0.97 * opening)
    check_reference(HUMAN, fitting, BALL, 1.0)
    with pytest.raises(Dropped, match="cm apart, but the hand opens only") as error:
        check_reference(HUMAN, wide, BALL, 1.0)
    assert error.value.rule == "too wide"
    with pytest.raises(Dropped):  # lengths grow with a robot hand's objects
        check_reference(HUMAN, straight(np.outer([0, 0.9 * opening], cross)), BALL, 1.4)
    assert width(straight(np.zeros((0, 3)))) == 0.0


def test_depth_is_that_of_the_deepest_skin():
    """By hand: below the open hand, a block rises into its lowest skin."""
    held = straight(np.zeros((0, 3)))
    ends = np.asarray(capsules(HUMAN, link_transforms(HUMAN, jnp.array(HUMAN.q_open)))).reshape(-1, 3)
    lowest = (ends[:, 2] - np.repeat(HUMAN.capsule_radii, 2)).min()

    def block(deep):
        return plain_object("block", (Piece("box", (0.3, 0.3, 0.1), (0.0, 0.0, lowest + deep - 0.1)),), 500.0)

    for deep in (-0.02, 0.003, 0.012):
        assert depth(held, block(deep)) == pytest.approx(deep, abs=1e-6)
    check_reference(HUMAN, held, block(0.9 * DEEPEST), 1.0)
    with pytest.raises(Dropped, match="12 mm deep in the object"):
        check_reference(HUMAN, held, block(0.012), 1.0)
    check_reference(get_hand("allegro"), held, block(0.012), 1.0)  # it closes around the object by itself


def test_normals_of_a_surface_point_outwards():
    obj = generate(3, "ball")
    points = 1.2 * obj.points.astype(float)
    normals = Surface(obj).normals(points)
    assert (np.einsum("ni,ni->n", normals, obj.normals) > 0.9).all()
