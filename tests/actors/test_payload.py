"""The wrist carries what the hand holds, on MuJoCo C and through the task's own control law."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from congrasp.actors.physics.scene import TABLE_AWAY, scene_spec
from congrasp.common.hands import get_hand
from congrasp.common.hands.mjcf import WRIST_JOINTS
from congrasp.common.task.config import TaskConfig
from congrasp.common.task.control import Guided, carried_lead, track_load, wrist_lead, wrist_load
from tests.scenes import scene


@pytest.mark.parametrize("name", ["human", "allegro", "sharpa"])
def test_a_load_of_one_and_a_half_kilograms_sinks_less_than_five_millimetres(name):
    hand, task = get_hand(name), TaskConfig()
    spec = scene_spec(hand, task)
    palm = next(body for body in spec.bodies if body.name == hand.links[0].name)
    load = palm.add_body(pos=(0.05, 0.0, 0.08))
    load.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.03, 0, 0), mass=1.5, contype=0, conaffinity=0)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.mocap_pos[model.body("table").mocapid[0]] = TABLE_AWAY
    wrist = [model.joint(joint) for joint in WRIST_JOINTS]
    places, speeds = ([int(getattr(j, field)[0]) for j in wrist] for field in ("qposadr", "dofadr"))
    momentum, u, v = jnp.zeros((1, 6)), np.zeros((1, 6)), np.zeros((1, 6))

    @jax.jit
    def law(momentum, u, v):
        load = wrist_load(hand, task, momentum, u, v)
        state = scene(0, batch=1)[0]._replace(u=u, u_velocity=v, wrist_load=load, table=jnp.zeros(1, bool))
        far = jnp.full(1, task.control.guidance_position_limit)
        given = Guided(-u, far, v, state.table)
        return u + wrist_lead(hand, task.control, given, jnp.zeros((1, 6))) + carried_lead(hand, state)

    after = jax.jit(lambda momentum, u, v, target: track_load(hand, task, momentum, u, v, target))
    sunk, speed = [], []
    for _ in range(200):
        target = law(momentum, u, v)
        data.ctrl[: len(wrist)] = target[0]
        mujoco.mj_step(model, data, task.substeps)
        u, v = data.qpos[places][None], data.qvel[speeds][None]
        momentum = after(momentum, u, v, target)
        sunk.append(np.linalg.norm(u[0, :3]))
        speed.append(np.linalg.norm(v[0, :3]))
    assert max(sunk) < 0.005
    assert sunk[-1] < 1e-4
    assert max(speed[-50:]) < 1e-3


def test_the_observer_measures_a_constant_acceleration():
    """A wrist in free fall whose servos give it nothing."""
    hand, task = get_hand("human"), TaskConfig()
    momentum, steps = jnp.zeros((1, 6)), 30
    down = jnp.array([[0.0, 0.0, -9.81, 0.0, 0.0, 0.0]])
    stiffness, damping = hand.wrist_servos
    u, v = jnp.zeros((1, 6)), jnp.zeros((1, 6))
    for _ in range(steps):
        mean = v + 0.5 * task.control_dt * down
        halfway, u, v = u + 0.5 * task.control_dt * mean, u + task.control_dt * mean, v + task.control_dt * down
        # Targets at which the servos give no acceleration on average: stiffness (u_tgt - u) = damping v.
        momentum = track_load(hand, task, momentum, u, v, halfway + damping / stiffness * mean)
    np.testing.assert_allclose(wrist_load(hand, task, momentum, u, v), down, atol=1e-3)
