"""Procedural objects of any family and seed, the pools made of them, and objects on disk."""

import itertools

import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from congrasp.common.config import ObjectsConfig
from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural, shapes
from congrasp.common.objects.families import BUILDERS
from congrasp.common.objects.mjcf import add_object
from congrasp.common.objects.pool import HELD_OUT_SEED, first_seed, load_pool
from congrasp.common.objects.procedural import (
    BASIC_FAMILIES,
    FAMILIES,
    HOUSEHOLD_FAMILIES,
    MASS_RANGE,
    family_turns,
    generate,
    generate_many,
)
from congrasp.common.objects.resting import TableScene
from congrasp.common.objects.shapes import sample_union
from congrasp.common.objects.spec import MAX_MESH_VERTICES, PRIMITIVE_SLOTS, SURFACE_POINTS
from congrasp.common.objects.store import Catalogue, digest, load, save
from tests.solids import mujoco_mass_properties

MOST_MESHES = 13  # what environments have room for is sized by the object with the most
objects = st.builds(generate, st.integers(0, 2_000_000), st.sampled_from(FAMILIES))


def is_primitive(obj):
    return all(piece.kind != "mesh" for piece in obj.pieces)


def test_most_basic_families_are_primitive():
    objects_of_families = [generate(0, family) for family in BASIC_FAMILIES]
    assert sum(is_primitive(obj) for obj in objects_of_families) >= 12
    assert {obj.family for obj in objects_of_families if not is_primitive(obj)} == {
        "ring",
        "bowl",
        "cup",
    }


@settings(max_examples=12, deadline=None)
@given(objects)
def test_geometry_is_sound(obj):
    points = obj.points.astype(float)
    normals = obj.normals.astype(float)
    assert points.shape == normals.shape == (SURFACE_POINTS, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    # On the surface of the union, with the normal pointing out of it.
    outside = [shapes.contains(piece, points + 2e-4 * normals) for piece in obj.pieces]
    inside = [shapes.contains(piece, points - 2e-6 * normals) for piece in obj.pieces]
    assert not np.any(outside, axis=0).any()
    # (A point may lie on an edge so sharp that even this small step inwards leaves the object.)
    assert np.any(inside, axis=0).mean() > 0.99
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    reach = np.max([shapes.support(piece, axes) for piece in obj.pieces], axis=0)
    assert 0.03 <= (reach[:3] + reach[3:]).max() <= (0.25 if obj.family in BASIC_FAMILIES else 0.3)
    assert np.abs(obj.visual_vertices).max() <= reach.max() + 1e-6
    assert obj.visual_faces.max() < len(obj.visual_vertices)


@settings(max_examples=12, deadline=None)
@given(objects)
def test_parts_and_slots_are_usable(obj):
    assert obj.graspable.shape == (len(obj.part_names),)
    assert obj.labels.min() >= 0
    assert obj.labels.max() < len(obj.part_names)
    share = obj.non_graspable_points.mean()
    assert 0.1 <= share <= 0.9
    # The first half of the points, which a policy may be given alone, shows the same regions.
    assert abs(obj.non_graspable_points[:256].mean() - share) < 0.1
    kinds = [piece.kind for piece in obj.pieces]
    assert all(kinds.count(kind) <= slots for kind, slots in PRIMITIVE_SLOTS.items())
    assert kinds.count("mesh") <= MOST_MESHES
    assert all(
        len(piece.vertices) <= MAX_MESH_VERTICES for piece in obj.pieces if piece.kind == "mesh"
    )


@settings(max_examples=12, deadline=None)
@given(objects)
def test_mass_and_inertia_are_those_of_a_body(obj):
    assert MASS_RANGE[0] <= obj.mass <= MASS_RANGE[1]
    np.testing.assert_allclose(obj.inertia, obj.inertia.T, rtol=1e-9, atol=1e-15)
    a, b, c = np.linalg.eigvalsh(obj.inertia)
    assert a > 0
    assert a + b > c


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]
)
@pytest.mark.parametrize("family", HOUSEHOLD_FAMILIES)
def test_household_objects_are_of_one_piece(family, seed):
    spec = mujoco.MjSpec()
    add_object(spec, generate(seed, family))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    touching = np.eye(model.ngeom, dtype=bool)
    for i, j in itertools.combinations(range(model.ngeom), 2):
        touching[i, j] = mujoco.mj_geomDistance(model, data, i, j, 0.01, None) < 5e-4
    assert connected_components(touching, directed=False)[0] == 1


EVEN = [name for name in FAMILIES if not BUILDERS[name](np.random.default_rng(0)).weight]


@settings(max_examples=8, deadline=None)
@given(st.builds(generate, st.integers(0, 2_000_000), st.sampled_from(EVEN)))
def test_inertia_of_evenly_dense_objects_equals_mujocos(obj):
    density = obj.mass / sum(shapes.volume(piece) for piece in obj.pieces)
    _, center, inertia = mujoco_mass_properties(obj.pieces, [density] * len(obj.pieces))
    np.testing.assert_allclose(center, 0, atol=1e-6)
    np.testing.assert_allclose(obj.inertia, inertia, atol=1e-4 * np.abs(inertia).max())


@settings(max_examples=8, deadline=None)
@given(objects)
@example(generate(12322, "teapot"))  # a pose out of which it rolls ever faster, and slowly at first
@example(generate(6516, "flashlight"))  # a contact comes and goes
def test_resting_poses_touch_the_table_and_rest(obj):
    poses = obj.rest_poses
    assert 1 <= len(poses) <= 8
    np.testing.assert_array_equal(poses[:, :2], 0)
    np.testing.assert_allclose(np.linalg.norm(poses[:, 3:], axis=-1), 1, atol=1e-9)
    downs = np.array([-shapes.matrix(pose[3:])[2] for pose in poses])
    depth = np.max([shapes.support(piece, downs) for piece in obj.pieces], axis=0)
    np.testing.assert_allclose(poses[:, 2], depth, atol=1e-3)
    scene = TableScene(obj)
    for pose in poses:
        settled = scene.settle(pose, 2.0)
        assert settled.speed < 0.01
        assert settled.moved < 0.01
        if obj.family in HOUSEHOLD_FAMILIES:
            assert 2 * np.degrees(np.arccos(min(1.0, abs(settled.pose[3:] @ pose[3:])))) < 5.0


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 2_000_000), st.sampled_from(FAMILIES))
def test_seed_and_family_decide_the_object(seed, family):
    assert digest(generate(seed, family)) == digest(generate(seed, family))
    assert digest(generate(seed, family)) != digest(generate(seed + 1, family))


def test_no_two_of_many_are_alike():
    many = generate_many(48, 10)
    volumes = [sum(map(shapes.volume, obj.pieces)) for obj in many]
    assert len(np.unique(np.round(volumes, 12))) == 48
    assert len({obj.name for obj in many}) == 48
    assert {obj.family for obj in many} == set(BASIC_FAMILIES)


def test_a_group_means_its_families():
    assert family_turns(3, 0, ("mug", "household")) == ["mug", *HOUSEHOLD_FAMILIES[:2]]
    assert set(family_turns(66, 0, ("all",))) == {*BASIC_FAMILIES, *HOUSEHOLD_FAMILIES}
    assert set(family_turns(74, 0, ("all", "scans"))) == set(FAMILIES)
    assert family_turns(30, 7) == family_turns(30, 7, ("basic",))


@pytest.mark.parametrize("family", ["teacup", "basket", "lidded", "sieve"])
def test_half_of_the_points_lie_on_a_thin_handle(family):
    obj = generate(3, family)
    owner = sample_union(obj.pieces, np.random.default_rng(0))[2]
    assert np.mean([obj.pieces[i].part for i in owner]) < 0.3
    assert obj.graspable[obj.labels].mean() == 0.5
    assert obj.graspable[obj.labels[:256]].mean() == 0.5


@pytest.mark.parametrize(
    ("family", "mass", "moment"),
    [
        ("mug", 0.17656752189, 449.437772545),
        ("ring", 0.0908334667544, 308.171194957),
        ("compound", 0.280085458611, 1164.81867416),
    ],
)
def test_held_out_objects_of_basic_families_are_unchanged(family, mass, moment):
    """Figures of different versions are of the same objects."""
    obj = generate(1_000_000, family)
    np.testing.assert_allclose([obj.mass, 1e6 * np.trace(obj.inertia)], [mass, moment], rtol=1e-6)


def test_an_object_does_not_depend_on_how_many_are_made_with_it():
    families = ("mug", "knife", "ball")
    assert digest(generate_many(3, 5, families)[2]) == digest(generate_many(1, 7, families)[0])
    assert digest(generate(11)) == digest(generate(11))


def test_unknown_families_and_negative_seeds_are_named():
    with pytest.raises(CongraspError, match=r"no object family 'cat'.*box, cylinder"):
        generate(0, "cat")
    with pytest.raises(CongraspError, match="no object family 'cat'"):
        generate_many(2, 0, ("box", "cat"))
    with pytest.raises(CongraspError, match="seed -1 is negative"):
        generate(-1)


# --- pools ---


def test_actors_have_objects_of_their_own():
    config = ObjectsConfig(count=2, seed=3, families=("box",))
    pools = []
    for shift in (0, 1):
        pools.append([obj.name for obj in load_pool(config, shift)])
    assert pools == [["box_3", "box_4"], ["box_5", "box_6"]]


@given(st.integers(0, HELD_OUT_SEED - 1), st.integers(1, 5000), st.integers(0, 2**32 - 1))
def test_training_never_touches_the_objects_of_evaluation(seed, count, shift):
    first = first_seed(ObjectsConfig(seed=seed, count=count), shift)
    assert first >= 0
    assert first + count <= HELD_OUT_SEED


@given(
    st.integers(0, HELD_OUT_SEED - 1),
    st.integers(1, 5000),
    st.integers(0, 2**32),
    st.integers(0, 2**32),
)
def test_actors_share_no_object_while_there_are_enough(seed, count, one, other):
    actors = (HELD_OUT_SEED - seed % count) // count
    firsts = [
        first_seed(ObjectsConfig(seed=seed, count=count), shift % actors) for shift in (one, other)
    ]
    assert one % actors == other % actors or abs(firsts[0] - firsts[1]) >= count


def test_evaluation_has_the_same_objects_everywhere():
    config = ObjectsConfig(count=2, seed=HELD_OUT_SEED + 7)
    assert first_seed(config, 0) == first_seed(config, 123) == HELD_OUT_SEED + 7


def test_a_folder_gives_every_actor_all_its_objects(tmp_path):
    catalogue = Catalogue(tmp_path)
    for seed in (2, 1):
        catalogue.add(procedural.generate(seed, "box"))
    config = ObjectsConfig(folder=str(tmp_path), count=1)
    for shift in (0, 5):
        assert [obj.name for obj in load_pool(config, shift)] == ["box_1", "box_2"]


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (ObjectsConfig(count=0), "pool is empty: objects.count is 0"),
        (ObjectsConfig(folder="/nonexistent"), "no folder /nonexistent"),
        (ObjectsConfig(count=1, families=("unicorn",)), "unicorn"),
    ],
)
def test_pools_that_cannot_be_are_refused_in_words(config, words):
    with pytest.raises(CongraspError, match=words):
        load_pool(config)


def test_an_empty_folder_names_the_remedy(tmp_path):
    with pytest.raises(CongraspError, match=r"contains no object\. .*objects import"):
        load_pool(ObjectsConfig(folder=str(tmp_path)))


# --- on disk ---


@pytest.mark.parametrize("family", ["mug", "bowl"])
def test_an_object_comes_back_as_it_was(tmp_path, family):
    obj = generate(1, family)
    save(obj, tmp_path / "x.safetensors")
    back = load(tmp_path / "x.safetensors")
    assert digest(back) == digest(obj)
    assert back.name == obj.name
    assert back.family == obj.family
    assert back.part_names == obj.part_names
    assert back.mass == obj.mass
    for name in (
        "graspable",
        "inertia",
        "points",
        "normals",
        "labels",
        "rest_poses",
        "visual_faces",
    ):
        np.testing.assert_array_equal(getattr(back, name), getattr(obj, name))
        assert getattr(back, name).dtype == getattr(obj, name).dtype
    for a, b in zip(back.pieces, obj.pieces, strict=True):
        assert a.kind == b.kind
        assert a.size == b.size
        assert a.part == b.part
        np.testing.assert_array_equal(a.pos, b.pos)
        np.testing.assert_array_equal(a.quat, b.quat)
        np.testing.assert_array_equal(a.vertices, b.vertices)


def test_a_catalogue_lists_its_objects(tmp_path):
    catalogue = Catalogue(tmp_path / "new")
    with pytest.raises(CongraspError, match="no folder"):
        catalogue.list()
    for family in ("mug", "box"):
        catalogue.add(generate(2, family))
    assert catalogue.list() == ["box_2", "mug_2"]
    assert digest(catalogue.get("mug_2")) == digest(generate(2, "mug"))
    assert sorted(path.name for path in catalogue.folder.iterdir()) == [
        "box_2.safetensors",
        "mug_2.safetensors",
    ]
    with pytest.raises(CongraspError, match="no object file"):
        catalogue.get("cup_2")
    with pytest.raises(CongraspError, match="cannot name an object"):
        catalogue.get("../mug_2")
