"""References from captures: when fingers have closed, resting poses, and other hands."""

import dataclasses
import pathlib
import types

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from congrasp.common import rotations
from congrasp.common.hands import get_hand
from congrasp.common.hands.closure import widest_gap
from congrasp.common.hands.files import HUMAN
from congrasp.common.hands.kinematics import capsules, grasp_frame, keypoints, link_transforms
from congrasp.common.objects.procedural import generate, plain_object
from congrasp.common.objects.spec import Piece
from congrasp.common.task.sampling.object_headings import HEADINGS
from congrasp.common.task.sampling.set_bank import bank_of
from congrasp.common.task.sampling.set_description import describe
from congrasp.common.wire.codec import Message
from congrasp.services.assets.captures.constraint_sets import (
    References,
    from_below,
    usable_resting_poses,
)
from congrasp.services.assets.captures.contact import (
    MAX_FRAMES_TO_CLOSE,
    before_carried,
    opposed_frame,
)
from congrasp.services.assets.captures.human import joint_positions
from congrasp.services.assets.captures.references import (
    MAX_DEPTH_M,
    check_reference,
    depth,
    width,
)
from congrasp.services.assets.captures.report import Report
from congrasp.services.assets.captures.sequence import Dropped, Sequence
from congrasp.services.assets.captures.surface import Surface
from congrasp.services.cli.capture_report import print_report
from tests.scenes import pointing
from tests.services.assets.captures import known
from tests.services.assets.captures.test_myohand import write

# --- when fingers have closed, and references that no hand can take: synthetic motions ---


FRAMES = 40
FIRST = 5
BALL = plain_object("ball", (Piece("ellipsoid", (0.01, 0.01, 0.01), (0.5, 0.5, 0.5)),), 500.0)
"""Far from the hand."""
THUMB = 0.010
INDEX = 0.009
"""Radii of the thickest skin, m."""


class Slab:
    """A surface |x| = 2 cm of which all is known."""

    def distance(self, points):
        return np.abs(points[..., 0]) - 0.02

    def normals(self, points):
        return np.sign(points[..., :1]) * [1.0, 0.0, 0.0]


def moving(joints, lift, wrist=0.0, present=True):
    """An object that does not turn, at heights (T,), and a wrist so far above it, with fingers at
    (T, 5, 4, 3).
    """
    count = len(joints)
    up = np.array([0.0, 0.0, 1.0])
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
    """Frame found for skins of thumb and index so far (T,) from a slab, m, which rises by `lift`
    (T,).
    """
    joints = np.full((FRAMES, 5, 4, 3), 0.3)  # other fingers stay away
    joints[:, 0, :, 0] = (0.02 + THUMB + thumb * np.ones(FRAMES))[:, None]
    joints[:, 1, :, 0] = -(0.02 + INDEX + index * np.ones(FRAMES))[:, None]
    return opposed_frame(moving(joints, lift, present=present), surface or Slab(), joints, FIRST)


AT = np.arange(FRAMES)
# 4 mm off at the first touch, half a millimetre less a frame
CLOSING = 0.0005 * np.maximum(FIRST + 8 - AT, 0)


def test_the_reference_is_taken_when_thumb_and_finger_have_closed():
    assert opposed(CLOSING, 0.0) == FIRST + 4  # 2 mm
    assert opposed(0.0, CLOSING) == FIRST + 4
    assert opposed(0.0, 0.0) == FIRST


def test_fingers_that_never_close_give_the_nearest_frame_within_reach():
    assert opposed(0.003 + CLOSING, 0.0) == FIRST + 8
    slow = 0.01 - 0.0001 * AT
    assert opposed(slow, 0.0) == FIRST + MAX_FRAMES_TO_CLOSE
    # The object is lifted by 1 cm a frame from the eighth frame on: three centimetres at the
    # eleventh.
    assert opposed(slow, 0.0, 0.01 * np.maximum(AT - 8, 0)) == 10
    assert opposed(CLOSING, 0.0, present=(AT != FIRST + 4)) == FIRST + 5


def test_fingers_on_one_side_do_not_oppose():
    side = Slab()
    side.normals = lambda points: np.tile([0, 1.0, 0], (*points.shape[:-1], 1))
    assert opposed(CLOSING, 0.0, surface=side) == FIRST


# For 11 frames the wrist comes down by 2 cm a frame; then the object rises by 6 mm a frame, 6 cm at
# frame 20.
WRIST = np.concatenate([np.arange(0.30, 0.095, -0.02), np.full(10, 0.10)])
LIFT = np.concatenate([np.zeros(11), 0.006 * np.arange(1, 11)])


def picked(wrist, lift, present=True):
    """Frame found for a grasp that is noticed at frame 20."""
    motion = moving(np.zeros((21, 5, 4, 3)), lift, wrist, present)
    return before_carried(motion, np.outer(wrist, [0.0, 0.0, 1.0]), 20)


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
def test_an_object_not_carried_by_the_hand_keeps_the_frame(wrist, lift):
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
    assert not report.dropped
    assert list(sets) == ["box"]
    _, report = pinch(0.03, code=2)
    assert report.rules()[0][:2] == ("too deep", 1)
    assert "mm deep in the object (10 mm at most)" in report.rules()[0][2]


def straight(contact):
    """A demonstration with the hand's frame that of the object, which is touched at points (n,
    3).
    """
    return types.SimpleNamespace(
        name="wide",
        q=HUMAN.q_open,
        position=np.zeros((1, 3)),
        quaternion=np.array([[1.0, 0, 0, 0]]),
        contact=np.asarray(contact, float),
    )


def test_an_object_wider_than_the_hand_opens_is_dropped():
    opening = widest_gap(HUMAN)
    cross = np.asarray(grasp_frame(HUMAN).cross)
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
    ends = np.asarray(capsules(HUMAN, link_transforms(HUMAN, jnp.array(HUMAN.q_open)))).reshape(
        -1, 3
    )
    lowest = (ends[:, 2] - np.repeat(HUMAN.capsule_radii, 2)).min()

    def block(deep):
        return plain_object(
            "block", (Piece("box", (0.3, 0.3, 0.1), (0.0, 0.0, lowest + deep - 0.1)),), 500.0
        )

    for deep in (-0.02, 0.003, 0.012):
        assert depth(held, block(deep)) == pytest.approx(deep, abs=1e-6)
    check_reference(HUMAN, held, block(0.9 * MAX_DEPTH_M), 1.0)
    with pytest.raises(Dropped, match="12 mm deep in the object"):
        check_reference(HUMAN, held, block(0.012), 1.0)
    # It closes around the object by itself
    check_reference(get_hand("allegro"), held, block(0.012), 1.0)


def test_normals_of_a_surface_point_outwards():
    obj = generate(3, "ball")
    points = 1.2 * obj.points.astype(float)
    normals = Surface(obj).normals(points)
    assert (np.einsum("ni,ni->n", normals, obj.normals) > 0.9).all()


# --- resting poses ---


def test_the_hand_is_not_in_the_table_or_as_little_as_can_be():
    """A hand from straight above, in resting poses in which the table is 1 mm, 15 mm and 45 mm too
    high for it.

    Further hands are 3 and 15 mm lower: one is requested in the first of them alone, 4 mm in the
    table, and the other, 16 mm in it, in none.
    """
    turn = pointing(-1.0)
    ends = np.asarray(capsules(HUMAN, link_transforms(HUMAN, jnp.array(HUMAN.q_open)))).reshape(
        -1, 3
    )
    ends = np.asarray(rotations.rotate(jnp.broadcast_to(turn, (len(ends), 4)), jnp.array(ends)))
    reach = -(ends[:, 2] - np.repeat(HUMAN.capsule_radii, 2)).min()
    path = np.zeros((3, 4, 3), np.float32)
    path[:, :, 2] = reach + np.linspace(0.1, 0, 4)
    path[1:, :, 2] -= np.array([[0.003], [0.015]])
    quaternion = np.broadcast_to(np.asarray(turn), (3, 4, 4))
    rest = np.array([[0, 0, -depth, 1, 0, 0, 0] for depth in (0.001, 0.015, 0.045)], np.float32)
    q = np.stack([HUMAN.q_open] * 3).astype(np.float32)
    allowed = usable_resting_poses(HUMAN, References(q, path, quaternion), rest)
    np.testing.assert_array_equal(
        allowed, [[True, False, False], [True, False, False], [False, False, False]]
    )
    rest[1, 2] = 0.02
    allowed = usable_resting_poses(HUMAN, References(q, path, quaternion), rest)
    np.testing.assert_array_equal(
        allowed, [[True, True, False], [False, True, False], [False, True, False]]
    )


# --- sequences of which no episode is drawn ---


def test_from_below_means_excluded_by_the_approach_alone():
    """By hand: an object whose centre is 10 cm high; wrists 5 cm over it and 9 cm under, coming
    down, up and up.
    """
    turns = [pointing(z) for z in (-1.0, 1.0, 1.0)]
    path = np.zeros((2, 3, 15, 3), np.float32)
    path[..., 2] = np.array([0.05, 0.05, -0.09])[:, None]
    arrays = {
        "trajectory/position": path,
        "pose/quaternion": np.stack([np.stack(turns)] * 2),
        "rest": np.array([[0, 0, 0.1, 1, 0, 0, 0]], np.float32),
    }
    np.testing.assert_array_equal(from_below(HUMAN, Message(arrays, {})), [False, True, False])


def test_the_report_names_them(capsys):
    def row(
        name: str, *, clear: bool, below: bool, overlap: float = 0.0, moved: float = 0.0
    ) -> dict:
        place = {
            "clear_of_table": clear,
            "from_below": below,
            "split": "held-out" if name == "dig" else "training",
        }
        apart = {"overlap_m": overlap, "moved_apart_rad": moved}
        later = {"frames_after_touch": 4 if below else 0}
        return {"sequence": name, "object": "box", "residual_rad": 0.0} | place | apart | later

    sequences = [
        row("lift", clear=True, below=False),
        row("scoop", clear=False, below=True, overlap=0.004, moved=0.1),
        row("push", clear=False, below=False, overlap=0.003, moved=0.2),
        row("dig", clear=False, below=True),
    ]
    print_report(Report(sequences), "human", pathlib.Path("sets"), pathlib.Path("objects"))
    printed = capsys.readouterr().out
    assert "room for 1 of 4" in printed
    assert "In 2 of 4, thumb and fingers oppose only after the first touch" in printed
    assert "the reference is taken then, 4 frames later on average" in printed
    assert "of 2 overlapped, by up to 4.0 mm (scoop)" in printed
    assert "by 0.15 rad on average, at most 0.20 rad (push)" in printed
    assert (
        "No episode is drawn from 2, whose hand comes from below, which no episode does: scoop, "
        "dig." in printed
    )
    assert "No episode is drawn from 1, whose hand comes too near to the table: push." in printed
    assert "3 sequences are for training, 1 held out." in printed


# --- robot hands ---


def axes(hand):
    frame = grasp_frame(hand)
    return np.stack([frame.heading, frame.cross])


@pytest.mark.parametrize("name", ["allegro", pytest.param("sharpa", marks=pytest.mark.slow)])
def test_the_hand_centre_and_grasp_axes_follow_the_human_ones(run_import, tmp_path, capsys, name):
    cases = [known.make(f"MyoHand_box_lift{seed}", "box", seed, tail=0.04) for seed in range(2)]
    for case in cases:
        write(case, tmp_path / "data" / f"{case.name}.npz")
    # Beyond what a human finger can do, which does not matter to another hand.
    far = np.load(tmp_path / "data" / f"{cases[1].name}.npz")["robot"]
    far[:, 9 + 19] = HUMAN.upper[19] + 0.5
    write(cases[1], tmp_path / "data" / f"{cases[1].name}.npz", robot=far)
    known.write_mesh(cases[0], tmp_path / "meshes" / "box.stl")
    options = ["--meshes", tmp_path / "meshes", "--headings", "demonstrated"]
    sets, report = run_import("myohand", tmp_path / "data", "--hand", name, *options)
    assert not report.dropped
    assert "finger angles do not fit" in " ".join(capsys.readouterr().out.split())

    hand = get_hand(name)
    scale = get_hand(name).object_scale
    constraint_set = sets["box"]
    arrays = constraint_set.arrays
    assert constraint_set.meta["hand"] == name
    assert constraint_set.meta["object_scale"] == scale
    assert len(describe(constraint_set)["captured"].split(", ")) == 2
    for m, case in enumerate(cases):
        q = arrays["pose/q"][0, m]
        assert q.shape == hand.lower.shape
        assert (q >= hand.lower).all()
        assert (q <= hand.upper).all()
        tips = np.asarray(keypoints(hand, link_transforms(hand, jnp.asarray(q))))[len(hand.links) :]
        center = (tips[0] + tips[1:].mean(0)) / 2
        human = np.clip(far[-1, 9:] if m else case.q, HUMAN.lower, HUMAN.upper)
        human_tips = joint_positions(human)[:, 3]
        position, turns = case.waypoints()
        centre = scale * (position + turns.apply((human_tips[0] + human_tips[1:].mean(0)) / 2))
        rotation = Rotation.from_quat(arrays["trajectory/quaternion"][0, m], scalar_first=True)
        path = arrays["trajectory/position"][0, m]
        # The hand centre of the closed hand, wrist frame
        held = rotation[-1].inv().apply(centre[-1] - path[-1])
        np.testing.assert_allclose(path + rotation.apply(held), centre, atol=1e-3)
        assert np.linalg.norm(held - center) < 0.03  # fingers that close again move it a little
        for ours, theirs in zip(axes(hand), axes(HUMAN), strict=True):
            assert (
                np.linalg.norm(rotation.apply(ours) - turns.apply(theirs), axis=-1) < 0.01
            ).all()
        np.testing.assert_allclose(arrays["heading/position"][0, m], centre[-1], atol=1e-3)
        np.testing.assert_array_equal(
            arrays["pose/position"][0, m], arrays["trajectory/position"][0, m, -1]
        )
    assert arrays["heading/position"].shape[1] == HEADINGS
    assert bank_of([constraint_set]).pose_q.shape[-1] == len(hand.joints)
