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
