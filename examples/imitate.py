"""Moves a human demonstration to another hand: its heading and affordance drive that hand's own policy.

    python examples/imitate.py MyoHand_hammer_use1.npz --meshes objects --hand human --out imitated

From the demonstration come the way the hand approached, the point between the fingers, and what of the object it
touched; finger angles and the wrist's path, which belong to the human hand, do not count.
"""

import dataclasses
import importlib
import pathlib
from typing import Literal

import numpy as np
import tyro

from common.hands import get_hand
from common.hands.mano import read_mano
from common.logs.motion import save_motion
from services.grasping.grasp import grasp
from services.importers.build import Options, import_sets
from services.importers.objects import Meshes
from services.pictures.render import episode_sheet
from services.pictures.sheets import save_png


@dataclasses.dataclass
class Arguments:
    """What is imitated, and by whom."""

    demonstration: tyro.conf.Positional[pathlib.Path]
    """A file or folder of the data set."""
    format: Literal["grab", "oakink", "dexycb", "myohand"] = "myohand"
    """The data set."""
    meshes: tuple[pathlib.Path, ...] = ()
    """Folders with the objects' meshes."""
    mano: pathlib.Path | None = None
    """Your MANO_RIGHT.pkl, where the data set needs it."""
    affordance: Literal["auto", "contacts", "none"] = "auto"
    """What may be touched: labelled parts that the demonstration touched, or whatever is near to where it touched."""
    hand: str = "human"
    """Hand that imitates; objects are scaled for it."""
    policy: pathlib.Path | None = None
    """Its policy file, if none comes with the package."""
    out: pathlib.Path = pathlib.Path("imitated")
    """Folder for the results."""


def main(arguments: Arguments) -> None:
    """Extracts heading and affordance, grasps with the other hand, and writes motion and picture."""
    hand = get_hand(arguments.hand)
    reader = importlib.import_module(f"services.importers.{arguments.format}")
    model = read_mano(arguments.mano) if arguments.mano else None
    sequences = reader.read(arguments.demonstration, Meshes(arguments.meshes), model)
    options = Options(headings="demonstrated", affordance=arguments.affordance, beyond=np.pi)
    objects, sets, report = import_sets(sequences, hand, options, arguments.format)
    for row in report.dropped:
        print(f"dropped: {row['sequence']}: {row['reason']}")
    for obj, constraints in zip(objects, sets, strict=True):
        fitting = obj.scaled(constraints.meta["object_scale"])
        heading = constraints.arrays["heading/direction"][0, 0]
        at = constraints.arrays["heading/position"][0, 0] - fitting.origin
        done = grasp(
            fitting,
            heading=" ".join(map(str, heading)),
            at=" ".join(map(str, at)),
            affordance=",".join(np.array(obj.part_names)[obj.graspable]) if not obj.graspable.all() else "",
            hand=arguments.hand,
            policy=arguments.policy,
        )
        folder = arguments.out / obj.name
        folder.mkdir(parents=True, exist_ok=True)
        save_motion(folder / "grasp.npz", done.motion)
        save_png(folder / "grasp.png", episode_sheet(done.episode))
        error = done.motion.metrics
        print(
            f"{obj.name}, {hand.name} hand: {'held' if done.success else 'not held'} ({done.held} of {done.tries} "
            f"tries); heading off by {error['heading_rad']:.2f} rad and {100 * error['heading_m']:.1f} cm, "
            f"{error['affordance_ratio']:.0%} of the contacts outside of what the demonstration touched."
        )


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
