"""Approaches that the table allows."""

import pathlib

import numpy as np
import pytest
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.common.objects.families.draft import Draft, box
from congrasp.common.objects.shapes import matrix
from congrasp.common.request import GraspRequest
from congrasp.services.assets.objects.named import one_object
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.grasp import approaches
from congrasp.services.grasp.approaches import headings, with_avoid


def test_an_object_that_lies_too_flat(tmp_path: pathlib.Path, quick_import: None) -> None:
    trimesh.creation.box((0.085, 0.054, 0.008)).export(tmp_path / "phone.stl")
    phone = one_object(tmp_path / "phone.stl", ImportOptions(cache_dir=str(tmp_path)))
    request = GraspRequest({"heading": {}})
    rng = np.random.default_rng(0)
    with pytest.raises(
        CongraspError, match=r"lies too flat .* 8 mm high .* Set --rest (\d)"
    ) as error:
        headings(get_hand("human"), phone, request, 8, rng)
    rest = int(str(error.value).split("--rest ")[1][0]) - 1
    rests = headings(get_hand("human"), phone, GraspRequest({"heading": {}}, rest=rest), 8, rng)[3]
    assert rest > 0
    assert (rests == rest).all()


def test_fingers_close_across_a_handle_with_few_surface_points() -> None:
    """A bar of 9 mm, 25 mm before a block: fingertips have no room behind it at the usual depth of
    2 cm.
    """
    rods = [box((0.017, 0.0045, 0.0045), (0.052, 0.0, z)) for z in (0.03, -0.03)]
    draft = Draft(
        (box((0.04, 0.04, 0.045)), *rods, box((0.0045, 0.0045, 0.0345), (0.0695, 0.0, 0.0)))
    )
    cup = procedural.build_object("cup", "mug", draft, np.random.default_rng(0))
    assert cup is not None
    face = cup.pieces[0].pos[0] + 0.04
    avoid = cup.points[:, 0] < face + 0.001
    assert 0.02 < (~avoid).mean() < 0.1
    upright = int(np.argmax([abs(matrix(rest[3:])[2, 2]) for rest in cup.rest_poses]))
    request = GraspRequest({"heading": {}}, avoid, rest=upright)
    rng = np.random.default_rng(0)
    position, _, cross, _ = headings(get_hand("human"), with_avoid(cup, avoid), request, 64, rng)
    assert len(np.unique(position, axis=0)) > 4
    assert (position[:, 0] > face + 0.01).all()
    assert (np.abs(cross[:, 1]) > 0.7).all()  # across the bars of the handle, not along them


@pytest.mark.parametrize(
    ("grasp_request", "remedy"),
    [
        (GraspRequest(), "Scale it."),
        (GraspRequest(rest=2), "Leave out --rest, or scale it."),
        (GraspRequest(above=True), "Leave out --heading, or scale it."),
        (
            GraspRequest({"heading": {"position": np.zeros(3)}}, rest=0),
            "Leave out --rest or --at, or scale it.",
        ),
    ],
)
def test_a_remedy_names_the_options_that_were_given(
    grasp_request: GraspRequest, remedy: str
) -> None:
    assert approaches.remedy_for(grasp_request, "scale it") == remedy
