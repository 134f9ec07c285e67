"""What a mesh of unknown unit may measure, and which unit makes it a thing for a hand."""

import pathlib

import pytest
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.services.assets.objects.options import METRES, guessed_unit, metres_per_unit, sizes_by_unit
from congrasp.services.studio.catalogue import Importer


@pytest.mark.parametrize(
    ("longest", "unit"),
    [(0.012, "m"), (0.2, "m"), (0.6, "m"), (0.8, "in"), (3.0, ""), (15.0, ""), (25.0, ""), (90.0, "mm"), (300.0, "mm")],
)
def test_the_unit_is_guessed_where_only_one_makes_a_thing_for_a_hand(longest: float, unit: str) -> None:
    sides = (longest / 2, longest, longest / 3)
    assert guessed_unit("a.stl", sides) == unit
    if unit:  # as an import that guesses takes it
        assert metres_per_unit("a.stl", sides, "guess", 1.0, []) == METRES[unit]
    else:
        with pytest.raises(CongraspError, match="add '--unit"):
            metres_per_unit("a.stl", sides, "guess", 1.0, [])


@pytest.mark.parametrize("longest", [1e-4, 2e4])
def test_what_is_for_no_hand_in_any_unit_is_refused(longest: float) -> None:
    with pytest.raises(CongraspError, match=r"a\.stl is .* units long: in none of m, cm, mm, in"):
        guessed_unit("a.stl", (longest, longest, longest))


def test_the_size_in_every_unit_says_whether_a_hand_could_grasp_that() -> None:
    assert sizes_by_unit((6.0, 4.5, 9.0)) == {
        "m": ("6 x 4.5 x 9 m", False),
        "cm": ("6 x 4.5 x 9 cm", True),
        "mm": ("6 x 4.5 x 9 mm", True),
        "in": ("15.2 x 11.4 x 22.9 cm", True),
    }


def test_the_sides_of_a_mesh_are_read_in_its_own_unit(tmp_path: pathlib.Path) -> None:
    trimesh.creation.box((30.0, 40.0, 50.0)).export(tmp_path / "box.stl")
    assert Importer().sides(tmp_path / "box.stl") == pytest.approx((30.0, 40.0, 50.0))
