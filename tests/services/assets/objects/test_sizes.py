"""Units and masses of imported meshes: which unit makes a thing for a hand, and masses by
material.
"""

import pathlib
import sys

import numpy as np
import pytest
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.objects.procedural import generate
from congrasp.services.assets.objects import options
from congrasp.services.assets.objects.masses import guessed_mass, weigh
from congrasp.services.assets.objects.materials import MATERIALS, materials_of
from congrasp.services.assets.objects.named import ObjectAt, objects_of
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.assets.objects.units import (
    METRES,
    guessed_unit,
    metres_per_unit,
    sizes_by_unit,
)
from congrasp.services.grasp.jobs import import_object
from congrasp.services.studio.catalogue import Importer


def test_numbers_at_their_limits_are_accepted() -> None:
    options.check_options(ImportOptions(scale=1e9, density=25_000, mass=50, max_pieces=sys.maxsize))


@pytest.mark.parametrize(
    ("longest", "unit"),
    [
        (0.012, "m"),
        (0.2, "m"),
        (0.6, "m"),
        (0.8, "in"),
        (3.0, ""),
        (15.0, ""),
        (25.0, ""),
        (90.0, "mm"),
        (300.0, "mm"),
    ],
)
def test_the_unit_is_guessed_if_only_one_gives_a_hand_sized_object(
    longest: float, unit: str
) -> None:
    sides = (longest / 2, longest, longest / 3)
    assert guessed_unit("a.stl", sides) == unit
    if unit:  # as an import that guesses takes it
        assert metres_per_unit("a.stl", sides, "guess", 1.0, []) == METRES[unit]
    else:
        with pytest.raises(CongraspError, match="add '--unit"):
            metres_per_unit("a.stl", sides, "guess", 1.0, [])


@pytest.mark.parametrize("longest", [1e-4, 2e4])
def test_a_size_unsuited_in_every_unit_is_refused(longest: float) -> None:
    with pytest.raises(
        CongraspError,
        match=r"a\.stl is .* units long, which is not a size for a hand in any of the units",
    ):
        guessed_unit("a.stl", (longest, longest, longest))


def test_sizes_in_every_unit_note_graspability() -> None:
    assert sizes_by_unit((6.0, 4.5, 9.0)) == {
        "m": ("6 x 4.5 x 9 m", False),
        "cm": ("6 x 4.5 x 9 cm", True),
        "mm": ("6 x 4.5 x 9 mm", True),
        "in": ("15.2 x 11.4 x 22.9 cm", True),
    }


def test_the_sides_of_a_mesh_are_read_in_its_own_unit(tmp_path: pathlib.Path) -> None:
    trimesh.creation.box((30.0, 40.0, 50.0)).export(tmp_path / "box.stl")
    assert Importer().sides(tmp_path / "box.stl") == pytest.approx((30.0, 40.0, 50.0))


# --- masses: solids, shells and sheets whose mass is worked out by hand; parts of different
# materials ---


def weight(mesh, name):
    return weigh([mesh], materials_of(name, [""]))


def test_a_solid_weighs_its_volume():
    block = trimesh.creation.box((0.02, 0.02, 0.1)).apply_translation((0.3, 0, 0))
    mass = weight(block, "steel")
    assert mass.mass == pytest.approx(7850 * 4e-5)
    np.testing.assert_allclose(mass.center, (0.3, 0, 0), atol=1e-12)
    np.testing.assert_allclose(
        np.diag(mass.inertia), mass.mass / 12 * np.array([0.0104, 0.0104, 0.0008])
    )


def test_an_object_too_thick_for_its_material_weighs_its_wall():
    ball = trimesh.creation.icosphere(4, radius=0.05)
    mass = weight(ball, "ceramic")
    assert mass.mass == pytest.approx(2400 * 0.004 * 4 * np.pi * 0.05**2, rel=0.01)
    np.testing.assert_allclose(
        mass.inertia, 2 / 3 * mass.mass * 0.05**2 * np.eye(3), rtol=0.01, atol=1e-9
    )
    assert weight(ball, "wood").mass == pytest.approx(640 * 4 / 3 * np.pi * 0.05**3, rel=0.01)


def test_a_thin_shell_weighs_the_volume_between_its_walls():
    tube = trimesh.creation.annulus(0.037, 0.04, 0.1)
    assert weight(tube, "ceramic").mass == pytest.approx(
        2400 * np.pi * (0.04**2 - 0.037**2) * 0.1, rel=0.01
    )


def test_an_open_sheet_weighs_its_wall():
    box = trimesh.creation.box((0.06, 0.06, 0.1))
    box.update_faces(box.triangles_center[:, 2] < 0.049)
    assert not box.is_volume
    mass = weight(box, "glass")
    assert mass.mass == pytest.approx(2500 * 0.003 * (0.06**2 + 4 * 0.06 * 0.1))
    assert mass.center[2] == pytest.approx(-0.05 * 0.06**2 / (0.06**2 + 4 * 0.06 * 0.1))
    flat = trimesh.Trimesh([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)], [(0, 1, 2)], process=False)
    assert weight(flat, "paper").mass == pytest.approx(900 * 0.001 * 0.005)


@pytest.fixture
def hammer(tmp_path):
    """A folder with a handle of 2.5 x 2.5 x 25 cm along z, under a head of 2.5 x 9 x 2.5 cm."""
    folder = tmp_path / "hammer"
    folder.mkdir()
    handle = trimesh.creation.box((0.025, 0.025, 0.25))
    head = trimesh.creation.box((0.025, 0.09, 0.025)).apply_translation((0, 0, 0.1375))
    handle.export(folder / "hammer_handle.stl")
    head.export(folder / "hammer_head.stl")
    trimesh.util.concatenate([handle, head]).export(folder / "hammer.stl")
    return folder


def imported(folder: pathlib.Path, **options):
    (obj,) = objects_of(folder, ImportOptions(cache_dir=str(folder.parent / "cache"), **options))
    return obj


def test_a_hammer_has_a_steel_head_and_a_wooden_handle(hammer, quick_import):
    obj = imported(hammer, material="head=steel,handle=wood")
    head = 7850 * 0.025**2 * 0.09
    handle = 640 * 0.025**2 * 0.25
    assert obj.mass == pytest.approx(head + handle, rel=1e-4)
    assert 0.4 < obj.mass < 0.6
    # The file's origin is the handle's middle, so that the centre of mass is high up.
    assert -obj.origin[2] == pytest.approx(0.1375 * head / (head + handle), rel=1e-3)
    for text in ("wood,head=steel", "handle=wood,steel"):
        assert imported(hammer, material=text).mass == obj.mass
    weighed = imported(hammer, material="head=steel,handle=wood", mass=0.5)
    assert weighed.mass == 0.5
    assert weighed.origin == obj.origin
    np.testing.assert_allclose(weighed.inertia / 0.5, obj.inertia / obj.mass)


def test_a_nameless_part_without_material_has_a_remedy():
    parts = ("head", "")
    steel, wood = materials_of("head=steel,wood", parts)
    assert (steel, wood) == (MATERIALS["steel"], MATERIALS["wood"])
    with pytest.raises(CongraspError) as error:
        materials_of("head=steel", parts)
    assert "=NAME" not in str(error.value)


def test_an_unknown_material_is_guessed_by_surface_and_volume_without_a_least_mass():
    assert guessed_mass(1e-6, 6e-4) == pytest.approx(0.0024)  # a centimetre's cube, at 2,400 kg/m^3
    assert guessed_mass(2e-4, 0.02) == pytest.approx(0.1)  # 500 kg/m^3
    assert guessed_mass(1e-5, 0.05) == pytest.approx(0.025)  # 2,500 kg/m^3
    assert guessed_mass(1e-2, 0.3) == 0.5


def test_options_weigh_objects_of_the_generator_too():
    at = ObjectAt("mug_7", pathlib.Path("mug:7"), None)
    before = generate(7, "mug")
    heavy = import_object(at, ImportOptions(mass=0.4))
    assert heavy.mass == 0.4
    np.testing.assert_allclose(heavy.inertia, before.inertia * 0.4 / before.mass)
    steel, wood = (
        import_object(at, ImportOptions(material=name)).mass
        for name in ("body=wood,handle=steel", "wood")
    )
    assert steel > 1.2 * wood
    assert import_object(at, ImportOptions()).mass == before.mass
