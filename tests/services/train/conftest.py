"""The claw among the user's own hands."""

import functools
import pathlib

import pytest

from congrasp.common.hands import get_hand
from congrasp.common.hands.files import hand_text
from congrasp.services.assets.hands.model_files import import_hand

CLAW = pathlib.Path(__file__).parents[2] / "hands" / "claw.urdf"


@functools.cache
def imported():
    return hand_text(import_hand(CLAW).hand)


@pytest.fixture
def claw(monkeypatch, tmp_path):
    """In the folder `hands` of the test."""
    monkeypatch.setenv("CONGRASP_HANDS", str(tmp_path / "hands"))
    (tmp_path / "hands").mkdir()
    (tmp_path / "hands" / "claw.json").write_text(imported())
    get_hand.cache_clear()
    yield get_hand("claw")
    get_hand.cache_clear()
