"""Rigid parts of the hand's surface."""

import dataclasses
import itertools

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.hands.skin import MATERIALS, Skin, skin_of
from congrasp.services.appearance.palette import MATERIAL_COLOURS, ROBOT_JOINT, ROBOT_LINK
from congrasp.services.record import hand_parts
from congrasp.services.record.hand_parts import surface_parts, surface_points


def _posed(name: str, share: float) -> tuple[np.ndarray, np.ndarray, Skin]:
    """Corners (E, 3, 3) of all parts, and of the skin, with fingers closed by a share."""
    hand = get_hand(name)
    skin = skin_of(hand)
    position, quaternion = mujoco_link_poses(
        hand, hand.q_open + share * (hand.q_closed - hand.q_open)
    )
    turns = Rotation.from_quat(quaternion, scalar_first=True)
    corners = []
    for k, parts_of_link in enumerate(surface_parts(hand)):
        corners += [
            (turns[k].apply(part.points) + position[k])[part.faces] for part in parts_of_link
        ]
    return np.concatenate(corners), skin.posed(position, turns.as_matrix())[0][skin.faces], skin


@pytest.mark.parametrize("name", ["allegro", "sharpa"])
def test_a_robots_parts_are_its_surface_in_every_pose(name: str) -> None:
    parts, surface, _ = _posed(name, 0.7)
    assert cKDTree(parts.mean(1)).query(surface.mean(1))[0].max() < 1e-4
    assert cKDTree(surface.mean(1)).query(parts.mean(1))[0].max() < 1e-4
    parts = itertools.chain(*surface_parts(get_hand(name)))
    assert {part.colour for part in parts} == {ROBOT_LINK, ROBOT_JOINT}


def test_a_human_hands_parts_are_its_skin_at_zero_and_near_it_in_a_grasp() -> None:
    hand = get_hand("human")
    skin = skin_of(hand)
    corners = []
    for parts_of_link, origin in zip(surface_parts(hand), skin.origins, strict=True):
        corners += [(part.points + origin)[part.faces] for part in parts_of_link]
    still = np.concatenate(corners)
    assert cKDTree(still.mean(1)).query(skin.points[skin.faces].mean(1))[0].max() < 1e-4
    parts, surface, _ = _posed("human", 0.5)
    mesh = trimesh.Trimesh(
        parts.reshape(-1, 3), np.arange(3 * len(parts)).reshape(-1, 3), process=False
    )
    points = trimesh.sample.sample_surface(mesh, 60_000, seed=0)[0]
    distance = cKDTree(points).query(surface.mean(1))[0]
    assert np.percentile(distance, 95) < 0.004
    colours = {part.colour for part in itertools.chain(*surface_parts(hand))}
    assert colours == {MATERIAL_COLOURS[name] for name in ("flesh", "nail", "sleeve")}


def test_detailed_meshes_are_made_lighter_and_stay_where_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    hand = get_hand("allegro")
    balls = [trimesh.creation.icosphere(5, 0.02) for _ in hand.links]  # 20,480 triangles each
    count = len(balls[0].vertices)
    owner = np.repeat(np.arange(len(balls)), count)
    skin = skin_of(hand)
    fine = skin._replace(
        points=np.concatenate(
            [b.vertices + o for b, o in zip(balls, skin.origins, strict=True)]
        ).astype(np.float32),
        faces=np.concatenate([b.faces + count * k for k, b in enumerate(balls)]).astype(np.int32),
        weights=np.eye(len(balls), dtype=np.float32)[owner],
        material=np.full(len(owner), MATERIALS.index("link")),
    )
    monkeypatch.setattr(hand_parts, "skin_of", lambda hand: fine)
    parts = surface_parts(dataclasses.replace(hand, name="fine"))
    assert sum(len(part.faces) for part in itertools.chain(*parts)) <= 12_000
    for (part,) in parts:
        np.testing.assert_allclose(np.linalg.norm(part.points, axis=-1), 0.02, atol=1e-3)


def test_meshes_that_cannot_be_read_leave_the_capsules_surface(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def damaged(hand: object) -> Skin:
        raise CongraspError("The file is damaged.")

    hand = dataclasses.replace(get_hand("allegro"), name="torn")
    monkeypatch.setattr(hand_parts, "skin_of", damaged)
    assert all(surface_parts(hand))
    assert sum(len(points) for points, _ in surface_points(hand)) > 2000
