"""Grasps for DexGraspBench, with the objects in the benchmark's layout.

The benchmark's files are pickles, which this project neither writes nor reads. This writes NPZ
files with the same names and shapes, which `examples/dexgraspbench.py` converts in the benchmark's
environment.
"""

import io
import json
import pathlib
from typing import Annotated, Any

import numpy as np
import tyro

from congrasp.common.errors import CongraspError
from congrasp.common.io.files import write_atomically
from congrasp.common.objects import shapes
from congrasp.services.cli.console import tracked
from tests.benchmarks.dexgraspbench_grasps import STATES, Grasp, read_grasps
from tests.benchmarks.dexgraspbench_replay import replayed, save_replay, summary

GRASPS = "graspdata"
OBJECTS = "object"
"""Folders of the output."""


def dexgraspbench(
    paths: Annotated[tuple[pathlib.Path, ...], tyro.conf.Positional],
    out: pathlib.Path = pathlib.Path("dexgraspbench"),
    replay: bool = False,
) -> int:
    """Pregrasp, grasp and squeeze of motions with their objects, for DexGraspBench's tests of
    Allegro and Shadow hands.

    Shadow hands are those imported from the benchmark's own file. The folder gets NPZ files with
    the benchmark's names, of which examples/dexgraspbench.py makes its pickles.

    Args:
      paths: Folders of 'congrasp grasp', its motions (.npz), or recordings (.mcap); those that are
        not held, or cannot be exported, are left out.
      out: The folder to write.
      replay: Also run the test here, in MuJoCo C: six pushes of 1 N without gravity, from the grasp
        and from the pregrasp; writes replay.json.

    Examples:
      python -m tests.benchmarks dexgraspbench grasps
      python -m tests.benchmarks dexgraspbench grasps/mug/grasp.npz --replay
    """
    if not paths:
        raise CongraspError(
            "No motion was given.", "Pass a folder or a motion (.npz) of 'congrasp grasp'."
        )
    if out.exists():
        raise CongraspError(f"{out} exists already.", "Remove it or pass another with --out.")
    with tracked() as track:
        grasps, left_out = read_grasps(paths, track("Reading", None))
        for grasp in grasps:
            write_grasp(grasp, out)
        replays = replayed(grasps, track("Replaying", len(grasps))) if replay else []
    for reason in left_out:
        print(f"Left out: {reason}")
    print(f"{out}: {len(grasps)} grasps")
    if replays:
        save_replay(out, replays)
        print(summary(replays))
    return 0


def write_grasp(grasp: Grasp, folder: pathlib.Path) -> None:
    """Writes a grasp and its object, which is laid out as by the benchmark's preprocessing.

    The grasp has `pregrasp_qpos`, `grasp_qpos`, `squeeze_qpos` (7 + F,): position (m) and
    quaternion (w, x, y, z) of the root in the world frame, and the joints (rad) in the order of
    `joint_names`; `obj_pose` (7,), likewise, of the frame of the object's file; `obj_scale` (), m
    per unit of that file; and `obj_path`, the object's folder.

    The object's files are in the frame and unit of its mesh: `mesh/simplified.obj`,
    `urdf/meshes/convex_piece_*.obj` and `info/simplified.json`.

    Raises:
      CongraspError: the folder cannot be written.
    """
    arrays: dict[str, Any] = {
        f"{name}_qpos": grasp.match.qpos(*grasp.states[name]) for name in STATES
    }
    position = grasp.object_position - grasp.object_rotation.apply(grasp.origin)
    arrays["obj_pose"] = np.concatenate(
        [position, grasp.object_rotation.as_quat(scalar_first=True)]
    )
    arrays |= {"obj_scale": np.array(grasp.scale), "obj_path": np.array(f"{OBJECTS}/{grasp.name}")}
    arrays |= {"joint_names": np.array(grasp.match.hand.joints), "hand": np.array(grasp.match.name)}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    write_atomically(folder / GRASPS / grasp.name / "congrasp" / "0.npz", buffer.getvalue())
    obj = grasp.obj
    origin = grasp.origin
    scale = grasp.scale
    home = folder / OBJECTS / grasp.name
    meshes = {"mesh/simplified.obj": (obj.visual_vertices, obj.visual_faces)}
    for number, piece in enumerate(obj.pieces):
        meshes[f"urdf/meshes/convex_piece_{number:03d}.obj"] = shapes.tessellate(piece)
    for name, (vertices, faces) in meshes.items():
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in ((vertices + origin) / scale).tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
        write_atomically(home / name, "\n".join([*lines, ""]).encode())
    info = {
        "gravity_center": (origin / scale).tolist(),
        "obb": (np.ptp(obj.visual_vertices, axis=0) / scale).tolist(),
        "scale": 1.0,
        "density": 1.0,
        "mass": sum(shapes.volume(piece) for piece in obj.pieces) / scale**3,
    }
    write_atomically(home / "info/simplified.json", json.dumps(info, indent=1).encode())
