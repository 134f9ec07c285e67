"""Robot descriptions that ask for more than a machine has."""

import pathlib
import time

import mujoco
import pytest

from common.errors import CongraspError
from services.assets.hands import compile as compiling
from services.assets.hands.compile import compiled_model

HANDS = pathlib.Path(__file__).parents[3] / "hands"
_GEOM = '<body><geom size="0.1"/></body>'


def _mjcf(tmp_path, body):
    (tmp_path / "a.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    return tmp_path / "a.xml"


def test_a_small_file_is_what_mujoco_makes_of_it():
    model = compiled_model(HANDS / "claw.xml", notes := [])
    direct = mujoco.MjModel.from_xml_path(str(HANDS / "claw.xml"))
    assert (model.nv, model.nbody, notes) == (direct.nv, direct.nbody, [])
    assert [model.body(i).name for i in range(model.nbody)] == [direct.body(i).name for i in range(direct.nbody)]


@pytest.mark.parametrize(
    ("body", "why"),
    [
        (f'<replicate count="100000000">{_GEOM}</replicate>', "repeats a part 100000000 times"),
        ('<composite type="cable" count="1000000 1 1" size="1"><geom size=".01"/></composite>', "repeats a part"),
        (f'<replicate count="x">{_GEOM}</replicate>', "cannot be read"),
        (f'<replicate count="1000">{_GEOM}</replicate>' * 2, "nbody, more than 1000"),
        ("<body>" * 20_000, "cannot be read"),
        ('<body><inertial pos="0 0 0" mass="-1" diaginertia="1 1 1"/></body>', "mass"),
        ('<body><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 9"/></body>', "inertia"),
        ('<body><joint range="1 -1" limited="true"/><geom size="1"/></body>', "range"),
        ("<body pos='nan 0 0'><joint/><geom size='1'/></body>", "cannot be read"),
    ],
)
def test_hostile_files_are_refused_in_one_line_and_soon(tmp_path, body, why):
    begin = time.monotonic()
    with pytest.raises(CongraspError, match=why) as raised:
        compiled_model(_mjcf(tmp_path, body), [])
    assert str(tmp_path) in str(raised.value) and "\n" not in str(raised.value)
    assert time.monotonic() - begin < 30


def test_counts_that_multiply_meet_the_time_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(compiling, "SECONDS", 2)
    nested = '<replicate count="999">' * 3 + _GEOM + "</replicate>" * 3
    with pytest.raises(CongraspError, match=r"not read within 2 s|more than 3 GB"):
        compiled_model(_mjcf(tmp_path, nested), [])
