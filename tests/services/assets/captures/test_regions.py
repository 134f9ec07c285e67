"""Reasons for which the graspable region of a captured grasp is not used."""

import types

import numpy as np
import pytest

from congrasp.common.errors import CongraspError
from congrasp.common.objects import procedural
from congrasp.services.assets.captures import regions
from congrasp.services.assets.captures.sequence import Dropped


@pytest.fixture
def grasp():
    """A sequence without labelled parts, its object, and its grasp of one point."""
    obj = procedural.generate(1, "box")
    sequence = types.SimpleNamespace(name="s1/box", object_name="box", parts=())
    demonstration = types.SimpleNamespace(contact=obj.points[:1])
    return sequence, obj, demonstration


def dropped(grasp):
    with pytest.raises(Dropped) as caught:
        regions.with_touched_region(*grasp, "contacts")
    return caught.value


def test_a_small_region_is_dropped_with_its_share(grasp, monkeypatch):
    monkeypatch.setattr(regions, "CONTACT_RADIUS_M", 1e-4)
    reason = dropped(grasp)
    assert reason.rule == "graspable region too small"
    assert "% of its surface" in reason.reason


def test_another_error_is_not_reported_as_a_small_region(grasp, monkeypatch):
    def fail(*arguments):
        raise CongraspError("The disk is full.")

    monkeypatch.setattr(regions, "near_points", lambda obj, *_: np.ones(len(obj.points), bool))
    monkeypatch.setattr(regions, "relabelled", fail)
    reason = dropped(grasp)
    assert reason.rule != "graspable region too small"
    assert "The disk is full." in reason.reason
