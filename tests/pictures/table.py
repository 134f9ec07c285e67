"""The pictures of the pages: how each is drawn."""

from collections.abc import Iterator
from typing import NamedTuple

from congrasp.services.evaluate.hand_records import Source, read_sources
from congrasp.services.evaluate.hand_tables import picture_name
from tests.benchmarks.gallery import SHOWN, command_of

_LIFTED = "--approach 0.7 --lift 0.12"
_MUG = f"examples/mug.obj --rest upright --affordance examples/handle.obj {_LIFTED}"
_BOTTLE = "object_sim/coffeemug --rest upright --approach 1 --lift 0.15"
_CAPTURE = "{captures}/MyoHand_flashlight_on1.npz --meshes {scans}"
_HANDS = {source.name: source for source in read_sources()}
"""Hands of others, by their names."""
_STUDIO = "python -m tests.benchmarks screens --run {run}"


class Picture(NamedTuple):
    """A picture of the pages.

    Commands run in a working folder of their own. They name external inputs in braces: `{scans}`,
    MyoSuite's `simhive/object_sim`; `{captures}`, a folder with its captured sequences; `{hands}`, a
    folder with the packages of hands of others; `{run}`, the folder of a finished training.
    """

    name: str
    """File, relative to its folder of docs."""
    command: str
    """Command lines that draw it, with `;` between several."""
    output: str
    """The file that the command writes, in the working folder."""
    policies: tuple[str, ...] = ("human",)
    """Shipped policies that it shows."""
    rendered: bool = True
    """True if the renderer draws it."""
    redrawn: bool = True
    """False for a curve of a past training, which stays."""


def _hand_import(hand: Source) -> str:
    """The command that imports a hand."""
    return f"{hand.import_command('{hands}')} --out {hand.name}.json"


_IMAGES = (
    Picture("portrait.png", f"congrasp grasp {_MUG} --out out", "out/mug/portrait.png"),
    Picture(
        "lift.png",
        "congrasp grasp mug:7 --rest upright --approach 0.7 --lift 0.15 --out out",
        "out/mug_7/grasp.png",
    ),
    Picture("rests.png", "congrasp objects rests mug:7 --png rests.png", "rests.png", ()),
    Picture(
        "household.png",
        "congrasp objects generate --families household --count 42 --out objects; "
        "congrasp objects list objects --png household.png",
        "household.png",
        (),
    ),
    Picture(
        "hands.png", "congrasp hands sheet human allegro sharpa --out hands.png", "hands.png", ()
    ),
    Picture("hand-check.png", "congrasp hands check allegro --png check.png", "check.png", ()),
    Picture(
        "hand-import.png",
        f"{_hand_import(_HANDS['shadow'])} --png hand.png",
        "hand.png",
        (),
    ),
    Picture(
        "hand-meshes.png",
        "; ".join(_hand_import(_HANDS[name]) for name in ("shadow", "schunk", "ability"))
        + "; congrasp hands sheet shadow.json schunk.json ability.json --out hands.png",
        "hands.png",
        (),
    ),
    Picture(
        "constraints.png",
        "python -m tests.pictures.composed constraints --gallery {gallery} --out constraints.png",
        "constraints.png",
    ),
    Picture(
        "robot-hands.png",
        f"congrasp grasp {_BOTTLE} --hand allegro --out allegro; "
        f"congrasp grasp {_BOTTLE} --hand sharpa --out sharpa; "
        "python -m tests.pictures.composed stack allegro/coffeemug/portrait.png "
        "sharpa/coffeemug/portrait.png --out robot-hands.png",
        "robot-hands.png",
        ("allegro", "sharpa"),
    ),
    Picture(
        "use-functional.png",
        f"congrasp constraints import myohand {_CAPTURE} --beyond 1.0 --headings demonstrated; "
        "congrasp grasp objects/flashlight.safetensors --pose "
        "constraints/flashlight.constraints.safetensors:0 --out functional",
        "functional/flashlight/grasp.png",
    ),
    Picture(
        "use-wrist.png",
        "python {root}/examples/wrist_completion.py {root}/examples/reach.bvh --mesh mug:7 "
        "--object-at 0 0 0.0318 --object-turn 0.7071 0.6493 0.28 -0.0003",
        "completed/grasp.png",
    ),
    Picture(
        "use-imitation.png",
        f"python {{root}}/examples/imitate.py {_CAPTURE} --affordance contacts --hand human allegro "
        "sharpa",
        "imitated/flashlight-MyoHand_flashlight_on1.png",
        ("human", "allegro", "sharpa"),
    ),
    *(
        Picture(name, f"{_STUDIO} --out .", name, rendered=False)
        for name in ("studio.png", "studio-motion.png", "studio-compare.png", "studio-phone.png")
    ),
    Picture("training-window.png", f"{_STUDIO} --out .", "training-window.png", (), rendered=False),
    Picture(
        "learning.png",
        "congrasp train --preset human --seed 1 (to 4); congrasp plot runs/*",
        "learning.png",
        (),
        rendered=False,
        redrawn=False,
    ),
    Picture(
        "fingers-learning.png",
        "congrasp train --preset human --run-dir runs/fingers --task.constraints heading affordance "
        "pose trajectory fingers",
        "fingers-learning.png",
        (),
        rendered=False,
        redrawn=False,
    ),
)


def hand_pictures() -> Iterator[Picture]:
    """Yields the pictures of the page about hands of others."""
    for hand in _HANDS.values():
        name = picture_name(hand.name)
        sheet = f"congrasp hands sheet {hand.name}.json --out sheet.png"
        small = f"python -m tests.pictures.composed shrink sheet.png --out {name}"
        yield Picture(name, f"{_hand_import(hand)}; {sheet}; {small}", name, ())


IMAGES = (*_IMAGES, *hand_pictures())
"""Pictures of docs/images."""


def gallery_pictures() -> Iterator[Picture]:
    """Yields the pictures and films of docs/gallery, which `tests.benchmarks.gallery` draws."""
    for entry in SHOWN:
        for suffix in (".jpg", ".gif"):
            if suffix == ".jpg" or entry.film:
                name = f"{entry.name}{suffix}"
                yield Picture(name, command_of(entry), "", (entry.hand,))


def table() -> dict[str, Picture]:
    """Every picture of the pages, by its path in the repository."""
    pictures = {f"docs/images/{picture.name}": picture for picture in IMAGES}
    pictures |= {f"docs/gallery/{picture.name}": picture for picture in gallery_pictures()}
    return pictures
