"""Test of exported grasps without a policy in MuJoCo C, after DexGraspBench.

An object of 0.1 kg floats without table and gravity, friction 0.6. The hand is at the grasp with
its targets at the squeeze, or at the pregrasp, from which targets go to the grasp and on to the
squeeze, 0.4 s each, open loop. Then the object is pushed for two seconds by 1 N along or against an
axis of the world, each push from the start. Motors have the benchmark's gains and no speed feedback
except the joints' damping, and contacts have the benchmark's stiffness and torsional friction.
Collision shapes are the benchmark's boxes for Allegro, and this project's shapes for Shadow.
"""

import itertools
import json
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.actors.physics.engine import PhysicsState, ResetState
from congrasp.actors.physics.native import EnvInstance, NativePhysics
from congrasp.actors.stress import MAX_SHIFT_M, MAX_TURN_RAD, PUSH_FORCE_N
from congrasp.common.hands.motors import motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.io.files import write_atomically
from congrasp.common.runtime.resources import cores
from congrasp.common.task.config import TaskConfig
from tests.benchmarks.dexgraspbench_grasps import STATES, Grasp, State
from tests.benchmarks.dexgraspbench_hands import benchmarked

MASS = 0.1
FRICTION = 0.6
TORSION = 0.02
"""kg, and sliding and torsional (m) friction of every object."""
_HAND = ((0.005, 1.0), (0.5, 0.99, 1e-4))
_OBJECT = ((0.02, 1.0), (0.9, 0.95, 1e-3))
"""`solref` and the first of `solimp`, of which a contact has the mean."""
STARTS = ("grasp", "pregrasp")
# Control steps: of a stage, of a push, and between two measurements of contacts
_STAGE = 40
_PUSH = 200
_LOOK = 10
_TOGETHER = 32  # grasps in parallel
_TASK = TaskConfig()
_AXES = np.concatenate([np.eye(3), -np.eye(3)])


class Replayed(NamedTuple):
    """Result of one grasp."""

    name: str
    from_grasp: bool
    """True if the object stayed within 5 cm and 15 degrees of its pose under all six pushes from
    the grasp.
    """
    from_pregrasp: bool
    """The same from the pregrasp."""
    depth_mm: float
    """Deepest penetration of hand and object at the grasp, before anything moves."""
    self_mm: float
    """Deepest penetration of two of the hand's links there."""
    pushed_mm: float
    """Deepest penetration of hand and object while it is pushed in the grasp."""


def replayed(
    grasps: Sequence[Grasp], progress: Callable[[int], None] = lambda done: None
) -> list[Replayed]:
    """Replays grasps of one hand; `progress` is called with the number of finished ones."""
    hand = benchmarked(grasps[0].hand, grasps[0].match)
    replays: list[Replayed] = []
    for first in range(0, len(grasps), _TOGETHER):
        replays += _replay(hand, grasps[first : first + _TOGETHER])
        progress(len(replays))
    return replays


def summary(replays: Sequence[Replayed]) -> str:
    """Summary of replayed grasps in one line."""

    def share(start: str) -> float:
        return 100 * float(np.mean([getattr(replay, f"from_{start}") for replay in replays]))

    held, closed = map(share, STARTS)
    depth, self_depth, pushed = np.array(
        [(one.depth_mm, one.self_mm, one.pushed_mm) for one in replays]
    ).T
    return (
        f"six pushes of {PUSH_FORCE_N:g} N survive {held:.0f} % from the grasp, {closed:.0f} % from "
        f"the pregrasp; "
        f"at the grasp the hand is {np.median(depth):.1f} mm (median) to {depth.max():.1f} mm "
        f"(most) in the object and "
        f"{self_depth.max():.1f} mm in itself; pushed, {pushed.max():.1f} mm in the object"
    )


def save_replay(folder: pathlib.Path, replays: Sequence[Replayed]) -> None:
    """Writes the result of each grasp to `replay.json`."""
    write_atomically(
        folder / "replay.json", json.dumps([one._asdict() for one in replays], indent=2).encode()
    )


def _replay(hand: Hand, grasps: Sequence[Grasp]) -> list[Replayed]:
    """Replays grasps in parallel."""
    physics = NativePhysics(hand, _TASK, [grasp.obj for grasp in grasps], cores())
    try:
        _begin(physics, grasps, "grasp")
        still = [_depths(instance) for instance in physics.instances[::6]]
        held, deepest = _pushed(physics, hand, grasps, "grasp")
        closed, _ = _pushed(physics, hand, grasps, "pregrasp")
    finally:
        physics.close()
    return [
        Replayed(grasp.name, bool(held[i]), bool(closed[i]), *still[i], float(deepest[i]))
        for i, grasp in enumerate(grasps)
    ]


def _pushed(
    physics: NativePhysics, hand: Hand, grasps: Sequence[Grasp], start: str
) -> tuple[np.ndarray, np.ndarray]:
    """Survival (N,) of six pushes from a state for each grasp, and the deepest penetration in them,
    mm.
    """
    _begin(physics, grasps, start)
    origin = physics.read(physics)
    in_place: np.ndarray = np.ones(6 * len(grasps), bool)
    deepest = np.zeros(6 * len(grasps))
    script = _script(hand, grasps, STATES[STATES.index(start) :])
    for step, (target, force) in enumerate(script):
        _, state = physics.step(physics, target, np.zeros(len(in_place), bool), force)
        in_place &= _near(origin, state)
        if force.any() and step % _LOOK == 0:
            deepest = np.maximum(deepest, [_depths(instance)[0] for instance in physics.instances])
    return np.all(in_place.reshape(-1, 6), 1), np.max(deepest.reshape(-1, 6), 1)


def _begin(physics: NativePhysics, grasps: Sequence[Grasp], start: str) -> None:
    """Sets six worlds for each grasp to a state, without gravity."""
    states = [grasp.states[start] for grasp in grasps]
    objects = [
        (grasp.object_position, grasp.object_rotation.as_quat(scalar_first=True))
        for grasp in grasps
    ]

    def six(rows: Sequence[np.ndarray | float | int]) -> np.ndarray:
        return np.repeat(np.array(rows), 6, 0)

    physics.start(
        ResetState(
            object_index=six(range(len(grasps))),
            mass_scale=six([MASS / grasp.obj.mass for grasp in grasps]),
            friction=six([FRICTION] * len(grasps)),
            gain_scale=np.ones(6 * len(grasps)),
            base_position=six([state.position for state in states]),
            base_quaternion=six([state.rotation.as_quat(scalar_first=True) for state in states]),
            u_velocity=np.zeros((6 * len(grasps), 6)),
            q=six([state.q for state in states]),
            object_position=six([position for position, _ in objects]),
            object_quaternion=six([quaternion for _, quaternion in objects]),
            stationary=np.zeros(6 * len(grasps), bool),
        )
    )
    physics.place_tables(np.zeros(6 * len(grasps), bool))
    for instance in physics.instances:
        _harden(instance.model)
        mujoco.mj_forward(instance.model, instance.data)


def _harden(model: mujoco.MjModel) -> None:
    """Removes gravity, and sets the benchmark's contact parameters."""
    model.opt.gravity[:] = 0.0
    model.opt.noslip_iterations = 2
    of_object = model.geom_bodyid == model.body("object").id
    model.geom_condim[of_object] = 4
    model.geom_friction[of_object, 1] = TORSION
    model.geom_solmix[:] = 1.0
    for geoms, (solref, solimp) in ((~of_object, _HAND), (of_object, _OBJECT)):
        model.geom_solref[geoms] = solref
        model.geom_solimp[geoms, :3] = solimp


def _script(
    hand: Hand, grasps: Sequence[Grasp], stages: Sequence[str]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields targets (6 N, 6 + M) and forces (6 N, 3) of each control step: from state to state,
    then the pushes.
    """
    pushes = np.tile(PUSH_FORCE_N * _AXES, (len(grasps), 1))
    # From the grasp the targets are the squeeze at once.
    shares = np.linspace(0.0, 1.0, _STAGE + 1)[1:] if len(stages) > 2 else np.ones(_STAGE)
    rows = pushes
    for first, second in itertools.pairwise(stages):
        for share in shares:
            names = stages[0], first, second
            rows = np.repeat([_between(hand, grasp.states, names, share) for grasp in grasps], 6, 0)
            yield rows, np.zeros_like(pushes)
    for _ in range(_PUSH):
        yield rows, pushes


def _between(
    hand: Hand, states: Mapping[str, State], names: tuple[str, str, str], share: float
) -> np.ndarray:
    """(6 + M,) targets at a share between two states, the last of three names; the first is the
    wrist's base.
    """
    base, first, second = (states[name] for name in names)
    position = (1 - share) * first.position + share * second.position
    turn = first.rotation * Rotation.from_rotvec(
        share * (first.rotation.inv() * second.rotation).as_rotvec()
    )
    q = (1 - share) * first.q + share * second.q
    slides = base.rotation.inv().apply(position - base.position)
    hinges = (base.rotation.inv() * turn).as_euler("XYZ")
    return np.concatenate([slides, hinges, motor_positions(hand, q)])


def _near(origin: PhysicsState, state: PhysicsState) -> np.ndarray:
    """(B,) bool: objects are close to their initial poses."""
    way = np.linalg.norm(np.asarray(state.object_position - origin.object_position), axis=-1)
    cosine = np.abs(np.sum(np.asarray(state.object_quaternion * origin.object_quaternion), -1))
    return (
        (way < MAX_SHIFT_M)
        & (2 * np.arccos(np.minimum(cosine, 1.0)) < MAX_TURN_RAD)
        & ~np.asarray(state.diverged)
    )


def _depths(instance: EnvInstance) -> tuple[float, float]:
    """Deepest contact of hand and object, and of two links, mm."""
    contact = instance.data.contact
    model = instance.model
    touches = (model.geom_bodyid[contact.geom] == model.body("object").id).any(-1)
    depth = 1e3 * np.maximum(-contact.dist, 0.0)
    return float(depth[touches].max(initial=0.0)), float(depth[~touches].max(initial=0.0))
