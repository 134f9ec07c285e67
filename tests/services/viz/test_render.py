"""Pictures show all shapes, in their places and colours."""

import dataclasses
import itertools
import pathlib
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.skin import skin_of
from congrasp.common.objects.spec import Colours
from congrasp.common.wire.codec import encode
from congrasp.services.appearance.palette import FLESH
from congrasp.services.cli.main import load
from congrasp.services.record.reader import pick_episode
from congrasp.services.record.writer import Entry, LogWriter, opaque_channel
from congrasp.services.viz import kernels
from congrasp.services.viz.camera import Camera, fit
from congrasp.services.viz.camera_path import following_cameras
from congrasp.services.viz.episode_scene import TOUCHING, episode_shapes
from congrasp.services.viz.film import Film, save_episode_video
from congrasp.services.viz.hand_shapes import capsule_shapes, skin_colours
from congrasp.services.viz.hand_sheets import hand_sheet
from congrasp.services.viz.raster import compile_loops, render_scene, visible
from congrasp.services.viz.render import (
    episode_sheet,
    episode_title,
    grasp_picture,
    key_steps,
    render_episode_frames,
)
from congrasp.services.viz.shapes import (
    Shape,
    arrow,
    beads,
    between,
)
from congrasp.services.viz.sheets import contact_sheet, save_png, save_video
from congrasp.services.viz.triangles import cut, smooth_corners
from congrasp.services.viz.views import (
    View,
    camera_of,
    extent,
    object_points,
    view_of,
    views,
)
from tests.children import python
from tests.episodes import CONTROL_DT, episode, episode_message

WHITE = (0.9, 0.9, 0.9)
RED = (0.8, 0.1, 0.1)
BLUE = (0.1, 0.1, 0.8)
FRONT = Camera(np.array([1.0, 0.0, 0.0]), np.zeros(3), 30.0)


def ball(
    radius: float = 0.1, colour: tuple[float, float, float] = RED, at: tuple[float, ...] = (0, 0, 0)
) -> Shape:
    return Shape("sphere", (radius, 0), colour, np.array(at, float))


def box(
    sides: tuple[float, ...],
    colour: tuple[float, float, float],
    at: tuple[float, ...],
    alpha: float = 1.0,
) -> Shape:
    mesh = trimesh.creation.box(sides)
    return Shape(
        "mesh",
        (0, 0),
        colour,
        np.array(at, float),
        alpha=alpha,
        vertices=mesh.vertices,
        faces=mesh.faces,
    )


def projected(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(N, 2) picture coordinates from -1 to 1 of a square picture."""
    x, y, z = camera.axes() @ (points - camera.position).T
    return np.stack([x, y], -1) / z[:, None] / np.tan(np.radians(camera.field_of_view) / 2)


def test_a_ball_covers_its_projection() -> None:
    seen = visible([ball()], FRONT, (200, 200)) == 0
    # A sphere of radius r at distance d is seen under the half angle asin(r / d).
    radius = np.tan(np.arcsin(0.1)) / np.tan(np.radians(15)) * 100
    assert seen.sum() == pytest.approx(np.pi * radius**2, rel=0.01)
    rows, columns = np.nonzero(seen)
    assert rows.mean() == pytest.approx(99.5, abs=0.1)
    assert columns.mean() == pytest.approx(99.5, abs=0.1)


def test_right_is_right_and_up_is_up():
    # Seen from +x, +y lies to the right.
    seen = visible([ball(0.03, at=(0, 0.15, 0.15))], FRONT, (100, 100)) == 0
    rows, columns = np.nonzero(seen)
    assert rows.mean() < 40
    assert columns.mean() > 60


def test_the_nearer_shape_hides_the_other() -> None:
    seen = visible([ball(0.1), ball(0.02, BLUE, (0.3, 0, 0))], FRONT, (101, 101))
    assert seen[50, 50] == 1
    assert seen[35, 50] == 0
    assert seen[0, 0] == -1


def test_a_transparent_shape_takes_its_share_of_the_colour() -> None:
    pane = box((0.02, 0.4, 0.4), BLUE, (0.3, 0, 0), alpha=0.5)
    plain = render_scene([ball()], FRONT, (61, 61))
    through = render_scene([ball(), pane], FRONT, (61, 61))
    center_plain = plain[30, 30].astype(int)
    center = through[30, 30].astype(int)
    assert center[0] < center_plain[0]
    assert center[2] > center_plain[2]
    assert center[0] > 40  # the red ball is still seen
    hidden = box((0.02, 0.04, 0.04), BLUE, (-0.3, 0, 0), alpha=0.5)
    np.testing.assert_array_equal(
        render_scene([ball(), hidden], FRONT, (61, 61))[30, 30], plain[30, 30]
    )


def test_a_ball_darkens_the_ground_beneath_it() -> None:
    ground = Shape("table", (1, 0.01), WHITE, np.array([0, 0, -0.01]), shine=0.0, shadow=False)
    above = Camera(np.array([0.5, 0.0, 0.5]), np.zeros(3), 40.0)
    bare = render_scene([ground], above, (80, 80)).astype(int).sum(-1)
    shaded = (
        render_scene([ground, ball(0.05, at=(0, 0, 0.05))], above, (80, 80)).astype(int).sum(-1)
    )
    floor = visible([ground, ball(0.05, at=(0, 0, 0.05))], above, (80, 80)) == 0
    assert (bare - shaded)[floor].max() > 100
    corner = np.zeros_like(floor)
    corner[:10, :10] = True
    assert np.abs(bare - shaded)[floor & corner].max() < 30
    marked = render_scene(
        [ground, dataclasses.replace(ball(0.05, at=(0, 0, 0.05)), shadow=False)], above, (80, 80)
    )
    inside = binary_erosion(floor, iterations=2)  # without pixels that show some of the ball
    np.testing.assert_array_equal(marked.astype(int).sum(-1)[inside], bare[inside])


def test_a_border_between_two_colours_is_sharp_and_straight() -> None:
    """A pixel is 1 mm wide, and the known points are 5 mm apart."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    sides = np.linspace(-0.05, 0.05, 21)
    y, z = np.meshgrid(sides, sides)
    points = np.column_stack([np.full(y.size, 0.05), y.ravel(), z.ravel() + 0.0025])
    is_red = points[:, 2:] > 0
    paint = Colours(points, np.where(is_red, (255, 0, 0), (0, 0, 255)).astype(np.uint8))
    shape = Shape("mesh", (0, 0), WHITE, vertices=mesh.vertices, faces=mesh.faces, paint=paint)
    camera = Camera(np.array([0.55, 0.0, 0.0]), np.zeros(3), np.degrees(2 * np.arctan(0.1)))
    image = render_scene([shape], camera, (100, 100))[:, 15:85].astype(int)
    mixed = (np.minimum(image[..., 0], image[..., 2]) > 60).sum(0)
    assert mixed.max() <= 2
    border = (image[..., 0] > image[..., 2]).sum(0)
    assert np.ptp(border) <= 2


def test_painted_regions_meet_where_their_points_do() -> None:
    mesh = trimesh.creation.box((0.2, 0.2, 0.2))
    points = np.array(
        [
            [0.1, y, z]
            for y, z in itertools.product(np.linspace(-0.1, 0.1, 11), np.linspace(-0.1, 0.1, 11))
        ]
    )
    paint = Colours(points, np.where(points[:, 2:] > 0, (255, 0, 0), (0, 0, 255)).astype(np.uint8))
    painted = Shape("mesh", (0, 0), WHITE, vertices=mesh.vertices, faces=mesh.faces, paint=paint)
    image = render_scene([painted], FRONT, (60, 60)).astype(int)
    assert image[20, 30, 0] > 2 * image[20, 30, 2]
    assert image[40, 30, 2] > 2 * image[40, 30, 0]


def test_smooth_normals_are_those_of_the_surface_and_keep_sharp_edges() -> None:
    sphere = trimesh.creation.icosphere(2, 0.1)
    corners, smooth = cut(*smooth_corners(sphere.vertices, sphere.faces))
    exact = corners / np.linalg.norm(corners, axis=-1, keepdims=True)

    def degrees_off(normals: np.ndarray) -> float:
        unit = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
        return float(np.degrees(np.arccos(np.clip((unit * exact).sum(-1), -1, 1))).max())

    assert len(corners) > 2 * len(sphere.faces)
    assert degrees_off(flat_normals(corners)) > 5
    assert degrees_off(smooth) < 2
    box = trimesh.creation.box((1, 1, 1))
    corners, smooth = cut(*smooth_corners(box.vertices, box.faces))
    np.testing.assert_allclose(
        smooth, np.broadcast_to(flat_normals(corners), smooth.shape), atol=1e-6
    )


def flat_normals(corners: np.ndarray) -> np.ndarray:
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return (cross / np.linalg.norm(cross, axis=-1, keepdims=True))[:, None]


def test_a_mesh_is_cut_without_a_change_of_its_surface() -> None:
    box = trimesh.creation.box((0.1, 0.06, 0.02))
    corners, _ = cut(*smooth_corners(box.vertices, box.faces))
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    assert sides.max() <= 0.00501  # at most 5 mm
    mesh = trimesh.Trimesh(
        corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False
    )
    assert mesh.area == pytest.approx(box.area)
    assert mesh.volume == pytest.approx(box.volume)


def test_between_and_arrow_connect_their_points() -> None:
    start = np.array([0.1, -0.2, 0.3])
    end = np.array([-0.2, 0.1, 0.1])
    capsule = between(start, end, 0.01, RED)
    axis = Rotation.from_quat(capsule.quaternion, scalar_first=True).apply([0, 0, capsule.size[1]])
    np.testing.assert_allclose(
        [capsule.position - axis, capsule.position + axis], [start, end], atol=1e-12
    )
    shaft, cone = arrow(start, end, 0.01, RED)
    turn = Rotation.from_quat(cone.quaternion, scalar_first=True)
    corners = turn.apply(cone.vertices) + cone.position
    along = (end - start) / np.linalg.norm(end - start)
    np.testing.assert_allclose(corners[np.argmax(corners @ along)], end, atol=1e-12)
    assert shaft.kind == "capsule"
    assert between(start, start, 0.01, RED).kind == "sphere"


def test_beads_are_one_shape_at_the_points() -> None:
    points = np.array([[0, 0, 0], [0, 0, 0.1], [0, 0, 0.1], [0, 0.1, 0.1]])
    mesh = beads(points, 0.01, RED)
    assert mesh.vertices is not None
    np.testing.assert_allclose(mesh.vertices.min(0), [-0.01, -0.01, -0.01], atol=1e-3)
    np.testing.assert_allclose(mesh.vertices.max(0), [0.01, 0.11, 0.11], atol=1e-3)


def test_the_camera_just_contains_all_points() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)) * [0.1, 0.2, 0.3] + [1, 2, 3]
    camera = fit(points, np.array([1.0, 0.5, 0.4]), 1.0)
    places = projected(camera, points)
    assert 0.9 < np.abs(places).max() <= 1.0
    span = np.abs(places.max(0) + places.min(0))
    assert span.max() < 0.02  # in the middle


def cameras(**changes: Any) -> list[Camera]:
    steps = range(0, 80, 4)
    return following_cameras(episode(80, **changes), steps, 16 / 9, View(30.0, 20.0))


def test_a_following_camera_keeps_hand_and_object_in_view() -> None:
    long = episode(80)
    for step, camera in zip(range(0, 80, 4), cameras(), strict=True):
        places = projected(camera, extent(long, step))
        assert np.abs(places[:, 0]).max() < 16 / 9
        assert np.abs(places[:, 1]).max() < 1


def test_a_following_camera_shows_the_object_a_third_wide_if_the_hand_fits() -> None:
    """The cylinder is 6 cm wide: the hand needs more room, so that it is smaller than a third."""
    long = episode(80)
    long = dataclasses.replace(long, object_vertices=long.object_vertices * [8.0, 8.0, 1.0])
    camera = following_cameras(long, range(0, 80, 4), 16 / 9, View(30.0, 20.0))[0]
    across = projected(camera, object_points(long, 0))[:, 0] / (16 / 9)
    assert np.ptp(across) / 2 == pytest.approx(1 / 3, rel=0.15)


def test_steps_of_a_sheet_include_the_ends_and_the_removal() -> None:
    table = np.arange(75) < 50
    steps = key_steps(table, 8)
    assert steps[0] == 0
    assert steps[-1] == 74
    assert 50 in steps
    assert len(steps) == 8
    assert key_steps(np.ones(3, bool), 8) == [0, 1, 2]


def test_links_in_contact_and_the_avoid_region_are_coloured() -> None:
    skinned, body, *_ = episode_shapes(episode(), 11)
    hand = get_hand("human")
    assert skinned.colours is not None
    changed = np.abs(skinned.colours - skin_colours(skin_of(hand))).max(-1) > 1e-3
    owner = skin_of(hand).weights.argmax(1)
    assert set(owner[changed & (skin_of(hand).weights.max(1) > 0.9)]) == set(hand.tip_links)
    thumb = skinned.colours[skin_of(hand).weights[:, hand.tip_links[0]] > 0.99]
    # FORCE of 1.5 N is three quarters of the full contact colour's 2 N: 0.3 + 0.3 * 0.75 of it.
    np.testing.assert_allclose(
        thumb[0], np.array(FLESH) + 0.525 * np.subtract(TOUCHING, FLESH), atol=0.01
    )
    assert body.paint is not None
    minus = episode().surface_avoid
    np.testing.assert_array_equal(
        body.paint.values, np.where(minus[:, None], (204, 41, 41), (51, 166, 82))
    )
    assert episode_shapes(episode(mask=(0, 0, 0, 0)), 0)[1].paint is None


def table_height(step: int) -> float:
    (table,) = [shape for shape in episode_shapes(episode(), step) if shape.kind == "table"]
    return float(table.position[2])


def test_a_removed_table_sinks_below_the_object() -> None:
    assert table_height(7) == 0.0
    assert 0.0 > table_height(8) > table_height(11)
    long = episode(80)
    (table,) = [shape for shape in episode_shapes(long, 79) if shape.kind == "table"]
    assert table.position[2] == pytest.approx(-0.12)


def test_the_reference_pose_is_transparent() -> None:
    (ghost,) = [
        shape for shape in episode_shapes(episode(mask=(0, 1, 1, 0)), 11) if shape.alpha < 1
    ]
    # The last step has reached the pose: ghost and hand coincide.
    np.testing.assert_allclose(ghost.vertices, episode_shapes(episode(), 11)[0].vertices, atol=1e-5)


def test_frames_share_one_camera_that_contains_hand_and_object() -> None:
    camera = camera_of(episode(), [0, 6, 11], 1.0)
    for step in (0, 11):
        assert np.abs(projected(camera, episode().link_position[step].astype(float))).max() < 1
    near, far = (camera_of(episode(), [11], overlays=overlays) for overlays in (False, True))
    # Its path
    assert np.linalg.norm(far.position - far.target) > 1.1 * np.linalg.norm(
        near.position - near.target
    )
    frames = list(render_episode_frames(episode(), [0, 11], (64, 48)))
    fallen = episode()
    fallen.object_position[-1, 2] -= 5.0
    np.testing.assert_allclose(
        camera_of(fallen, [0, 11]).target[2],
        camera_of(episode(), [0, 11]).target[2],
        atol=0.1,
    )
    assert [frame.shape for frame in frames] == [(48, 64, 3)] * 2
    picture = grasp_picture(episode(), 11, (96, 54))
    assert picture.shape == (54, 96, 3)
    assert np.abs(frames[0].astype(int) - frames[1]).max() > 50


def test_the_best_view_shows_the_contacts_and_the_second_is_from_its_side() -> None:
    best, aside = views(episode(), [11])
    assert abs((best.azimuth - aside.azimuth + 180) % 360 - 180) >= 75
    recorded = episode()
    hand = get_hand("human")
    capsules = capsule_shapes(hand, recorded.link_position[11], recorded.link_quaternion[11])
    shapes = [*capsules, *episode_shapes(episode(), 11, overlays=False)[1:2]]
    tips = np.isin([*hand.capsule_links, -1], hand.tip_links)  # in contact

    def shown(view: View) -> int:
        seen = visible(shapes, camera_of(episode(), [11], view=view), (192, 144))
        return int(tips[seen[seen >= 0]].sum())

    others = [shown(View(float(azimuth), best.elevation)) for azimuth in range(0, 360, 30)]
    assert shown(best) > 1.2 * min(others)
    assert shown(best) > np.median(others)
    assert view_of("") is None
    assert view_of("-30, 20") == View(-30.0, 20.0)
    for text in ("30", "30 95", "left 20"):
        with pytest.raises(CongraspError, match="--camera is"):
            view_of(text)


def test_sheets(tmp_path: pathlib.Path) -> None:
    sheet = episode_sheet(episode(), frames=3, size=(48, 36))
    assert sheet.shape[1] == 3 * (48 + 10) + 10
    hand = hand_sheet(get_hand("human"), size=(40, 40))
    assert hand.shape[1] == 3 * (40 + 10) + 10
    save_png(tmp_path / "new" / "sheet.png", sheet)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "new" / "sheet.png")), sheet)


def test_a_sheet_keeps_its_pictures_and_shrinks_long_titles() -> None:
    images = [np.full((20, 30, 3), shade, np.uint8) for shade in (0, 80, 160)]
    sheet = contact_sheet(
        images, ["a", "b", "c"], 2, "a title that is much too long for so narrow a sheet"
    )
    assert sheet.shape == (44 + 2 * (20 + 24) + 10, 2 * 40 + 10, 3)
    assert (sheet[44:64, 10:40] == 0).all()
    assert (sheet[44:64, 50:80] == 80).all()
    assert (sheet[88:108, 10:40] == 160).all()
    wide = [np.zeros((20, 100, 3), np.uint8)] * 2
    labels = contact_sheet(wide, ["tendon_of_a_joint_and_of_another_one_and_more -0.35"] * 2, 2)[
        30:54
    ]
    assert (labels[:, 114:120] == labels[0, 0]).all()
    assert (labels[:, 12:112] != labels[0, 0]).any()
    labels = contact_sheet(
        wide, [f"the_proximal_joint_of_the_{x}_finger_is_bent -0.35" for x in ("ring", "long")], 2
    )
    assert (labels[30:54, 10:110] != labels[30:54, 120:220]).any()
    with pytest.raises(CongraspError, match="3 pictures and 1 labels"):
        contact_sheet(images, ["a"], 2)


def test_the_title_names_the_constraints_and_the_outcome() -> None:
    title = episode_title(episode(mask=(1, 0, 0, 1), success=False))
    for words in (
        "human hand",
        "cylinder-0",
        "heading + affordance + trajectory",
        "no success",
        "return 12.5",
        "3",
    ):
        assert words in title


def test_a_recorded_episode_is_picked_drawn_and_filmed(tmp_path: pathlib.Path) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    writer = LogWriter(tmp_path / "run", "log")
    channel = opaque_channel("/episode/a0/raw", "congrasp.Episode")
    for steps, success in ((4, True), (5, False), (6, False)):
        writer.write(
            Entry(channel, steps, encode(episode_message(steps, removal=3, success=success)))
        )
    writer.close()
    lengths = [pick_episode(tmp_path / "run", i).steps for i in (0, 1, 2, -1, -2, -3)]
    assert lengths == [4, 5, 6, 6, 5, 4]
    assert pick_episode(tmp_path / "run", -1, success=True).steps == 4
    for index, success in ((3, False), (-4, False), (1, True)):
        with pytest.raises(
            CongraspError, match=r"contains \d .*none with index .*Choose from -\d to "
        ):
            pick_episode(tmp_path / "run", index, success=success)
    out = tmp_path / "out.png"
    # An older name of --frames.
    assert (
        load("render")(
            ["episode", str(tmp_path / "run"), "--out", str(out), "--index", "0", "--moments", "1"]
        )()
        == 0
    )
    assert 400 < Image.open(out).size[0] < 600
    frames = render_episode_frames(pick_episode(tmp_path / "run", 0), range(4), (64, 48))
    save_video(tmp_path / "film.mp4", frames, (64, 48), 0.5 / CONTROL_DT)
    assert imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))[0] == 4


def test_a_video_runs_in_real_time_to_its_last_step_and_shows_no_overlays(tmp_path) -> None:
    """Twelve steps of 10 ms at 50 frames a second are six frames; a constraint's arrow is an
    overlay.
    """
    path = tmp_path / "film.mp4"
    save_episode_video(path, episode(), Film((64, 48), 0.5 / CONTROL_DT))
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    assert imageio_ffmpeg.count_frames_and_secs(str(path)) == (6, 6 * 2 * CONTROL_DT)
    assert [file.name for file in tmp_path.iterdir()] == ["film.mp4"]
    bare = episode_shapes(episode(), 11, overlays=False)
    marked = episode_shapes(episode(), 11)
    assert len(bare) == 3
    assert len(marked) > 3


def test_a_small_picture_compiles_all_loops() -> None:
    compile_loops()
    record = episode()
    camera = camera_of(record, [0], overlays=True)
    render_scene(episode_shapes(record, 0), camera, (40, 30))
    for name in ("cover", "light_of", "shade", "repeated", "averaged"):
        assert len(getattr(kernels, name).signatures) == 1, name


def test_pictures_need_no_writable_folder() -> None:
    script = (
        "import numpy as np; from congrasp.services.viz import kernels; "
        "print(kernels.averaged(np.ones((2, 2, 3)), 2))"
    )
    done = python("-c", script, env={"XDG_CACHE_HOME": "/proc/nowhere"})
    assert done.stdout.split() == ["[[[255", "255", "255]]]"], done.stderr
