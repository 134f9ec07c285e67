"""Surfaces of hands: closed, on their links, and from the meshes of a hand of one's own."""

import dataclasses
import pathlib

import jax
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from congrasp.common.episode.hand_arrays import hand_arrays
from congrasp.common.hands import VARIABLE, get_hand
from congrasp.common.hands.files import hand_from_text, hand_text, read_hand
from congrasp.common.hands.flesh import surface_net
from congrasp.common.hands.kinematics import link_transforms
from congrasp.common.hands.meshes import save_meshes
from congrasp.common.hands.mjcf import mujoco_link_poses
from congrasp.common.hands.skin import MATERIALS, skin_of, skin_of_meshes
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.distance import distance_field
from congrasp.common.objects.procedural import plain_object
from congrasp.common.objects.spec import Piece
from congrasp.common.task import plausibility
from congrasp.services.export.surfaces import skin_of_motion
from congrasp.services.viz.hand_shapes import posed_hand
from tests.episodes import episode

HANDS = ("human", "allegro", "sharpa")


def posed(hand: Hand, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    position, quaternion = mujoco_link_poses(hand, q)
    return skin_of(hand).posed(
        position, Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    )


def to_capsules(
    hand: Hand, q: np.ndarray, points: np.ndarray, links: set[int] | None = None
) -> np.ndarray:
    """(n,) distances of points to the surface of the nearest capsule of some links."""
    position, quaternion = mujoco_link_poses(hand, q)
    turns = Rotation.from_quat(quaternion, scalar_first=True)
    distances = []
    for ends, radius, link in zip(
        hand.capsules, hand.capsule_radii, hand.capsule_links, strict=True
    ):
        if links is None or link in links:
            a, b = turns[int(link)].apply(ends - skin_of(hand).origins[link]) + position[link]
            share = np.clip((points - a) @ (b - a) / max((b - a) @ (b - a), 1e-12), 0, 1)
            distances.append(
                np.linalg.norm(points - a - share[:, None] * (b - a), axis=-1) - radius
            )
    return np.min(distances, 0)


def test_a_surface_net_of_a_ball_is_a_ball() -> None:
    axis = np.arange(-8.0, 9.0)
    values = (
        np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1), axis=-1) - 5.3
    )
    points, faces = surface_net(values)
    mesh = trimesh.Trimesh(points - 8, faces, process=False)
    assert mesh.is_volume
    assert mesh.euler_number == 2
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 5.3**3, rel=0.06)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=-1) - 5.3).max() < 0.3


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_nails_lie_on_the_skin_however_far_the_fingers_bend(share: float) -> None:
    """By the nearest point of the flesh and its normal; one that only followed its link sank by
    half a millimetre.
    """
    hand = get_hand("human")
    skin = skin_of(hand)
    points, normals = posed(hand, share * np.array([joint.upper for joint in hand.joints]))
    flesh, nail = (skin.material == MATERIALS.index(kind) for kind in ("flesh", "nail"))
    below = cKDTree(points[flesh]).query(points[nail])[1]
    height = np.einsum("ni,ni->n", points[nail] - points[flesh][below], normals[flesh][below])
    rings = height.reshape(5, -1)[:, :84]  # of each nail the three rings on top
    assert (rings.mean(1) > 1e-4).all()
    assert (rings.mean(1) < 1e-3).all()


@pytest.mark.parametrize("name", HANDS)
def test_a_skin_is_a_surface_with_weights(name: str) -> None:
    skin = skin_of(get_hand(name))
    assert 2000 < len(skin.faces) < 10_000
    np.testing.assert_allclose(skin.weights.sum(1), 1, atol=1e-5)
    assert (skin.weights >= 0).all()
    assert (skin.weights > 0).sum(1).max() <= 4
    np.testing.assert_allclose(np.linalg.norm(skin.normals, axis=-1), 1, atol=1e-5)
    corners = skin.points[skin.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fi,fi->f", flat, skin.normals[skin.faces].mean(1)) > 0).mean() > 0.995
    links, weights = skin.influences()
    dense = np.zeros_like(skin.weights)
    np.add.at(dense, (np.arange(len(links))[:, None], links), weights)
    np.testing.assert_allclose(dense, skin.weights, atol=1e-6)


def test_flesh_is_closed_and_fingers_have_no_webs() -> None:
    hand = get_hand("human")
    skin = skin_of(get_hand("human"))
    edges = np.concatenate([skin.faces[:, [0, 1]], skin.faces[:, [1, 2]], skin.faces[:, [2, 0]]])
    there, back = (sorted(map(tuple, part)) for part in (edges, edges[:, ::-1]))
    assert there == back  # each edge is passed as often one way as the other
    finger = hand.link_fingers.copy()
    finger[1] = -1  # the thumb's metacarpal belongs to the palm
    share = np.stack([skin.weights[:, finger == f].sum(1) for f in range(len(hand.fingers))], 1)
    assert ((share > 0).sum(1) <= 1).all()
    # One finger bends alone: hardly anything is drawn out between it and its neighbours.
    bent = hand.q_open.copy()
    names = [joint.name for joint in hand.joints]
    for joint in ("mcp_flexion", "pip", "dip"):
        bent[names.index(f"middle_{joint}")] = 1.3
    points, _ = posed(hand, bent)
    a, b, c = points[skin.parts()["flesh"]].swapaxes(0, 1)
    lengths = np.linalg.norm(np.concatenate([a - b, b - c, c - a]), axis=-1)
    assert lengths.max() < 0.018
    assert np.mean(lengths > 0.010) < 2e-3


@pytest.mark.parametrize("closure", [0.0, 0.5, 1.0])
def test_flesh_lies_on_the_capsules_of_the_fingers(closure: float) -> None:
    """What touches in the simulation touches in the picture: within 2 mm on phalanges, 4 mm in a
    fist's folds.
    """
    hand = get_hand("human")
    q = hand.q_open + closure * (hand.q_closed - hand.q_open)
    points, _ = posed(hand, q)
    skin = skin_of(hand)
    for finger in range(len(hand.fingers)):
        links = set(np.flatnonzero(hand.link_fingers == finger))
        flesh = points[skin.weights[:, sorted(links)[1:]].max(1) > 0.8]
        assert len(flesh) > 40
        distance = to_capsules(hand, q, flesh, links)
        assert distance.max() < 2e-3
        assert distance.min() > -2e-3 - 2e-3 * closure


def test_normals_that_cancel_out_are_zero() -> None:
    hand = get_hand("allegro")
    skin = skin_of(hand)._replace(normals=np.zeros_like(skin_of(hand).normals))
    with np.errstate(all="raise"):
        _, normals = skin.posed(skin.origins, np.tile(np.eye(3), (len(hand.links), 1, 1)))
    assert not normals.any()


@pytest.mark.parametrize("name", HANDS)
def test_a_skin_follows_the_wrist_and_its_links(name: str) -> None:
    hand = get_hand(name)
    skin = skin_of(get_hand(name))
    points, normals = skin.posed(skin.origins, np.broadcast_to(np.eye(3), (len(hand.links), 3, 3)))
    np.testing.assert_allclose(points, skin.points, atol=1e-6)
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    shift = np.array([0.1, 0.2, 0.3])
    moved, turned = skin.posed(
        turn.apply(skin.origins) + shift, np.broadcast_to(turn.as_matrix(), (len(hand.links), 3, 3))
    )
    np.testing.assert_allclose(moved, turn.apply(points) + shift, atol=1e-6)
    np.testing.assert_allclose(turned, turn.apply(normals), atol=1e-5)
    # A tip's own points move with its frame alone.
    tip = hand.tip_links[1]
    of_tip = skin.weights[:, tip] > 0.999
    position, quaternion = mujoco_link_poses(hand, hand.q_closed)
    expected = Rotation.from_quat(quaternion[tip], scalar_first=True).apply(
        skin.points[of_tip] - skin.origins[tip]
    )
    np.testing.assert_allclose(
        posed(hand, hand.q_closed)[0][of_tip], expected + position[tip], atol=5e-5
    )


# --- meshes of a hand of one's own ---


FILE = pathlib.Path(__file__).parents[1] / "hands" / "claw.json"


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The hand among the user's own, with one mesh: a cube of 4 cm on its palm's link."""
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    get_hand.cache_clear()
    cube = trimesh.creation.box((0.04, 0.04, 0.04))
    path = tmp_path / "own_claw.json"
    path.write_text(hand_text(dataclasses.replace(read_hand(FILE), name="own_claw")))
    save_meshes(
        path, {"palm": (np.asarray(cube.vertices, np.float32), np.asarray(cube.faces, np.int32))}
    )
    yield get_hand("own_claw")
    get_hand.cache_clear()


def test_a_hands_meshes_are_its_surface_in_pictures_and_exports(own):
    skin = skin_of(own)
    assert np.abs(np.sort(np.abs(skin.points[:8]), axis=None) - 0.02).max() < 1e-7
    assert set(skin.parts()) == {"link"}
    drawn = posed_hand(own, own.q_open, np.zeros(3), Rotation.identity())
    np.testing.assert_array_equal(drawn.faces, skin.faces)
    motion = dataclasses.replace(episode().normalised(), hand=own.name, **hand_arrays(own))
    assert skin_of_motion(motion) is skin
    # A motion of what that hand was before keeps the surface that its own arrays tell.
    moved = dataclasses.replace(motion, joint_anchor=motion.joint_anchor + 0.01)
    assert not np.array_equal(skin_of_motion(moved).faces, skin.faces)
    # A hand of this name that someone else sent is not drawn by our meshes.
    stranger = hand_from_text(hand_text(dataclasses.replace(own, object_scale=0.5)))
    assert not np.array_equal(skin_of(stranger).faces, skin.faces)


def test_skin_of_faces_back_to_back_has_unit_normals(own):
    points = np.array([(0, 0, 0), (0.02, 0, 0), (0.007, 0.013, 0.011), (1, 1, 1)], np.float32)
    sheet = np.array([(0, 1, 2), (1, 0, 2), (0, 0, 1)])
    skin = skin_of_meshes(own, {"palm": (points, sheet)})
    np.testing.assert_allclose(np.linalg.norm(skin.normals, axis=-1), 1.0, atol=1e-5)
    side = np.cross(points[1] - points[0], points[2] - points[0])
    cosines = skin.normals[:3] @ side / np.linalg.norm(side)
    np.testing.assert_allclose(np.abs(cosines), 1.0, atol=1e-5)


@pytest.mark.parametrize("damaged", ["own_claw.json", "own_claw.visual.npz"])
def test_a_motion_is_drawn_by_its_own_arrays_where_its_hands_files_are_damaged(
    own, damaged, tmp_path
):
    motion = dataclasses.replace(episode().normalised(), hand=own.name, **hand_arrays(own))
    expected = skin_of_motion(dataclasses.replace(motion, hand="unknown"))
    (tmp_path / damaged).write_bytes(b"{")
    get_hand.cache_clear()
    skin_of.cache_clear()
    np.testing.assert_array_equal(skin_of_motion(motion).points, expected.points)


def test_depth_of_meshes_and_capsules(own):
    """A ball of 3 cm whose centre is 4.5 cm from the cube's middle, along an edge's normal and a
    face's normal.
    """
    measures = (link_transforms, plausibility.hand_mesh, plausibility.hand_object)
    transforms_of, hand_mesh, hand_object = (
        jax.jit(measure, static_argnums=0) for measure in measures
    )
    ball = plain_object("ball", (Piece("ellipsoid", (0.03, 0.03, 0.03)),), 500.0)
    transforms = transforms_of(own, np.asarray(own.q_open, np.float32)[None])
    field = distance_field([ball])
    upright = np.array([[1.0, 0.0, 0.0, 0.0]], np.float32)

    def depth(*center):
        seen = np.array([center], np.float32), upright, np.zeros(1, int), field
        return float(hand_mesh(own, transforms, *seen)[0])

    assert depth(-0.045, 0.0, 0.0) == pytest.approx(0.005, abs=5e-4)
    side = 0.045 / np.sqrt(2)  # an edge is sqrt(8) cm from the middle
    assert depth(-side, 0.0, -side) == pytest.approx(0.03 - (0.045 - 0.02 * np.sqrt(2)), abs=5e-4)
    assert depth(-0.06, 0.0, 0.0) == 0.0
    seen = np.zeros((1, 3), np.float32), upright, np.zeros(1, int), field
    assert np.isnan(hand_mesh(get_hand("allegro"), transforms, *seen)).all()
    # Allegro's palm is a box whose front is at x = 11.1 mm: the ball's middle is 25 mm before it.
    allegro = get_hand("allegro")
    flat = transforms_of(allegro, np.zeros((1, len(allegro.joints)), np.float32))
    seen = (
        np.array([[0.0111 + 0.025, -0.025, 0.0475]], np.float32),
        upright,
        np.zeros(1, int),
        field,
    )
    assert float(hand_object(allegro, flat, *seen)[0]) == pytest.approx(0.005, abs=5e-4)


def test_points_on_a_large_mesh_are_bounded_before_they_are_sampled(own, tmp_path, monkeypatch):
    """37 balls of 2 m, 1500 m^2: cells of 4 mm would ask for 7e8 samples."""
    ball = trimesh.creation.icosphere(1, 2.0)
    balls = trimesh.util.concatenate([ball] * 37)
    save_meshes(
        tmp_path / "own_claw.json",
        {"palm": (balls.vertices.astype("f4"), balls.faces.astype("i4"))},
    )
    counts = []
    draw = trimesh.sample.sample_surface

    def counted(mesh, count, seed):
        counts.append(count)
        assert count <= 8 * 2048
        return draw(mesh, count, seed=seed)

    monkeypatch.setattr(trimesh.sample, "sample_surface", counted)
    fresh = dataclasses.replace(own)
    assert 0 < len(plausibility.mesh_points(fresh)[1]) <= 2048
    assert counts
