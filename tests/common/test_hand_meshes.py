"""Meshes of a hand of one's own: its surface in pictures, exports and measures of depth."""

import dataclasses
import pathlib

import jax
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from congrasp.common.hands import VARIABLE, get_hand
from congrasp.common.hands.files import hand_from_text, hand_text, read_hand
from congrasp.common.hands.kinematics import link_transforms
from congrasp.common.hands.meshes import save_meshes
from congrasp.common.hands.skin import skin_of
from congrasp.common.objects.distance import distance_field
from congrasp.common.objects.procedural import plain_object
from congrasp.common.objects.spec import Piece
from congrasp.common.task import plausibility
from congrasp.services.export.frames import skin_of_motion
from congrasp.services.export.motion_file import hand_arrays, motion_of_episode
from congrasp.services.viz.shapes import posed_hand
from tests.episodes import episode

FILE = pathlib.Path(__file__).parents[1] / "hands" / "claw.json"


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The hand among the user's own, with one mesh: a cube of 4 cm on its palm's link."""
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    get_hand.cache_clear()
    cube = trimesh.creation.box((0.04, 0.04, 0.04))
    path = tmp_path / "own_claw.json"
    path.write_text(hand_text(dataclasses.replace(read_hand(FILE), name="own_claw")))
    save_meshes(path, {"palm": (np.asarray(cube.vertices, np.float32), np.asarray(cube.faces, np.int32))})
    yield get_hand("own_claw")
    get_hand.cache_clear()


def test_a_hands_meshes_are_its_surface_in_pictures_and_exports(own):
    skin = skin_of(own)
    assert np.abs(np.sort(np.abs(skin.points[:8]), axis=None) - 0.02).max() < 1e-7 and set(skin.parts()) == {"link"}
    drawn = posed_hand(own, own.q_open, np.zeros(3), Rotation.identity())
    np.testing.assert_array_equal(drawn.faces, skin.faces)
    motion = dataclasses.replace(motion_of_episode(episode()), hand=own.name, **hand_arrays(own))
    assert skin_of_motion(motion) is skin
    # A motion of what that hand was before keeps the surface that its own arrays tell.
    moved = dataclasses.replace(motion, joint_anchor=motion.joint_anchor + 0.01)
    assert not np.array_equal(skin_of_motion(moved).faces, skin.faces)
    # A hand of this name that someone else sent is not drawn by our meshes.
    stranger = hand_from_text(hand_text(dataclasses.replace(own, object_scale=0.5)))
    assert not np.array_equal(skin_of(stranger).faces, skin.faces)


@pytest.mark.parametrize("damaged", ["own_claw.json", "own_claw.visual.npz"])
def test_a_motion_is_drawn_by_its_own_arrays_where_its_hands_files_are_damaged(own, damaged, tmp_path):
    motion = dataclasses.replace(motion_of_episode(episode()), hand=own.name, **hand_arrays(own))
    expected = skin_of_motion(dataclasses.replace(motion, hand="unknown"))
    (tmp_path / damaged).write_bytes(b"{")
    get_hand.cache_clear()
    skin_of.cache_clear()
    np.testing.assert_array_equal(skin_of_motion(motion).points, expected.points)


def test_depth_of_meshes_and_capsules(own):
    """A ball of 3 cm whose centre is 4.5 cm from the cube's middle, along an edge's normal and a face's normal."""
    measures = (link_transforms, plausibility.hand_mesh, plausibility.hand_object)
    transforms_of, hand_mesh, hand_object = (jax.jit(measure, static_argnums=0) for measure in measures)
    ball = plain_object("ball", (Piece("ellipsoid", (0.03, 0.03, 0.03)),), 500.0)
    transforms = transforms_of(own, np.asarray(own.q_open, np.float32)[None])
    field, upright = distance_field([ball]), np.array([[1.0, 0.0, 0.0, 0.0]], np.float32)

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
    seen = np.array([[0.0111 + 0.025, -0.025, 0.0475]], np.float32), upright, np.zeros(1, int), field
    assert float(hand_object(allegro, flat, *seen)[0]) == pytest.approx(0.005, abs=5e-4)


def test_points_on_a_large_mesh_are_bounded_before_they_are_sampled(own, tmp_path, monkeypatch):
    """37 balls of 2 m, 1500 m^2: cells of 4 mm would ask for 7e8 samples."""
    ball = trimesh.creation.icosphere(1, 2.0)
    balls = trimesh.util.concatenate([ball] * 37)
    save_meshes(tmp_path / "own_claw.json", {"palm": (balls.vertices.astype("f4"), balls.faces.astype("i4"))})
    counts, draw = [], trimesh.sample.sample_surface

    def counted(mesh, count, seed):
        counts.append(count)
        assert count <= 8 * 2048
        return draw(mesh, count, seed=seed)

    monkeypatch.setattr(trimesh.sample, "sample_surface", counted)
    fresh = dataclasses.replace(own)
    assert 0 < len(plausibility._surface(fresh)[1]) <= 2048 and counts
