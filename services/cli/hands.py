"""Available hands, pictures of them, and custom hands."""

import dataclasses
import pathlib
import shlex
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import tyro

from congrasp.actors.physics import PhysicsName
from congrasp.common.errors import CongraspError
from congrasp.common.hands import (
    HANDS,
    SUFFIX,
    get_hand,
    hands_folder,
    own_hands,
    right_name,
)
from congrasp.common.hands.files import hand_sha256, hand_text
from congrasp.common.hands.meshes import load_meshes, save_meshes
from congrasp.common.io.files import check_output, write_atomically
from congrasp.common.runtime.resources import cores
from congrasp.common.shell import shell_command
from congrasp.services.cli.console import in_range, say, show_table
from congrasp.services.ops.logs import announce_progress

if TYPE_CHECKING:
    from congrasp.common.hands.skin import Skin
    from congrasp.common.hands.spec import Hand
    from congrasp.services.assets.hands.model_files import Choices, Proposal

_TRAININGS = pathlib.Path("runs", "hands")
"""Folder of the trainings of hands."""


class _ReportSize(NamedTuple):
    """Default size of the evaluation of a trained hand."""

    episodes: int
    """Episodes of each row."""
    objects: int


_GPU_REPORT = _ReportSize(episodes=200, objects=64)
_CPU_REPORT = _ReportSize(episodes=24, objects=12)


def list_hands() -> int:
    """List the hands: those of the package and your own, with joints, masses and available
    policies.

    Examples:
      congrasp hands list
    """
    rows = []
    errors = []
    for name in [*HANDS, *own_hands()]:
        try:
            hand = get_hand(name)
        except CongraspError as error:
            errors.append(str(error))
            continue
        row = (
            name,
            str(len(hand.joints)),
            str(len(hand.tip_links)),
            f"{sum(link.mass for link in hand.links):.2f} kg",
            f"{max(motor.torque_limit for motor in hand.motors):.1f} N.m",
            f"x {hand.object_scale:g}",
            _policy_kind(name),
        )
        rows.append(row)
    show_table(("hand", "joints", "fingers", "mass", "torque", "objects", "policy"), rows)
    print("\n".join([*errors, f"Custom hands are the files in {hands_folder()}."]))
    return 0


def _policy_kind(hand: str) -> str:
    """Origin of the policy that commands use for a hand: the package, or the user's folder."""
    from congrasp.common.policy.pretrained import pretrained_file

    file = pretrained_file(hand)
    if file is None:
        return "none"
    return "own" if file.parent == hands_folder() else "pretrained"


def sheet(
    hands: Annotated[tuple[str, ...], tyro.conf.Positional] = ("human", "allegro", "sharpa"),
    out: pathlib.Path = pathlib.Path("hands.png"),
) -> int:
    """Draw hands open, half closed and closed, with their grasp frames. Custom hands are drawn with
    the visual meshes of their files, if there are any.

    Args:
      hands: Names of hands, or hand files.
      out: The PNG file to write, with a row for each hand.

    Examples:
      congrasp hands sheet human
      congrasp hands sheet allegro sharpa --out robot-hands.png
    """
    from congrasp.services.viz import hand_sheets
    from congrasp.services.viz.sheets import save_png

    specs = [get_hand(name) for name in hands]
    skins = [_skin(name, hand) for name, hand in zip(hands, specs, strict=True)]
    save_png(out, hand_sheets.hands_sheet(specs, skins))
    print(out)
    return 0


def _skin(name: str, hand: "Hand") -> "Skin | None":
    """Skin of the meshes next to a custom hand's file; None if it has none."""
    from congrasp.common.hands.skin import skin_of_meshes

    if not hand.text:
        return None
    file = own_hands().get(name, pathlib.Path(name))
    meshes = load_meshes(file, hand)
    if not meshes:
        return None
    return skin_of_meshes(hand, meshes)


@dataclasses.dataclass(frozen=True)
class Import:
    """Import a hand from a URDF or MJCF file: missing values are proposed, listed and drawn.

    The result is one JSON file, with the visual meshes next to it. Every command takes the name or
    the path of this file as --hand. Check the picture. If a proposed value is wrong, correct it in
    the file, which contains all poses, fingertips, gains, couplings and capsules.

    Examples:
      congrasp hands import hand.urdf
      congrasp hands import hand.xml --name mine --palm palm_link
    """

    file: Annotated[pathlib.Path, tyro.conf.Positional]
    """URDF or MJCF file of a right or left hand with hinge joints."""
    name: str = ""
    """Name of the hand; by default the name of the file."""
    palm: str = ""
    """Body of the palm; by default the body from which most fingers branch."""
    thumb: str = ""
    """Last body of the thumb, the finger that opposes the others; by default a body called thumb,
    or else the last body of the finger that best faces the others."""
    object_scale: float = 0.0
    """Factor on the size of the objects in training. By default it follows from the opening of the
    hand, and is 1 for a human hand."""
    collision: Literal["capsules", "own"] = "capsules"
    """Collision shapes in physics. capsules: fitted capsules; own: the boxes, cylinders, spheres,
    ellipsoids and capsules of the file, and fitted capsules for links that have collision
    meshes."""
    out: pathlib.Path | None = None
    """JSON file to write; by default NAME.json in the folder of your own hands ('congrasp hands
    list' prints this folder)."""
    png: pathlib.Path | None = None
    """PNG file to write; by default next to the JSON file."""
    json: Annotated[pathlib.Path | None, tyro.conf.arg(name="json")] = None
    """Also write what was imported, with the notes, to this JSON file."""

    def __call__(self) -> int:
        """Writes the hand's file and picture, and prints how to train it."""
        from congrasp.services.assets.hands.model_files import Choices, import_hand

        self._check_out()
        choices = Choices(
            self.name, self.palm, self.thumb, self.object_scale, self.collision == "own"
        )
        with announce_progress(f"Reading {self.file}"):
            proposal = import_hand(self.file, choices)
        _store(proposal, self.out, self.png)
        if self.json is not None:
            _write_record(self.json, proposal)
        reference = proposal.hand.name if self.out is None else self.out
        one_hand = shell_command("congrasp", "hands", "train", reference)
        any_hand = shell_command("congrasp", "train", "--hand", reference, "--physics", "native")
        print(f"Try: {one_hand}, or {any_hand}")
        return 0

    def _check_out(self) -> None:
        """Raises a CongraspError for a file or folder that cannot be written."""
        if self.out is None:
            check_output("--out", hands_folder(), is_folder=True)
            return
        check_output("--out", self.out, is_folder=False)
        if self.out.suffix != SUFFIX:
            raise CongraspError(
                f"--out {self.out} does not end in {SUFFIX}.", "Hand files are JSON."
            )


def _store(
    proposal: "Proposal", out: pathlib.Path | None = None, png: pathlib.Path | None = None
) -> None:
    """Writes a hand's file and picture, and prints a description.

    Args:
      proposal: the imported hand.
      out: the file; by default in the folder of custom hands.
      png: the picture; by default next to the file.
    """
    from congrasp.services.assets.hands.summary import describe
    from congrasp.services.viz import hand_sheets
    from congrasp.services.viz.sheets import save_png

    hand = proposal.hand
    is_hidden = out is None and right_name(hand.name)[0] in HANDS  # names of left hands, too
    if hand.name in HANDS or is_hidden:
        raise CongraspError(
            f"'{hand.name}' is the name of a hand of congrasp.", "Pass another --name."
        )
    path = out or hands_folder() / f"{hand.name}{SUFFIX}"
    if path.exists():
        say(
            f"The file {path} of an earlier import is replaced (to keep it, pass another --name or "
            "--out)."
        )
    write_atomically(path, hand_text(hand).encode())
    save_meshes(path, proposal.meshes)
    get_hand.cache_clear()
    picture = png or path.with_suffix(".png")
    save_png(picture, hand_sheets.joints_sheet(hand))
    say(*describe(proposal), "", path, picture)


def _write_record(file: pathlib.Path, proposal: "Proposal") -> None:
    """Writes the record of an import."""
    from congrasp.services.assets.hands.import_record import write_import
    from congrasp.services.evaluate.results import provenance

    write_import(file, proposal, provenance())


def check(
    hand: Annotated[str, tyro.conf.Positional],
    png: pathlib.Path | None = None,
    json: Annotated[pathlib.Path | None, tyro.conf.arg(name="json")] = None,
) -> int:
    """Check before training if a hand can grasp at all. The output has one line for each check,
    with a remedy.

    Palm, joints, opening and strength are measured. Servos, overlaps of links, and grips of a ball,
    a cylinder and a box, which are lifted and pushed, are simulated. The picture shows the grips
    and every joint. The exit code is 1 if a check failed. A doubtful result is not a failure, since
    it may be intended.

    Args:
      hand: Name or file of a hand.
      png: PNG file to write; by default NAME-check.png.
      json: JSON file to which the results of the checks are also written.

    Examples:
      congrasp hands check allegro
      congrasp hands check my_hand --png check.png --json check.json
    """
    from congrasp.services.assets.hands import check as self_check
    from congrasp.services.assets.hands.findings import write_findings
    from congrasp.services.evaluate.results import provenance
    from congrasp.services.train.presets import recipe
    from congrasp.services.viz import hand_sheets
    from congrasp.services.viz.sheets import save_png

    spec = get_hand(hand)
    picture = png or pathlib.Path(f"{spec.name}-check.png")
    check_output("--png", picture, is_folder=False)
    result = self_check.check_hand(spec, recipe(spec).task, cores())
    for finding in result.findings:
        print(finding)
    save_png(picture, hand_sheets.check_sheet(spec, result.grips))
    if json is not None:
        about = {**provenance(), "hand": spec.name, "hand_sha256": hand_sha256(spec)}
        write_findings(json, result.findings, about)
    print(picture)
    return int(result.failed)


@dataclasses.dataclass(frozen=True)
class Train:
    """Make a policy and a report for the hand of a URDF or MJCF file: import, self-check, training
    and evaluation.

    On a GPU this trains the full task with the recipe for all hands. Afterwards grasp, serve,
    evaluate and view use the policy with --hand NAME. Without a GPU the training is short, and its
    task is easier. The command stops if the self-check fails. Repeat an interrupted command to
    resume it.

    Examples:
      congrasp hands train my_hand.urdf
      congrasp hands train my_hand --training="--updates 900"
    """

    hand: Annotated[str, tyro.conf.Positional]
    """URDF or MJCF file of the hand, or the name or JSON file of an imported hand. A URDF or MJCF
    file is imported unless a custom hand of the same name exists."""
    name: str = ""
    """Name of the hand, as in 'congrasp hands import'."""
    palm: str = ""
    """Body of the palm, as in 'congrasp hands import'."""
    thumb: str = ""
    """Last body of the thumb, as in 'congrasp hands import'."""
    object_scale: float = 0.0
    """Factor on the size of the objects, as in 'congrasp hands import'."""
    out: pathlib.Path | None = None
    """Folder for the self-check, the run and the report; runs/hands/NAME by default."""
    anyway: bool = False
    """Train the hand even if its self-check fails."""
    physics: PhysicsName = "auto"
    """Physics engine of the full task and of the evaluation."""
    episodes: int = 0
    """Number of episodes per row of the report; 0 uses 200, or 24 without a GPU."""
    pool: int = 0
    """Number of objects of the report; 0 uses 64, or 12 without a GPU."""
    training: str = ""
    """Further options of 'congrasp train', as one string."""
    patience: int = 240
    """Minutes after which the training is stopped. The next 'congrasp hands train' resumes it.
    """

    def __call__(self) -> int:
        """Imports, checks, trains and evaluates."""
        import jax

        from congrasp.services.assets.hands.model_files import Choices
        from congrasp.services.train import accelerators
        from congrasp.services.train.own_hand import Request, train_hand

        in_range(0, episodes=self.episodes, pool=self.pool)
        in_range(1, patience=self.patience)
        check_output("--out", self.out or _TRAININGS, is_folder=True)
        platform, *_ = accelerators.detect()
        full = platform != "cpu"
        # The stages are separate processes, to which this one leaves the memory of the GPU.
        jax.config.update("jax_platforms", "cpu")
        choices = Choices(self.name, self.palm, self.thumb, self.object_scale)
        reference = _imported(self.hand, choices)
        hand = get_hand(reference)
        size = _GPU_REPORT if full else _CPU_REPORT
        request = Request(
            hand=hand,
            reference=reference,
            out=self.out or _TRAININGS / hand.name,
            full=full,
            anyway=self.anyway,
            physics=self.physics,
            episodes=self.episodes or size.episodes,
            pool=self.pool or size.objects,
            options=shlex.split(self.training),
            patience=60.0 * self.patience,
        )
        train_hand(request, lambda text: print(text, flush=True))
        print(f"Try: congrasp grasp mug:7 --hand {reference}")
        return 0


def _imported(hand: str, choices: "Choices") -> str:
    """Returns the name or file of a hand for other commands; imports a URDF or MJCF, unless there
    is a custom hand of its name.
    """
    from congrasp.services.assets.hands.model_files import import_hand

    file = pathlib.Path(hand)
    if not file.is_file() or file.suffix == SUFFIX:
        return hand
    proposal = import_hand(file, choices)
    name = proposal.hand.name
    existing = own_hands().get(name)
    if existing is not None:
        print(
            f"Using the existing hand '{name}' ({existing}); 'congrasp hands import' replaces it."
        )
    else:
        _store(proposal)
    return name


COMMANDS = {
    "list": list_hands,
    "sheet": sheet,
    "import": Import,
    "check": check,
    "train": Train,
}
