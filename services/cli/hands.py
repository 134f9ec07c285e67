"""`congrasp hands`: the hands there are, pictures of them, and hands of one's own."""

import pathlib
from typing import Annotated

import tyro


def list_hands() -> int:
    """List the hands: those of the package and your own, with joints, masses and whether a policy comes with them."""

    from common.errors import CongraspError
    from common.hands import HANDS, get_hand, hands_folder, own_hands
    from common.policy.pretrained import pretrained_file
    from services.cli.console import show_table

    rows, missing = [], []
    own = own_hands()
    for name in [*HANDS, *own]:
        try:
            hand = get_hand(name)
        except CongraspError as error:
            missing.append(str(error))
            continue
        row = (
            name,
            str(len(hand.joints)),
            str(len(hand.tip_links)),
            f"{sum(link.mass for link in hand.links):.2f} kg",
            f"{max(motor.torque_limit for motor in hand.motors):.1f} N.m",
            f"x {hand.object_scale:g}",
            "pretrained" if pretrained_file(name) else "none",
        )
        rows.append(row)
    show_table(("hand", "joints", "fingers", "mass", "torque", "objects", "policy"), rows)
    print("\n".join([*missing, f"Your own hands are the files in {hands_folder()}."]))
    return 0


def sheet(
    hands: Annotated[tuple[str, ...], tyro.conf.Positional] = ("human", "allegro", "sharpa"),
    out: pathlib.Path = pathlib.Path("hands.png"),
) -> int:
    """Draw hands open, half closed and closed, with their grasp frames, as their files drew them where they did.

    Args:
      hands: Names of hands, or hand files.
      out: The PNG file to write; with several hands, one beside another.
    """
    from common.hands import get_hand, own_hands
    from services.assets.hands.visual import load_meshes
    from services.viz.hand_sheets import hands_sheet
    from services.viz.sheets import save_png

    found = [get_hand(name) for name in hands]
    files = [own_hands().get(name, pathlib.Path(name)) for name in hands]
    meshes = [load_meshes(file, hand) if hand.text else {} for file, hand in zip(files, found, strict=True)]
    save_png(out, hands_sheet(found, meshes))
    print(out)
    return 0


def import_hand(
    file: Annotated[pathlib.Path, tyro.conf.Positional],
    name: str = "",
    palm: str = "",
    thumb: str = "",
    object_scale: float = 0.0,
    out: pathlib.Path | None = None,
    png: pathlib.Path | None = None,
) -> int:
    """Make a hand of a URDF or MJCF file: what the file does not say is proposed, said and drawn.

    The result is one JSON file, which every command takes as --hand, by its name or its path; what the file draws of
    the hand is kept beside it. Look at the picture, and correct the file where the proposal is wrong: poses,
    fingertips, gains, couplings and capsules are all in it.

    Examples: congrasp hands import hand.urdf; congrasp hands import hand.xml --name mine --palm palm_link

    Args:
      file: The hand's URDF (.urdf) or MJCF (.xml), a right or left hand of hinges.
      name: Its name; that of the file by default.
      palm: The body that is the palm; by default the one off which most fingers branch.
      thumb: The last body of the finger that opposes the others;
        by default one called thumb, or the one that best faces the others.
      object_scale: Factor on the objects that it learns to grasp; by default from its opening, 1 for a human hand's.
      out: The file to write; by default NAME.json in the folder of your own hands ('congrasp hands list' names it).
      png: The picture; by default beside the file.
    """
    from common.errors import CongraspError
    from common.files import write_atomically
    from common.hands import HANDS, SUFFIX, get_hand, hands_folder
    from common.hands.files import hand_text
    from services.assets.hands.model_files import Choices, describe
    from services.assets.hands.model_files import import_hand as proposed
    from services.assets.hands.visual import save_meshes
    from services.viz.hand_sheets import joints_sheet
    from services.viz.sheets import save_png

    proposal = proposed(file, Choices(name, palm, thumb, object_scale))
    hand = proposal.hand
    if hand.name in HANDS:
        raise CongraspError(f"'{hand.name}' is a hand of congrasp.", "Give yours another --name.")
    if out is not None and out.suffix != SUFFIX:
        raise CongraspError(f"--out {out} does not end in {SUFFIX}.", "Hand files are JSON.")
    path = out or hands_folder() / f"{hand.name}{SUFFIX}"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, hand_text(hand).encode())
    save_meshes(path, proposal.meshes)
    get_hand.cache_clear()
    picture = png or path.with_suffix(".png")
    save_png(picture, joints_sheet(hand))
    for line in describe(proposal):
        print(line)
    print(f"\n{path}\n{picture}")
    called = hand.name if out is None else path
    print(f"Try: congrasp train --hand {called} --physics native")
    return 0


COMMANDS = {"list": list_hands, "sheet": sheet, "import": import_hand}
