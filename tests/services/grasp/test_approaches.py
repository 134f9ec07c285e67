"""Approaches that the table leaves room for."""

import pathlib

import numpy as np
import pytest
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.request import GraspRequest
from congrasp.services.assets.objects.named import one_object
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.grasp.approaches import headings


def test_a_thing_that_lies_too_flat_is_not_stood_on_its_edge_silently(tmp_path: pathlib.Path) -> None:
    trimesh.creation.box((0.085, 0.054, 0.008)).export(tmp_path / "phone.stl")
    phone = one_object(tmp_path / "phone.stl", ImportOptions(cache_dir=str(tmp_path)))
    request, rng = GraspRequest({"heading": {}}), np.random.default_rng(0)
    with pytest.raises(CongraspError, match=r"lies too flat .* 8 mm high .* Set --rest (\d)") as error:
        headings(get_hand("human"), phone, request, 8, rng)
    rest = int(str(error.value).split("--rest ")[1][0]) - 1
    rests = headings(get_hand("human"), phone, GraspRequest({"heading": {}}, rest=rest), 8, rng)[3]
    assert rest > 0 and (rests == rest).all()
