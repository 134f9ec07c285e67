"""The references of the benchmark repeat the states of the actor."""

import numpy as np

from congrasp.actors.physics.engine import ResetState
from congrasp.actors.physics.native import NativePhysics
from congrasp.common.hands import get_hand
from congrasp.common.objects import procedural
from congrasp.common.task.config import TaskConfig
from congrasp.services.bench.replay import Recorder, replay, rolled

HAND = get_hand("human")
TASK = TaskConfig()
WORLDS = 3


def test_replays_end_in_the_states_of_the_recording():
    objects = box, _ = [procedural.generate(0, family) for family in ("box", "cylinder")]
    height = float(np.abs(box.points[:, 2]).max())
    one = np.ones((WORLDS, 1))
    reset_state = ResetState(
        object_index=np.arange(WORLDS) % 2,
        mass_scale=np.linspace(0.5, 1.5, WORLDS),
        friction=np.ones(WORLDS),
        gain_scale=np.ones(WORLDS),
        base_position=one * [0.0, -0.05, 0.5],
        base_quaternion=one * [0.0, 1.0, 0.0, 0.0],  # palm up, under the object
        u_velocity=np.zeros((WORLDS, 6)),
        q=np.zeros((WORLDS, len(HAND.joints))),
        object_position=one * [0.0, 0.0, 0.52 + height],
        object_quaternion=one * [1.0, 0.0, 0.0, 0.0],
        stationary=np.zeros(WORLDS, bool),
    )
    recorder, twin = (make(HAND, TASK, objects, 2) for make in (Recorder, NativePhysics))
    rng = np.random.default_rng(0)
    state = recorder.start(reset_state)
    touched = False
    for step in range(20):
        targets = 0.01 * rng.normal(size=(WORLDS, 6 + len(HAND.joints)))
        state, seen = recorder.step(state, targets, np.full(WORLDS, step < 10))
        touched |= bool(seen.contact_found.any())
    assert touched
    twin.start(reset_state)
    ends = rolled(twin, recorder.commands, TASK.substeps)()
    np.testing.assert_array_equal(ends, [instance.data.qpos for instance in recorder.instances])
    twin.start(reset_state)
    replay(twin, recorder.commands, TASK.substeps)
    for a, b in zip(recorder.instances, twin.instances, strict=True):
        np.testing.assert_array_equal(a.data.qpos, b.data.qpos)
        np.testing.assert_array_equal(a.data.mocap_pos, b.data.mocap_pos)
    recorder.close()
    twin.close()
