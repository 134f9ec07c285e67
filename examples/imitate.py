"""Moves a human demonstration to other hands: its heading and affordance drive each hand's own
policy.

    python examples/imitate.py MyoHand_flashlight_on1.npz --meshes object_sim --affordance contacts
    --hand allegro sharpa

The demonstration provides the approach direction, the point between the fingers, and the parts of
the object that were touched; finger angles and the wrist's path, which belong to the human hand,
are not used.
"""

import dataclasses
import importlib
import pathlib
from typing import Literal

import numpy as np
import tyro

import congrasp
from congrasp.common.episode.episode import Episode
from congrasp.common.hands import get_hand
from congrasp.common.hands.mano import read_mano
from congrasp.common.objects.spec import GraspObject
from congrasp.common.wire.codec import Message
from congrasp.services.assets.captures.build import import_sets
from congrasp.services.assets.captures.options import Options
from congrasp.services.assets.captures.sequence import Meshes
from congrasp.services.viz.render import episode_strip
from congrasp.services.viz.sheets import contact_sheet, save_png

_FRAMES = 4


@dataclasses.dataclass
class Arguments:
    """Options of the example."""

    demonstration: tyro.conf.Positional[pathlib.Path]
    """A file or folder of the data set."""
    format: Literal["grab", "oakink", "dexycb", "myohand"] = "myohand"
    """The data set."""
    meshes: tuple[pathlib.Path, ...] = ()
    """Folders with the objects' meshes."""
    mano: pathlib.Path | None = None
    """Your MANO_RIGHT.pkl, where the data set needs it."""
    affordance: Literal["auto", "contacts", "none"] = "auto"
    """Graspable surface: the labelled parts that the demonstration touched, the surface near its
    contacts, or all.
    """
    hand: tuple[str, ...] = ("allegro", "sharpa")
    """Hands that imitate; objects are scaled for each."""
    policy: pathlib.Path | None = None
    """Policy file of the one hand, if none comes with the package."""
    out: pathlib.Path = pathlib.Path("imitated")
    """Folder for the results: a picture of each object, and a motion for each object and hand."""


def main(arguments: Arguments) -> None:
    """Extracts heading and affordance, grasps with each hand, and writes motions and a picture of
    each object.
    """
    model = read_mano(arguments.mano) if arguments.mano else None
    pictures: dict[str, tuple[list[np.ndarray], list[str]]] = {}
    for name in arguments.hand:
        reader = importlib.import_module(f"congrasp.services.assets.captures.{arguments.format}")
        sequences = reader.read(arguments.demonstration, Meshes(arguments.meshes), model)
        options = Options(headings="demonstrated", affordance=arguments.affordance, beyond=np.pi)
        objects, sets, report = import_sets(sequences, get_hand(name), options, arguments.format)
        for row in report.dropped:
            print(f"dropped: {row['sequence']}: {row['reason']}")
        for obj, constraints in zip(objects, sets, strict=True):
            episode = imitate(arguments, name, obj, constraints)
            result = "held" if episode.success else "not held"
            images, labels = pictures.setdefault(obj.name, ([], []))
            new = episode_strip(episode, _FRAMES, (360, 270), f"{name}: 0.00 s", f", {result}")
            images += new[0]
            labels += new[1]
    for name, (images, labels) in pictures.items():
        title = f"{name}: heading and affordance of a human demonstration"
        save_png(
            arguments.out / f"{name}.png",
            contact_sheet(images, labels, columns=_FRAMES, title=title),
        )


def imitate(arguments: Arguments, hand: str, obj: GraspObject, constraints: Message) -> Episode:
    """Grasps an object as its constraint set's first demonstration did; returns the episode."""
    fitting = obj.scaled(constraints.meta["object_scale"])
    done = congrasp.grasp(
        fitting,
        heading=constraints.arrays["heading/direction"][0, 0],
        at=constraints.arrays["heading/position"][0, 0] - fitting.origin,
        affordance=",".join(np.array(obj.part_names)[obj.graspable])
        if not obj.graspable.all()
        else "",
        hand=hand,
        policy=arguments.policy,
    )
    congrasp.save_motion(arguments.out / f"{obj.name}-{hand}.npz", done.motion)
    error = done.motion.metrics
    print(
        f"{obj.name}, {hand} hand: {'held' if done.success else 'not held'} ({done.held} of "
        f"{done.attempts} attempts); "
        f"heading off by {error['heading_rad']:.2f} rad and {100 * error['heading_m']:.1f} cm, "
        f"{error['affordance_ratio']:.0%} of the contacts outside of what the demonstration "
        f"touched."
    )
    return done.episode


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
