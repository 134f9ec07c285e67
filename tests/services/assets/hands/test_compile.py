"""Robot descriptions that ask for more than a machine has."""

import pathlib
import re
import time

import mujoco
import numpy as np
import pytest
import trimesh

from congrasp.common.errors import CongraspError
from congrasp.services.assets.hands import compile as compiling
from congrasp.services.assets.hands.compile import compiled_model

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


def test_links_without_mass_are_read_and_named(tmp_path):
    """A hub between two joints: MuJoCo alone refuses a moving body without mass."""
    inertia = '<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/>'
    link = '<link name="{}"><inertial><mass value=".1"/>' + inertia + "</inertial></link>"
    joint = '<joint name="{0}{1}" type="revolute"><parent link="{0}"/><child link="{1}"/><axis xyz="0 0 1"/>'
    robot = link.format("palm") + '<link name="hub"/>' + link.format("tip")
    for one in (("palm", "hub"), ("hub", "tip")):
        robot += joint.format(*one) + '<limit lower="0" upper="1" effort="1" velocity="1"/></joint>'
    (tmp_path / "a.urdf").write_text(f'<robot name="a">{robot}</robot>')
    model = compiled_model(tmp_path / "a.urdf", notes := [])
    assert model.body("hub").mass == compiling.LEAST[0] and model.body("tip").mass == 0.1
    assert model.nv == 2 and len(notes) == 1 and notes[0].endswith(": hub")


def test_a_collada_mesh_in_millimetres_is_read_in_metres(tmp_path):
    box = trimesh.exchange.dae.export_collada(trimesh.creation.box((20, 40, 60))).decode()
    assert '<unit meter="1.0"' in box or "<unit" not in box
    unit = '<unit name="millimeter" meter="0.001"/>'
    box = re.sub(r"<unit[^>]*/>", unit, box) if "<unit" in box else box.replace("</asset>", unit + "</asset>")
    (tmp_path / "box.dae").write_text(box)
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    shape = '<visual><geometry><mesh filename="package://a/box.dae"/></geometry></visual>'
    (tmp_path / "a.urdf").write_text(f'<robot name="a"><link name="palm">{inertial}{shape}</link></robot>')
    model = compiled_model(tmp_path / "a.urdf", notes := [])
    np.testing.assert_allclose(sorted(np.ptp(model.mesh_vert, axis=0)), [0.02, 0.04, 0.06], rtol=1e-5)
    assert notes == []
