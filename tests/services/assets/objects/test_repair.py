"""Broken meshes: each is repaired with a note, or rejected with the remedy."""

import itertools
import struct

import numpy as np
import pytest
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.services.assets.objects import repair
from congrasp.services.assets.objects.bodies import largest_body, without_table
from congrasp.services.assets.objects.decompose import decompose
from congrasp.services.assets.objects.fidelity import fidelity
from congrasp.services.assets.objects.holes import fill, hole_loops
from congrasp.services.assets.objects.hollows import without_hollows
from congrasp.services.assets.objects.mesh_files import load_geometry, read_mesh
from congrasp.services.assets.objects.named import one_object
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.repair import close_and_orient, reduce_large

RADIUS = 0.03


def ball(**options):
    return trimesh.creation.icosphere(subdivisions=2, radius=RADIUS, **options)


def test_an_opening_is_left_and_bodies_that_touch_stay_together():
    half = ball()
    notes = list[str]()
    half.update_faces(half.triangles_center[:, 2] < 0)
    assert len(close_and_orient(half, notes).faces) == len(half.faces)
    assert not notes  # a bowl stays a bowl
    pair = trimesh.util.concatenate([ball(), ball().apply_translation([2 * RADIUS, 0, 0])])
    assert len(largest_body(pair, notes).faces) == 2 * len(ball().faces)
    assert not notes


@pytest.mark.parametrize("gap", [-0.001, 0.0, 0.05])
@pytest.mark.parametrize("unit", ["m", "mm"])
def test_a_table_under_an_object_is_left_out(tmp_path, quick_import, unit, gap):
    table = trimesh.creation.box((1.2, 0.8, 0.02)).apply_translation(
        [0.0, 0.0, -0.01 - RADIUS - gap]
    )
    crumb = trimesh.creation.icosphere(1, 0.002).apply_translation([0.3, 0.2, -0.05])
    scan = trimesh.util.concatenate([table, ball(), crumb]).apply_scale(1000 if unit == "mm" else 1)
    scan.export(tmp_path / "scan.stl")
    obj = one_object(
        tmp_path / "scan.stl", ImportOptions(unit=unit, cache_dir=str(tmp_path / "cache"))
    )
    np.testing.assert_allclose(np.ptp(obj.visual_vertices, axis=0), 2 * RADIUS, rtol=0.05)
    assert obj.notes[0] == "a flat body 13.3 times as wide as the rest was left out: a table"


@pytest.mark.parametrize(
    ("radius", "depth", "knob", "at"),
    [
        (0.16, 0.012, (0.02, 0.03), 0.021),  # a pan's lid
        (0.16, 0.012, (0.06, 0.1), -0.056),  # a cake stand
        (0.6, 0.02, (0.01, 0.01), 0.02),  # a table with a crumb
        (0.6, 0.02, (0.05, 0.1), 0.0),  # a table with a post through it
    ],
)
def test_a_flat_object_is_no_table(radius, depth, knob, at):
    flat = trimesh.creation.cylinder(radius, depth)
    mesh = trimesh.util.concatenate(
        [flat, trimesh.creation.cylinder(*knob).apply_translation([0.0, 0.0, at])]
    )
    assert without_table(mesh, 1.0, []) is mesh


def test_a_distant_speck_changes_nothing_of_a_large_scan(tmp_path):
    scan = trimesh.creation.icosphere(7, 0.05)
    speck = np.array([[4.5, 0, 0], [4.5, 1e-3, 0], [4.5, 0, 1e-3]])
    volume = scan.volume
    trimesh.util.concatenate([scan, trimesh.Trimesh(speck, [[0, 1, 2]])]).export(tmp_path / "a.stl")
    body = largest_body(read_mesh(tmp_path / "a.stl"), [])
    assert body.is_watertight
    assert body.volume == pytest.approx(volume, rel=0.01)
    small = trimesh.Trimesh(
        *reduce_large(np.vstack([scan.vertices, [100.0, 0, 0]]), scan.faces, [])
    )
    assert small.volume == pytest.approx(volume, rel=0.01)


def _with_fin(mesh):
    edge = mesh.vertices[mesh.edges[0]]
    return trimesh.util.concatenate(
        [mesh, trimesh.Trimesh([*edge, 1.02 * edge.mean(0)], [[0, 1, 2]])]
    )


@pytest.mark.parametrize("rows", [3, 20])
def test_a_handle_of_one_sheet_is_kept(rows):
    """From edge to edge of the side of a mug, in two spans or many."""
    cup = trimesh.creation.box((0.08, 0.016, 0.1)).subdivide().subdivide()
    a = np.linspace(0, np.pi, rows)
    spine = np.stack([0.04 + 0.03 * np.sin(a), 0 * a, 0.025 * np.cos(a)], -1)[:, None]
    strap = (spine + np.array([[0, 0, 0], [0, 0.004, 0]])).reshape(-1, 3)
    faces = []
    for i in range(0, 2 * rows - 2, 2):
        faces += [(i, i + 1, i + 2), (i + 1, i + 3, i + 2)]
    mug = trimesh.util.concatenate([cup, trimesh.Trimesh(strap, faces, process=False)])
    mug.merge_vertices()
    assert mug.faces.shape == (len(cup.faces) + len(faces), 3)
    assert mug.body_count == 1
    notes = list[str]()
    assert len(close_and_orient(mug, notes).faces) == len(mug.faces)
    assert not notes


def _body_with_fin(rings):
    """A cube with a sheet over its top, along one of whose edges it is attached; edges of the sheet
    are `rings` triangles from its middle.
    """
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    for _ in range(4):
        cube = cube.subdivide()
    points = []
    for i, j in itertools.product(range(rings + 1), repeat=2):
        gap = 0.005 if j else 0.0
        points.append([i / 16 - 0.5, j / 64 - 0.5, 0.5 + gap])
    triangles = []
    for i, j in itertools.product(range(rings), repeat=2):
        corner = i * (rings + 1) + j
        across = corner + rings + 2
        triangles.append([corner, corner + 1, across])
        triangles.append([corner, across, across - 1])
    mesh = trimesh.util.concatenate([cube, trimesh.Trimesh(points, triangles, process=False)])
    mesh.merge_vertices()
    return mesh


@pytest.mark.parametrize(("rings", "removed"), [(9, 162), (10, 200), (11, 0)])
def test_fins_have_up_to_ten_rings(rings, removed):
    mesh = _body_with_fin(rings)
    notes = list[str]()
    assert len(close_and_orient(mesh, notes).faces) == len(mesh.faces) - removed
    assert len(notes) == bool(removed)


def test_unmerged_bodies_have_no_note_on_repeats():
    """Two cubes touch along a face, whose triangles repeat, and a third one along an edge."""
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    mirrored = trimesh.Trimesh(
        cube.vertices * [-1, 1, 1] + [1, 0, 0], cube.faces[:, ::-1], process=False
    )
    at_edge = cube.copy().apply_translation([0, 1, 1])
    bodies = trimesh.util.concatenate([cube, mirrored, at_edge])
    notes = list[str]()
    mesh = repair.merge_vertices(np.asarray(bodies.vertices), np.asarray(bodies.faces), notes)
    assert len(mesh.faces) == len(bodies.faces)
    assert not notes


@pytest.mark.parametrize(
    ("spoil", "note"),
    [
        (_with_fin, "1 of its triangles stood out from its surface and was left out"),
        (lambda mesh: mesh.apply_translation([1e5, -2e5, 3e5]), ""),
    ],
)
def test_repairable_meshes_are_solid(tmp_path, quick_import, spoil, note):
    spoil(ball()).export(tmp_path / "a.obj", digits=9)
    obj = one_object(
        tmp_path / "a.obj", ImportOptions(density=1000.0, cache_dir=str(tmp_path / "cache"))
    )
    assert obj.mass == pytest.approx(1000 * ball().volume, rel=1e-3)
    np.testing.assert_allclose(
        np.diag(obj.inertia) if np.ndim(obj.inertia) == 2 else obj.inertia[:3],
        0.4 * obj.mass * RADIUS**2,
        rtol=0.05,
    )
    assert note in obj.notes if note else not [text for text in obj.notes if "open" in text]
    np.testing.assert_allclose(np.linalg.norm(obj.points, axis=-1), RADIUS, rtol=0.06)


def test_a_mesh_rounded_by_single_precision_is_refused(tmp_path):
    ball().apply_translation([1e5, 0, 0]).export(tmp_path / "a.stl")
    with pytest.raises(
        CongraspError,
        match=r"a\.stl is so far from its origin that .* rounded to 0\.0078\. Move it",
    ):
        read_mesh(tmp_path / "a.stl")


_CHANNEL = [(0, 0), (6, 0), (6, 4), (5, 4), (5, 1), (1, 1), (1, 4), (0, 4)]
_ARROW = [(0, 0), (2, 0), (0.5, 0.5), (0, 2)]


def _prism(outline):
    """Points and polygons of a prism, as modelling programs export it: one polygon for each end."""
    points = [(x, y, z) for z, (x, y) in itertools.product((0, 3), outline)]
    n = len(outline)
    sides = [(i, (i + 1) % n, (i + 1) % n + n, i + n) for i in range(n)]
    return points, [tuple(range(n))[::-1], tuple(range(n, 2 * n)), *sides]


def _ply(outline, kind, number=None, comment=""):
    """A prism whose faces have colours; in text if there is a format for the numbers."""
    points, faces = _prism(outline)
    header = f"""ply\n{comment}format {kind} 1.0
comment element face follows\nobj_info big_endian
element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z
element face {len(faces)}\ncomment its colours\nobj_info ascii\nproperty list uchar int vertex_index
property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"""
    rows = [("3f", *point) for point in points]
    rows += [(f"B{len(one)}i3B", len(one), *one, 9, i, 7) for i, one in enumerate(faces)]
    order = ">" if "big" in kind else "<"
    written = []
    for form, *values in rows:
        if number is None:
            written.append(struct.pack(order + form, *values))
        else:
            written.append((" ".join(number % x for x in values) + "\n").encode())
    return header.encode() + b"".join(written)


_QUADS = _ply(_ARROW, "binary_little_endian")


@pytest.mark.parametrize(
    ("data", "volume"),
    [
        pytest.param(_ply(_ARROW, "ascii", " %.3e"), 3, id="text of np.savetxt"),
        pytest.param(
            _ply(_CHANNEL, "ascii", "%g").replace(b"element face 10", b"element\tface\t10"),
            36,
            id="tabs",
        ),
        pytest.param(_ply(_ARROW, "ascii", "%g").replace(b"\n", b"\r\n"), 3, id="lines of Windows"),
        pytest.param(
            _ply(_ARROW, "binary_little_endian", comment="comment ascii big\n"), 3, id="comment"
        ),
        pytest.param(_ply(_ARROW, "binary_big_endian"), 3, id="big-endian quads"),
        pytest.param(_ply(_CHANNEL, "binary_big_endian"), 36, id="mixed polygons"),
        pytest.param(_QUADS, 3, id="dented quads"),
    ],
)
def test_polygons_of_a_ply_keep_their_volume_and_their_colours(tmp_path, data, volume):
    (tmp_path / "a.ply").write_bytes(data)
    notes = list[str]()
    mesh = read_mesh(tmp_path / "a.ply", notes)
    assert mesh.is_watertight
    assert abs(mesh.volume) == pytest.approx(volume)
    assert not notes
    colours = load_geometry(tmp_path / "a.ply", "").visual.face_colors[:, :3]
    faces = 6 if volume == 3 else 10
    np.testing.assert_array_equal(np.unique(colours, axis=0), [(9, i, 7) for i in range(faces)])


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (_QUADS[:-1], "it ends within a face"),
        (_QUADS[:-30], "a row lacks values"),
        (_ply(_ARROW, "ascii", "%g")[:-4], "a row lacks values"),
        (
            _QUADS.replace(b"list uchar", b"list char").replace(b"\4\3\0\0\0\2", b"\xfc\3\0\0\0\2"),
            "a negative number",
        ),
    ],
)
def test_a_ply_of_other_faces_than_it_announces_is_refused(tmp_path, data, why):
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(CongraspError, match=why):
        read_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_polygons_of_a_ply_are_cut_inside_of_them(tmp_path, kind):
    """Faces of eight corners and of four, each with a colour, between points with one and an
    edge.
    """
    points, faces = _prism(_CHANNEL)
    numbers = "property float x\nproperty float y\nproperty float z\nproperty uchar red"
    face = "property uchar red\nproperty list uchar int vertex_indices\nproperty short rest"
    edge = "element edge 1\nproperty int vertex1\nproperty int vertex2"
    header = (
        f"ply\nformat {kind} 1.0\nelement vertex 16\n{numbers}\nelement face "
        f"10\n{face}\n{edge}\nend_header\n"
    )
    rows = [("3fB", *point, 7) for point in points] + [
        (f"BB{len(one)}ih", 9, len(one), *one, 1) for one in faces
    ]
    rows.append(("ii", 5, 6))
    order = ">" if "big" in kind else "<"
    data = b"".join(struct.pack(order + row[0], *row[1:]) for row in rows)
    text = "".join(" ".join(map(str, row[1:])) + "\n" for row in rows)
    (tmp_path / "a.ply").write_bytes(header.encode() + (text.encode() if kind == "ascii" else data))
    mesh = read_mesh(tmp_path / "a.ply")
    assert mesh.is_watertight
    assert abs(mesh.volume) == pytest.approx(36)
    assert mesh.area == pytest.approx(24 + 26 * 3)


@pytest.mark.parametrize("turn", [1, -1])
@pytest.mark.parametrize("end", ["", "# end", "\\\n"])
def test_dented_polygons_are_cut_inside_of_them(tmp_path, turn, end):
    points, faces = _prism(_CHANNEL[::turn])
    text = "".join("v {} {} {}\n".format(*point) for point in points)
    (tmp_path / "a.obj").write_text(text + "".join(f"f {_row(face, end)}\n" for face in faces))
    mesh = read_mesh(tmp_path / "a.obj")
    assert mesh.is_watertight
    assert abs(mesh.volume) == pytest.approx(36)
    assert mesh.area == pytest.approx(24 + 26 * 3)


def _row(face, end):
    words = [f"{i + 1}//" for i in face]
    return " ".join([*words[:3], end, *words[3:]] if "\n" in end else [*words, end])


def _flat(outline, face=None):
    face = face or range(len(outline))
    return (
        "".join(f"v {x} {y} 0\n" for x, y in outline) + f"f {' '.join(str(i + 1) for i in face)}\n"
    )


def test_a_polygon_with_a_bridge_to_its_hole_and_dented_quads_are_cut(tmp_path):
    square = [(0, 0), (4, 0), (4, 4), (0, 4), (1, 1), (1, 3), (3, 3), (3, 1)]
    for text, area in [(_flat(square, (0, 1, 2, 3, 0, 4, 5, 6, 7, 4)), 12), (_flat(_ARROW), 1)]:
        (tmp_path / "a.obj").write_text(text)
        assert load_geometry(tmp_path / "a.obj", "").area == pytest.approx(area)


def _star(corners):
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    radius = np.where(np.arange(corners) % 2, 1, 0.4)
    return _flat(np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1))


def test_star_of_many_corners_is_cut(tmp_path):
    (tmp_path / "a.obj").write_text(_star(1000))
    notes = list[str]()
    mesh = load_geometry(tmp_path / "a.obj", "", notes=notes)
    assert mesh.area == pytest.approx(500 * 0.4 * np.sin(np.pi / 500))
    assert not notes


def test_many_corners_are_left_with_a_note(tmp_path):
    (tmp_path / "a.obj").write_text(_star(1002))
    notes = list[str]()
    assert len(load_geometry(tmp_path / "a.obj", "", notes=notes).faces) == 1000
    assert notes == [
        "1 of its dented polygons could not be cut and may be filled (export it as triangles)"
    ]
    (tmp_path / "a.obj").write_text("v 0 0\n" + _flat(np.eye(4, 2)))
    with pytest.raises(CongraspError, match="a point has fewer than three numbers"):
        read_mesh(tmp_path / "a.obj")


@pytest.mark.parametrize(("neck", "filled"), [(0.004, True), (0.012, False)])
def test_a_hollow_that_no_finger_enters_is_filled(neck, filled):
    """A bottle with a wall of 3 mm."""
    outer = [(0, 0), (0.035, 0), (0.035, 0.12), (neck + 0.003, 0.15), (neck + 0.003, 0.18)]
    inner = [(neck, 0.18), (neck, 0.149), (0.032, 0.119), (0.032, 0.003), (0, 0.003)]
    bottle, full = (
        trimesh.creation.revolve(np.array(line), sections=32)
        for line in (outer + inner, [*outer, (0, 0.18)])
    )
    notes = list[str]()
    repaired = without_hollows(bottle, notes)
    np.testing.assert_allclose(repaired.volume, (full if filled else bottle).volume, rtol=0.01)
    assert repair.encloses(repaired)
    assert bool(notes) == filled


@pytest.mark.slow
def test_a_filled_mesh_with_tunnels_is_rebuilt():
    """Eleven tori stand for the tunnels that remain of a wall: they keep their shape."""
    tori = []
    for i in range(11):
        torus = trimesh.creation.torus(0.02, 0.008, major_sections=16, minor_sections=8)
        tori.append(torus.apply_translation([0.06 * (i % 4), 0.06 * (i // 4), 0]))
    mesh = trimesh.util.concatenate(tori)
    result = decompose(
        mesh.vertices, mesh.faces, volume=mesh.volume, is_filled=True, max_pieces=400
    )
    assert result.method == "coacd"
    errors = fidelity(np.asarray(mesh.triangles), result.pieces, is_closed=True)
    assert errors.surface < 0.003
    assert abs(errors.volume) < 0.1


def test_a_filled_bottle_is_cut_into_few_solid_pieces():
    line = [(0, 0), (0.035, 0), (0.035, 0.12), (0.007, 0.15), (0.007, 0.18), (0, 0.18)]
    bottle = trimesh.creation.revolve(np.array(line), sections=32)
    result = decompose(bottle.vertices, bottle.faces, volume=bottle.volume, is_filled=True)
    assert len(result.pieces) <= 4
    errors = fidelity(np.asarray(bottle.triangles), result.pieces, is_closed=True)
    assert errors.tolerance_ratio < 1


def test_a_hollow_without_an_opening_is_filled():
    void = ball()
    void.apply_scale(0.9)
    void.invert()
    filled = without_hollows(trimesh.util.concatenate([ball(), void]), [])
    np.testing.assert_allclose(filled.volume, ball().volume, rtol=1e-6)


@pytest.mark.slow
def test_millions_of_triangles(tmp_path, quick_import, monkeypatch):
    monkeypatch.setattr(repair, "MAX_FACES_AT_READING", 20_000)
    monkeypatch.setattr(repair, "MAX_SIMPLE_FACES", 2_000)
    fine = trimesh.creation.icosphere(subdivisions=6, radius=RADIUS)
    fine.export(tmp_path / "fine.stl")
    obj = one_object(tmp_path / "fine.stl", ImportOptions(cache_dir=str(tmp_path / "cache")))
    notes = obj.notes
    assert notes[0] == "its 81,920 triangles were reduced to 2,000: a hand does not feel the rest"
    assert len(obj.visual_faces) <= 2_000
    assert not [note for note in notes if "open" in note]
    np.testing.assert_allclose(np.linalg.norm(obj.points, axis=-1), RADIUS, rtol=0.02)
    # As STL files have it: no triangle shares a corner
    soup = fine.vertices[fine.faces].reshape(-1, 3)
    vertices, faces = reduce_large(soup, np.arange(len(soup)).reshape(-1, 3), [])
    assert trimesh.Trimesh(vertices, faces).is_watertight


def test_a_surface_without_an_outside_is_unchanged():
    strip = trimesh.Trimesh(*_moebius())
    notes: list[str] = []
    assert close_and_orient(strip, notes).faces.shape == strip.faces.shape
    assert not notes


def _moebius():
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rim = [
        (
            np.cos(t) * (1 + s * np.cos(t / 2)),
            np.sin(t) * (1 + s * np.cos(t / 2)),
            s * np.sin(t / 2),
        )
        for t, s in itertools.product(turns, (-0.2, 0.2))
    ]
    faces = []
    for i in range(24):
        a = 2 * i
        b = 2 * i + 1
        c, d = (2 * i + 2, 2 * i + 3) if i < 23 else (1, 0)
        faces += [(a, b, c), (b, d, c)]
    return rim, faces


def test_a_slit_along_a_bend_is_closed_along_the_bend():
    """A fan around the middle of the slit's rim would cut a wedge of 1 cm out of the sphere."""
    sphere = trimesh.creation.uv_sphere(0.04, count=[32, 32])
    x, y, z = sphere.triangles_center.T
    is_slit = (np.abs(np.arctan2(y, x) - 0.1) < 0.1) & (np.abs(z) < 0.03)
    assert is_slit.sum() > 20
    sphere.update_faces(~is_slit)
    (loop,) = hole_loops(sphere)
    filled = fill(sphere, [loop])
    assert filled.is_watertight
    assert len(filled.vertices) == len(sphere.vertices)
    ball_mesh = trimesh.creation.uv_sphere(0.04, count=[32, 32])
    np.testing.assert_allclose(filled.volume, ball_mesh.volume, rtol=5e-4)


def test_a_hole_whose_bases_are_edges_of_the_mesh_is_closed_by_a_fan():
    """The two diagonals of the square rim are edges already."""
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, -1]]
    sides = [[4, 1, 0], [4, 2, 1], [4, 3, 2], [4, 0, 3]]
    others = [[0, 2, 5], [1, 3, 5]]
    mesh = trimesh.Trimesh([*corners, [0.5, 0.5, 3]], sides + others, process=False)
    filled = fill(mesh, [np.array([1, 0, 3, 2])])
    assert len(filled.vertices) == 7
    np.testing.assert_allclose(filled.vertices[-1], [0.5, 0.5, 0])
