"""What the number of an object's convex pieces and vertices costs a physics step, and what it gains
in shape.
"""

import dataclasses
import itertools
import pathlib
import time

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from congrasp.actors.physics.scene import TABLE_AWAY, addresses, compile_scene
from congrasp.common.hands import get_hand
from congrasp.common.hands.motors import motor_positions
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject, Piece
from congrasp.common.task.config import TaskConfig
from congrasp.services.assets.objects.fidelity import fidelity
from congrasp.services.assets.objects.hulls import simplify
from congrasp.services.assets.objects.interior import enclosed
from congrasp.services.assets.objects.merging import merge
from congrasp.services.assets.objects.named import objects_of

_CLOSING = 100
"""Control steps in which the fingers close around the object, which is held where it is."""
_STEPS = 50
"""Control steps that are timed."""
_DEFINITION = (
    "mj_step on one thread, in processor time, with the hand closed around each object in turn; "
    "ratio to the first "
    "row. Contacts and error are means over the objects; the error is against the object's mesh."
)


def coarser(obj: GraspObject, max_pieces: int, max_vertices: int) -> GraspObject:
    """The object with its mesh pieces joined to at most `max_pieces` of at most `max_vertices`
    vertices.
    """
    vertices = [np.asarray(piece.vertices) + piece.pos for piece in obj.pieces]
    triangles = obj.visual_vertices[obj.visual_faces].astype(float)
    volume = None if obj.volume_error is None else enclosed(triangles).volume
    joined = merge(vertices, max_pieces, triangles, volume)
    pieces = tuple(
        Piece("mesh", (0.0, 0.0, 0.0), vertices=simplify(piece, max_vertices)) for piece in joined
    )
    return dataclasses.replace(obj, pieces=pieces)


def pieces(
    objects: pathlib.Path,
    hand: str = "human",
    counts: tuple[int, ...] = (8, 16, 32, 48),
    vertices: tuple[int, ...] = (32, 64),
    repeats: int = 5,
) -> int:
    """What convex pieces and their vertices cost a physics step (MuJoCo C), and what they gain in
    shape.

    Args:
      objects: Folder of objects or meshes; their pieces are joined to fewer for each budget.
      hand: The hand that closes around them.
      counts: Most pieces of an object; rates are compared with the first.
      vertices: Most vertices of a piece.
      repeats: Measurements of each, in turns; medians are printed.

    Examples:
      python -m tests.benchmarks pieces --objects my-objects
      python -m tests.benchmarks pieces --objects my-objects --counts 8 32 --vertices 32
    """
    loaded = objects_of(objects)
    task = TaskConfig(hand=hand)
    budgets = list(itertools.product(counts, vertices))
    variants = []
    scenes = []
    for count, limit in budgets:
        objects_of_budget = [coarser(obj, count, limit) for obj in loaded]
        variants.append(objects_of_budget)
        scenes.append([_closed_around(get_hand(hand), task, obj) for obj in objects_of_budget])
    rounds = []
    for _ in range(repeats):
        rounds.append([_timed(*scene, task) for scene in itertools.chain(*scenes)])
    seconds = np.array(rounds).reshape(repeats, len(budgets), len(loaded))
    per_step = np.median(seconds, axis=0).sum(-1) / (len(loaded) * _STEPS * task.substeps)
    table = Table(title=f"{len(loaded)} objects, {hand} hand, {repeats} repeats")
    for column in (
        "pieces",
        "vertices",
        "pieces used",
        "contacts",
        "surface error",
        "physics steps/s",
        "ratio",
    ):
        table.add_column(column, justify="right")
    for i, (p, v) in enumerate(budgets):
        used = np.mean([len(obj.pieces) for obj in variants[i]])
        contacts = np.mean([data.ncon for _, data in scenes[i]])
        error = np.mean([_error(obj) for obj in variants[i]])
        cost = [f"{1 / per_step[i]:,.0f}", f"{per_step[0] / per_step[i]:.2f}"]
        table.add_row(
            str(p), str(v), f"{used:.1f}", f"{contacts:.1f}", f"{1000 * error:.1f} mm", *cost
        )
    console = Console()
    console.print(table)
    console.print(_DEFINITION)
    return 0


def _closed_around(
    hand: Hand, task: TaskConfig, obj: GraspObject
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A scene without table in which the fingers have closed around the object, which stays between
    palm and tips.
    """
    model = compile_scene(hand, task, obj)
    where = addresses(model, hand)
    data = mujoco.MjData(model)
    model.body_pos[where.base_body] = 0.0
    data.qpos[where.finger_qpos] = hand.q_open
    data.mocap_pos[where.table_mocap] = TABLE_AWAY
    mujoco.mj_forward(model, data)
    tips = np.mean([data.body(hand.links[i].name).xpos for i in hand.tip_links], axis=0)
    middle = (tips + data.body(hand.links[0].name).xpos) / 2
    data.qpos[where.object_qpos] = [*middle, 1.0, 0.0, 0.0, 0.0]
    data.mocap_pos[where.anchor_mocap] = middle
    data.mocap_quat[where.anchor_mocap] = (1.0, 0.0, 0.0, 0.0)
    data.eq_active[where.weld] = 1
    data.ctrl[:6] = 0.0
    data.ctrl[6:] = motor_positions(hand, hand.q_closed)
    mujoco.mj_step(model, data, _CLOSING * task.substeps)
    return model, data


def _timed(model: mujoco.MjModel, data: mujoco.MjData, task: TaskConfig) -> float:
    """Seconds of this thread's processor time for the steps that are timed."""
    began = time.thread_time()
    mujoco.mj_step(model, data, _STEPS * task.substeps)
    return time.thread_time() - began


def _error(obj: GraspObject) -> float:
    """Distance of the pieces' surface from the mesh's, m."""
    triangles = obj.visual_vertices[obj.visual_faces].astype(float)
    closed = obj.volume_error is not None
    return fidelity(
        triangles, [np.asarray(piece.vertices) + piece.pos for piece in obj.pieces], closed
    ).surface
