"""Soft fingertips and free objects on MuJoCo C: what pivots, and what keeps it from pivoting."""

import dataclasses

import mujoco
import numpy as np
import pytest

from congrasp.actors.physics.scene import compile_scene
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.common.task.config import TaskConfig

HAND = get_hand("human")
TASK = TaskConfig()


def _scene(**settings):
    return compile_scene(HAND, dataclasses.replace(TASK, **settings), procedural.generate(0, "box"))


def test_fingertips_alone_resist_turning():
    model = _scene()
    tips = {f"{HAND.links[i].name}_0" for i in HAND.tip_links}
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if name.startswith(tuple(link.name for link in HAND.links)):
            soft = name in tips
            assert model.geom_condim[geom] == (4 if soft else 1)
            assert model.geom_friction[geom, 1] == (TASK.torsional_friction if soft else 0.0)
    hard = _scene(torsional_friction=0.0)
    assert hard.geom_condim.max() == 3


def test_a_spinning_object_keeps_half_of_its_speed_for_two_thirds_of_a_second():
    """Its joint is damped by c: the speed falls as exp(-c t / I)."""
    model = _scene()
    data = mujoco.MjData(model)
    where = model.joint("object").dofadr[0]
    data.mocap_pos[model.body("table").mocapid[0]] = (0, 0, -1000)
    data.qpos[model.joint("object").qposadr[0] : model.joint("object").qposadr[0] + 3] = (1, 1, 1)
    axis = int(np.argmax(model.body("object").inertia))
    data.qvel[where + 3 + axis] = 1.0
    inertia, seconds = model.body("object").inertia[axis], 0.5
    mujoco.mj_step(model, data, round(seconds / model.opt.timestep))
    spun = np.linalg.norm(data.qvel[where + 3 : where + 6])
    assert spun == pytest.approx(np.exp(-TASK.object_damping * seconds / inertia), rel=0.02)


def _turned(torsion: float) -> float:
    """Radians that a rod, pinched at 3 cm from its middle between two soft balls, turns about them in 0.3 s."""
    size = 0.012
    xml = f"""
    <mujoco>
      <option timestep="0.0025" cone="elliptic" impratio="100" integrator="implicitfast"/>
      <worldbody>
        <body name="rod" pos="0.03 0 0">
          <freejoint/>
          <geom type="box" size="0.08 0.005 0.008" mass="0.05" friction="1 0 0"/>
        </body>
        <body pos="0 {0.005 + size} 0">
          <joint name="one" type="slide" axis="0 -1 0"/>
          <geom type="sphere" size="{size}" mass="0.1" condim="4" friction="1 {torsion} 0"/>
        </body>
        <body pos="0 {-0.005 - size} 0">
          <joint name="other" type="slide" axis="0 1 0"/>
          <geom type="sphere" size="{size}" mass="0.1" condim="4" friction="1 {torsion} 0"/>
        </body>
      </worldbody>
      <actuator><motor joint="one"/><motor joint="other"/></actuator>
    </mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.ctrl[:] = 5.0
    mujoco.mj_step(model, data, 120)
    return float(2 * np.arccos(min(1.0, abs(data.qpos[3]))))


def test_torsion_carries_what_a_point_contact_lets_swing():
    """The weight's moment is 0.05 kg x 9.81 m/s^2 x 0.03 m = 15 mN m; two tips of 5 N carry up to 2 x 5 N x torsion."""
    free, soft = _turned(0.0), _turned(0.004)
    assert free > 1.5  # it has swung past its lowest point
    assert soft < 0.1 * free  # MuJoCo's friction creeps
