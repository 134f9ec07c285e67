"""Completes a wrist's path with finger motions: a whole-body motion moves the hand, congrasp makes
it grasp.

    python examples/wrist_completion.py examples/reach.bvh --mesh mug:7 --object-at -0.03 0 0.05
    --out completed

The motion is a CSV, NPZ or BVH file in a world with the object in it; of a BVH skeleton one joint
is the wrist. The path is cut as captured ones are (from at most 20 cm) and ends where the wrist is
nearest to the object.
"""

import dataclasses
import pathlib

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

import congrasp
from congrasp.common.hands import get_hand
from congrasp.services.assets.captures.approach import approach
from congrasp.services.assets.captures.references import follow_human_wrist
from congrasp.services.assets.captures.surface import Surface
from congrasp.services.assets.objects.named import find_object
from congrasp.services.grasp.wrist_paths import read_wrist_path
from congrasp.services.viz.render import episode_sheet
from congrasp.services.viz.sheets import save_png


@dataclasses.dataclass
class Arguments:
    """Options of the example."""

    motion: tyro.conf.Positional[pathlib.Path]
    """The motion: CSV, NPZ or BVH."""
    mesh: str = "mug:7"
    """The object: a mesh, an object file, or FAMILY:SEED."""
    object_at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the file's origin in the motion's world, m, z up."""
    object_turn: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation of the file's frame in the motion's world, quaternion w x y z."""
    joint: str = "RightHand"
    """Joint of a BVH skeleton that is the wrist."""
    fingers: str = "-y"
    """Axis of that joint along which the fingers point."""
    back: str = "+z"
    """Axis of that joint towards the back of the hand."""
    hand: str = "human"
    """Hand whose pretrained policy is used; any but the human one follows the wrist by its own
    grasp axes.
    """
    policy: pathlib.Path | None = None
    """A policy file to use instead of the pretrained policy."""
    out: pathlib.Path = pathlib.Path("completed")
    """Folder for the results."""


def main(arguments: Arguments) -> None:
    """Cuts the path, grasps, and writes the motion and its picture."""
    obj = find_object(arguments.mesh)
    path = read_wrist_path(
        arguments.motion, joint=arguments.joint, fingers=arguments.fingers, back=arguments.back
    )
    position, rotation = follow_human_wrist(get_hand(arguments.hand), path.position, path.rotation)
    turn = Rotation.from_quat(arguments.object_turn, scalar_first=True).inv()
    in_file, rotation = turn.apply(position - arguments.object_at), turn * rotation
    far = Surface(obj).distance(in_file + obj.origin)
    frame = int(far.argmin())
    seen = np.ones(len(far), bool)
    start, waypoints, turns = approach(
        arguments.motion.stem, in_file, rotation.as_matrix(), far, seen, frame, 15
    )
    arguments.out.mkdir(parents=True, exist_ok=True)
    # In the coordinates of the object's file, as congrasp grasp takes it
    table = arguments.out / "wrist.csv"
    np.savetxt(
        table,
        np.concatenate([waypoints, turns], 1),
        delimiter=",",
        header="x, y, z, qw, qx, qy, qz",
    )
    done = congrasp.grasp(obj, trajectory=str(table), hand=arguments.hand, policy=arguments.policy)
    congrasp.save_motion(arguments.out / "grasp.npz", done.motion)
    save_png(arguments.out / "grasp.png", episode_sheet(done.episode))
    error = done.motion.metrics
    print(
        f"frames {start} to {frame} of {len(far)}: {obj.name} is "
        f"{'held' if done.success else 'not held'} "
        f"({done.held} of {done.attempts} attempts); the wrist is off by "
        f"{100 * error['trajectory_m']:.1f} cm and "
        f"{error['trajectory_rad']:.2f} rad. Everything is in {arguments.out}."
    )


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
