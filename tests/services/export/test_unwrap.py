"""Texture coordinates of exported meshes."""

import numpy as np
import pytest
import trimesh

from congrasp.common.hands import get_hand
from congrasp.common.hands.skin import skin_of
from congrasp.services.export.texture_coordinates import unwrapped


def areas(uv: np.ndarray) -> np.ndarray:
    """Signed areas (F,) of triangles (F, 3, 2)."""
    a = uv[:, 1] - uv[:, 0]
    b = uv[:, 2] - uv[:, 0]
    return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2


def test_a_box_has_six_charts_with_the_proportions_of_its_sides():
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    vertices = np.asarray(box.vertices)
    faces = np.asarray(box.faces)
    flat = unwrapped(vertices, faces)
    assert len(flat.source) == 24
    assert np.array_equal(flat.source[flat.faces], faces)
    chart_areas = areas(flat.uv[flat.faces])
    np.testing.assert_allclose(
        chart_areas / chart_areas.sum(), box.area_faces / box.area, rtol=1e-6
    )
    assert (chart_areas > 0).all()  # seen from outside, none mirrored
    boxes = sorted(
        {(tuple(c.min(0)), tuple(c.max(0))) for c in flat.uv[flat.faces].reshape(-1, 3, 2)}
    )
    corners = np.array(boxes).reshape(-1, 2, 2)
    apart = (corners[:, None, 0] >= corners[None, :, 1]).any(-1) | (
        corners[:, None, 1] <= corners[None, :, 0]
    ).any(-1)
    assert (
        apart | np.eye(len(corners), dtype=bool)
    ).all()  # the two triangles of a side have the same bounds


@pytest.mark.parametrize("name", ["human", "allegro", "ball", "flat"])
def test_no_face_is_lost_or_mirrored_and_no_texel_belongs_to_two(name):
    if name == "ball":
        mesh = trimesh.creation.icosphere(4)
        vertices = np.asarray(mesh.vertices)
        faces = np.asarray(mesh.faces)
    elif name == "flat":  # with a face without area, and one twice
        vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [9, 9, 9]])
        faces = np.array([[0, 1, 2], [1, 3, 2], [0, 0, 1]])
    else:
        skin = skin_of(get_hand(name))
        vertices = skin.points.astype(float)
        faces = skin.faces
    flat = unwrapped(vertices, faces)
    assert np.array_equal(flat.source[flat.faces], faces)
    assert flat.uv.min() >= 0
    assert flat.uv.max() <= 1
    triangles = flat.uv[flat.faces]
    assert (areas(triangles) >= -1e-12).all()
    # Middles of faces lie in their own face alone, of the convex meshes; of hands in few others,
    # within a chart.
    middles = triangles.mean(1)
    chosen = np.random.default_rng(0).choice(len(faces), min(len(faces), 400), replace=False)
    chosen = chosen[areas(triangles)[chosen] > 0]
    a, b, c = (triangles[None, :, i] for i in range(3))
    inside = np.stack(
        [
            areas(
                np.stack(np.broadcast_arrays(x, y, middles[chosen][:, None]), 2).reshape(-1, 3, 2)
            ).reshape(len(chosen), -1)
            > 0
            for x, y in ((a, b), (b, c), (c, a))
        ]
    ).all(0)
    shared = (inside.sum(1) > 1).mean()
    assert shared <= {"human": 0.1, "allegro": 0.1}.get(name, 0.0)
