"""The planned approach is free of contact, and within the limits of an arm."""

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.actors.initial_hand import handover_speed
from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.kinematics import grasp_frame
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.objects import procedural
from congrasp.common.rotations import rotate
from congrasp.common.task.config import TaskConfig
from congrasp.services.grasp.files import steps_to_draw
from congrasp.services.grasp.jobs import find_objects, rest_pose
from congrasp.services.grasp.reach import (
    ACCELERATION,
    CLEARANCE,
    SPEED,
    TURNING,
    Reach,
    plan_reach,
    with_reach,
)
from congrasp.services.grasp.reference_files import grasp_part
from tests.episodes import CONTROL_DT, episode

DT = 0.01
BALL = 0.04  # m


@pytest.fixture(scope="module")
def ball():
    obj = procedural.generate(1, "ball")
    return obj.scaled(2 * BALL / np.ptp(obj.visual_vertices, axis=0).max())


def beginning(hand, heading: np.ndarray, ball, away: float) -> Reach:
    """The open hand with a heading, its centre `away` (m) from the ball's."""
    frame = grasp_frame(hand)
    across = np.cross(heading, [0.3, 0.9, 0.1])
    turn = Rotation.align_vectors([heading, across], [frame.heading, frame.cross])[0]
    center = ball.rest_poses[0][:3] - away * heading
    position = center - turn.apply(frame.center)
    return Reach(position[None], Rotation.concatenate([turn]), hand.q_open[None].astype(float))


def clearance(hand, reach: Reach, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) exact distances of the hand's capsules from a ball, and from the table."""
    ball = []
    table = []
    origins = np.array(
        [link.joints[0].anchor if link.joints else (0.0, 0.0, 0.0) for link in hand.links]
    )
    for q, turn, place in zip(reach.q, reach.rotation, reach.position, strict=True):
        position, quaternion = mujoco_link_poses(hand, q)
        links = Rotation.from_quat(quaternion, scalar_first=True)
        for ends, radius, link in zip(
            hand.capsules, hand.capsule_radii, hand.capsule_links, strict=True
        ):
            a, b = turn.apply(links[int(link)].apply(ends - origins[link]) + position[link]) + place
            share = np.clip((center - a) @ (b - a) / max((b - a) @ (b - a), 1e-12), 0, 1)
            ball.append(np.linalg.norm(a + share * (b - a) - center) - BALL - radius)
            table.append(min(a[2], b[2]) - radius)
    shape = len(reach.q), -1
    return np.reshape(ball, shape).min(1), np.reshape(table, shape).min(1)


@pytest.mark.parametrize(
    ("name", "heading", "speed"),
    [("human", (-1.0, 0.2, -0.4), 0.36), ("allegro", (0.0, 0.0, -1.0), 0.0)],
)
def test_the_reach_is_free_of_contact_and_within_the_limits_of_an_arm(
    name, heading, speed, ball
) -> None:
    hand = get_hand(name)
    way = np.array(heading) / np.linalg.norm(heading)
    first = beginning(hand, way, ball, 0.16)
    rest = np.asarray(ball.rest_poses[0], float)
    reach = plan_reach(hand, ball, rest, way, first, 0.2, DT, speed)
    away, end = (
        np.linalg.norm((place - rest[:3])[:2]) for place in (reach.position[0], first.position[0])
    )
    assert away == pytest.approx(max(0.45, end + 0.22), abs=1e-6)
    full_reach = Reach(
        np.concatenate([reach.position, first.position]),
        Rotation.concatenate([reach.rotation, first.rotation]),
        np.concatenate([reach.q, first.q]),
    )
    near, low = clearance(hand, full_reach, rest[:3])
    assert near.min() > min(CLEARANCE, near[-1]) - 2e-3
    assert low.min() > min(CLEARANCE, low[-1]) - 2e-3
    velocity = np.diff(full_reach.position, axis=0) / DT
    assert np.linalg.norm(velocity, axis=1).max() < 1.02 * SPEED
    np.testing.assert_allclose(velocity[-1], speed * way, atol=0.02)
    acceleration = np.diff(velocity, axis=0, prepend=0 * velocity[:1], append=[speed * way]) / DT
    assert np.linalg.norm(acceleration, axis=1).max() < 1.05 * ACCELERATION
    turned = (full_reach.rotation[:-1].inv() * full_reach.rotation[1:]).magnitude() / DT
    assert turned.max() < 1.02 * TURNING
    slow = plan_reach(hand, ball, rest, way, first, 3.0, DT, speed)
    assert len(slow.q) == 300
    steps = np.diff(slow.position, axis=0)
    assert (steps[1:] * steps[:-1]).sum(-1).min() > -1e-9  # it never goes back


def test_the_reach_ends_at_nine_tenths_of_the_speed_of_the_guidance() -> None:
    hand = get_hand("human")
    task = TaskConfig()
    further = dataclasses.replace(
        task, control=dataclasses.replace(task.control, approach_position_limit=0.04)
    )
    speeds = [handover_speed(hand, one) for one in (task, further)]  # its servos: 20/s
    assert speeds == pytest.approx([0.9 * 0.02 * 20, 0.9 * 0.04 * 20])


def test_an_unreachable_grasp_is_an_error(ball) -> None:
    hand = get_hand("human")
    first = beginning(hand, np.array([0.0, 0.0, 1.0]), ball, 0.16)  # from below, through the table
    with pytest.raises(
        CongraspError,
        match=r"Every planned approach to a grasp of .* touches .* Leave out the approach",
    ):
        plan_reach(
            hand,
            ball,
            np.asarray(ball.rest_poses[0], float),
            np.array([0.0, 0.0, 1.0]),
            first,
            1.0,
            DT,
        )


def test_an_episode_with_a_reach_has_the_start_times_of_its_phases() -> None:
    recorded = episode()
    recorded.about["phases"] = {"grasp": 0.0, "hold": 8 * CONTROL_DT}
    hand = get_hand("human")
    first = Rotation.from_quat(recorded.wrist_quaternion[0], scalar_first=True)
    turns = Rotation.concatenate(
        [first * Rotation.from_rotvec([0.0, 0.0, a]) for a in (0.3, 0.2, 0.1)]
    )
    place = recorded.wrist_position[0] + np.outer([0.3, 0.2, 0.1], [0.0, 0.6, 0.8])
    longer = with_reach(recorded, hand, Reach(place, turns, np.tile(hand.q_open, (3, 1))))
    assert longer.phases == {
        "approach": 0.0,
        "grasp": pytest.approx(0.03),
        "hold": pytest.approx(0.11),
    }
    motion = longer.normalised()
    assert len(motion.time) == 15
    assert motion.table[:11].all()
    assert not motion.table[11:].any()
    np.testing.assert_allclose(motion.wrist_position[:3], place, atol=1e-6)
    np.testing.assert_allclose(motion.link_position[3:], recorded.link_position)
    assert (motion.object_position == motion.object_position[0]).all()
    assert not motion.link_force[:3].any()
    # The virtual wrist's joints lead to the same pose: R = Rx Ry Rz relative to the base.
    u = longer.require_recorded().wrist_joints
    for t in range(3):
        rotation = first * Rotation.from_euler("XYZ", u[t, 3:])
        assert (rotation.inv() * turns[t]).magnitude() < 1e-5
        np.testing.assert_allclose(
            first.apply(u[t, :3]) + recorded.wrist_position[0], place[t], atol=1e-6
        )
    # Used as a reference, such a motion is cut to its grasp.
    assert grasp_part(motion) == (3, 10)
    assert longer.grasp_span == (3, 11)
    lifted = dataclasses.replace(
        motion, about={"phases": {"grasp": 0.03, "lift": 0.08, "hold": 0.1}}
    )
    assert grasp_part(lifted) == (3, 7)
    # Files of other programs may hold any phases.
    for odd in (
        "soon",
        {"lift": "soon", "grasp": -1.0},
        {"lift": 1e300, "grasp": float("nan")},
        {"grasp": 9e3},
    ):
        first, end = grasp_part(dataclasses.replace(motion, about={"phases": odd}))
        assert 0 <= first <= end < len(motion.time)
        begin, end = dataclasses.replace(longer, about={"phases": odd}).grasp_span
        assert 0 <= begin <= end <= len(motion.time)
    drawn = steps_to_draw(100, 150, 400)
    assert drawn[0] == 0
    assert {100, 150, 400} < set(drawn)
    assert len(drawn) == 8


def test_resting_poses_by_name_and_number() -> None:
    mug = procedural.generate(7, "mug")
    upright = rest_pose(mug, "upright")
    np.testing.assert_allclose(
        np.asarray(rotate(mug.rest_poses[upright][3:], np.array([0.0, 0.0, 1.0])))[2], 1, atol=0.1
    )
    assert rest_pose(mug, "2") == 1
    for text in ("0", "99", "sideways"):
        with pytest.raises(CongraspError, match=f"--rest is '{text}'"):
            rest_pose(mug, text)
    one_pose = dataclasses.replace(mug, rest_poses=mug.rest_poses[:1])
    with pytest.raises(CongraspError, match="points up in none of its 1 resting poses"):
        rest_pose(one_pose, "upright")


def test_an_object_is_found_by_its_name_in_a_folder(tmp_path, monkeypatch) -> None:
    from congrasp.common.objects.store import Catalogue

    mug = procedural.generate(7, "mug")
    Catalogue(tmp_path / "mine").add(mug)
    (obj,), errors = find_objects(["mug_7"], str(tmp_path / "mine"))
    assert not errors
    assert obj.load().name == "mug_7"
    trimesh.creation.box((0.05, 0.05, 0.1)).export(tmp_path / "mug_7.stl")
    (other,), _ = find_objects([str(tmp_path / "mug_7.stl")], str(tmp_path / "mine"))
    assert other.source is not None  # a file is a file
