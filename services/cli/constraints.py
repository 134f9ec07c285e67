"""Constraint sets of objects: headings, reference poses and trajectories, generated as for
training, or captured.
"""

import dataclasses
import importlib
import json
import pathlib
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from congrasp.common.errors import CongraspError
from congrasp.common.hands import get_hand
from congrasp.common.hands.mano import own_mano_model
from congrasp.common.io.files import check_output, write_atomically
from congrasp.common.io.inputs import distinct_names
from congrasp.common.objects.store import Catalogue
from congrasp.services.assets.captures import IMPORTERS
from congrasp.services.cli.console import (
    bars,
    in_range,
    save_drawing,
    say,
    show_facts,
    show_table,
    tracked,
)

if TYPE_CHECKING:
    from congrasp.common.hands.spec import Hand
    from congrasp.common.objects.spec import GraspObject
    from congrasp.services.assets.captures.report import Report
    from congrasp.services.cli.console import Track

REPORT = "import.json"
"""File next to imported sets with the outcome of each sequence."""


@dataclasses.dataclass(frozen=True)
class Generate:
    """Generate the constraint sets of objects, one self-describing file each.

    For the whole surface and for the graspable region: 256 headings by the paper's rules, 20
    reference poses, and wrist trajectories that end at them, from 15 to 25 cm away, replayed
    through the wrist's controller. 80 % of them are for training, and the others are held out.

    Examples:
      congrasp constraints generate mug:7 box:0
      congrasp constraints generate my-objects --references policy
    """

    objects: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names in the folder of objects, object files or folders of them, meshes, or FAMILY:SEED such
    as mug:7.
    """
    count: int = 0
    """Number of additional procedural objects."""
    families: tuple[str, ...] = ()
    """Their families, in turn, or groups of them: basic (if none is named), household, all,
    scans.
    """
    first_seed: int = 0
    """Seed of the first of them; the others follow."""
    hand: str = "human"
    """Name of the hand, or its file."""
    references: Literal["closed", "policy"] = "closed"
    """closed: poses that close the hand around the object; policy: final states of a policy's
    grasps under headings, as in the paper."""
    policy: pathlib.Path | None = None
    """Policy file for its references; by default the hand's reference policy, which was trained
    without any.
    """
    folder: str = "objects"
    """Folder of objects."""
    out: pathlib.Path = pathlib.Path("constraints")
    """Folder for the files."""
    seed: int = 0
    """Seed of the constraints."""

    def __call__(self) -> int:
        """Generates the sets, and prints where they are."""
        from congrasp.common.objects.procedural import generate_many
        from congrasp.common.task.config import TaskConfig
        from congrasp.common.task.sampling.set_file import save
        from congrasp.common.task.sampling.sets import make_sets
        from congrasp.services.assets.objects.named import located, objects_of

        if not self.objects and self.count < 1:
            raise CongraspError(
                "There is no object for which to generate constraints.", "Pass objects, or --count."
            )
        hand = get_hand(self.hand)
        with tracked() as track:
            track("Preparing objects", None)
            found: list[GraspObject] = []
            for text in self.objects:
                found += objects_of(located(text, self.folder))
            found += generate_many(self.count, self.first_seed, self.families)
            for obj, name in zip(found, distinct_names(obj.name for obj in found), strict=True):
                if obj.name != name:
                    raise CongraspError(
                        f"Several of the objects are called '{obj.name}'.",
                        "Name each once; 'congrasp objects import A B --out DIR' gives different "
                        "ones different names.",
                    )
            bank = (
                _references(hand, self.policy, found, self.seed, track)
                if self.references == "policy"
                else None
            )
            track("Generating constraints", None)
            for constraints in make_sets(hand, TaskConfig(hand=hand.name), found, self.seed, bank):
                save(constraints, self.out)
        what = (
            "The constraint set of 1 object is"
            if len(found) == 1
            else f"The sets of {len(found)} objects are"
        )
        print(f"{what} in {self.out}.")
        return 0


def _references(
    hand: "Hand",
    policy: pathlib.Path | None,
    objects: "list[GraspObject]",
    seed: int,
    track: "Track",
) -> Any:
    """Returns constraints with references from a policy's grasps; prints their number."""
    from congrasp.common.policy import bundle as bundles
    from congrasp.common.policy.pretrained import policy_file, reference_file
    from congrasp.services.evaluate.experiment import Experiment

    bundle = bundles.load(policy or reference_file(hand.name) or policy_file(None, hand.name))
    if bundle.spec.hand_name != hand.name:
        raise CongraspError(
            f"The policy has the hand '{bundle.spec.hand_name}', not '{hand.name}'.",
            f"Pass --hand {bundle.spec.hand_name}.",
        )
    made = Experiment(bundle, objects, seed=seed, track=track).references_of(bundle)
    whole = made.grasps[:, 0]
    print(
        f"Grasps per object: {whole.min()} to {whole.max()}; where there is none, the hand is "
        f"closed around the object."
    )
    return made.bank


@dataclasses.dataclass(frozen=True)
class Import:
    """Make constraint sets of captured grasps by the paper's rules, and report what was dropped and
    why.

    From each sequence come a reference pose (the `human` hand's finger angles in the grasping
    frame) and a wrist trajectory to it of 15 waypoints, and, where the object's parts are labelled,
    those that may be touched. Only right hands are used. Objects are imported from the data set's
    meshes.

    Examples:
      congrasp constraints import grab GRAB/
      congrasp constraints import myohand data/ --meshes object_sim/
    """

    format: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar=f"{{{','.join(IMPORTERS)}}}")
    ]
    """Data set of the files."""
    path: Annotated[pathlib.Path, tyro.conf.Positional]
    """The data set's folder, or one of its files."""
    meshes: tuple[pathlib.Path, ...] = ()
    """Folders with the objects' meshes, if they are not in the data set."""
    mano: pathlib.Path | None = None
    """Your MANO_RIGHT.pkl, or CONGRASP_MANO; dexycb needs it, and grab and oakink are more exact
    with it.
    """
    hand: str = "human"
    """Hand of the sets. Human finger angles do not fit another hand: it follows the captured wrist
    by its grasp axes, with the captured headings and affordance, and closes its fingers around the
    object at the end."""
    headings: Literal["sampled", "demonstrated"] = "sampled"
    """sampled: 256 an object by the paper's rules; demonstrated: those of the captured grasps."""
    affordance: Literal["auto", "parts", "contacts", "none"] = "auto"
    """Graspable are parts that fingers touch; whatever they touch; or everything. auto: parts where
    they are labelled."""
    beyond: float = 0.1
    """Radians by which a captured joint may exceed the human hand's limits; it is then clamped. Not
    used for other hands."""
    out: pathlib.Path = pathlib.Path("constraints")
    """Folder for the sets, and for import.json, which holds the outcome of each sequence."""
    objects: pathlib.Path = pathlib.Path("objects")
    """Folder for the objects."""
    seed: int = 0
    """Seed of sampled headings and of the split into training and held-out."""

    def __call__(self) -> int:
        """Imports the sets, and prints what was dropped."""
        from congrasp.common.task.sampling.set_file import save
        from congrasp.services.assets.captures.build import import_sets
        from congrasp.services.assets.captures.options import Options
        from congrasp.services.assets.captures.sequence import Meshes

        if self.format not in IMPORTERS:
            raise CongraspError(
                f"There is no format '{self.format}'.", f"Choose one of: {', '.join(IMPORTERS)}."
            )
        if not self.path.exists():
            raise CongraspError(
                f"There is no file or folder {self.path}.", "Pass the data set's folder."
            )
        in_range(0.0, unit="radians", beyond=self.beyond)
        check_output("--objects", self.objects, is_folder=True)
        hand, options = (
            get_hand(self.hand),
            Options(self.headings, self.affordance, self.beyond, seed=self.seed),
        )
        importer = importlib.import_module(IMPORTERS[self.format])
        with bars() as progress:
            task = progress.add_task("Reading", total=None)
            sequences = importer.read(self.path, Meshes(self.meshes), own_mano_model(self.mano))
            objects, sets, report = import_sets(
                sequences,
                hand,
                options,
                self.format,
                lambda doing: progress.update(task, description=doing, advance=1),
            )
        if not report.kept and not report.dropped:
            raise CongraspError(
                f"{self.path} holds no sequence of {self.format}.",
                f"Pass the folder with {importer.HOLDS}.",
            )
        catalogue = Catalogue(self.objects)
        for obj, made in zip(objects, sets, strict=True):
            catalogue.add(obj)
            save(made, self.out)
        about = {
            "format": self.format,
            "path": str(self.path),
            "hand": hand.name,
            **dataclasses.asdict(options),
        }
        rows = {**about, "kept": report.kept, "dropped": report.dropped}
        write_atomically(self.out / REPORT, json.dumps(rows, indent=2).encode())
        _print_report(report, hand.name, self.out, self.objects)
        return 0 if report.kept else 2


def _print_report(report: "Report", hand: str, out: pathlib.Path, objects: pathlib.Path) -> None:
    """Prints what was kept, what each rule dropped, and the locations of the results."""
    kept, dropped = report.kept, report.dropped
    say(f"{len(kept)} of {len(kept) + len(dropped)} sequences kept.")
    if dropped:
        show_table(
            ("dropped", "why", "for example"),
            [(str(n), rule, example) for rule, n, example in report.rules()],
        )
    if kept and hand != "human":
        say(
            f"A human's finger angles do not fit the hand '{hand}' and were dropped. Heading, "
            f"affordance and wrist "
            "trajectory were kept; its fingers close around the object where the trajectory ends."
        )
    elif kept:
        worst = max(kept, key=lambda row: row["residual_rad"])
        mean = sum(row["residual_rad"] for row in kept) / len(kept)
        say(
            f"Finger angles differ by {mean:.3f} rad per bone on average, at most "
            f"{worst['residual_rad']:.3f} rad "
            f"({worst['sequence']})."
        )
    if kept:
        if apart := [row for row in kept if row["moved_apart_rad"]]:
            deep, moved = (
                max(apart, key=lambda row: row[name]) for name in ("overlap_m", "moved_apart_rad")
            )
            mean = sum(row["moved_apart_rad"] for row in apart) / len(apart)
            say(
                f"Fingers of {len(apart)} overlapped, by up to {1e3 * deep['overlap_m']:.1f} mm "
                f"({deep['sequence']}). They were separated: their farthest joint by {mean:.2f} "
                f"rad on average, "
                f"at most {moved['moved_apart_rad']:.2f} rad ({moved['sequence']})."
            )
        if later := [row["frames_after_touch"] for row in kept if row["frames_after_touch"]]:
            say(
                f"In {len(later)} of {len(kept)}, thumb and fingers oppose only after the first "
                f"touch; the "
                f"reference is taken then, {sum(later) / len(later):.0f} frames later on average."
            )
        above = sum(row["clear_of_table"] for row in kept)
        sets = len({row["object"] for row in kept})
        say(
            f"The table leaves room for {above} of {len(kept)} in some resting pose of their "
            f"objects."
        )
        for below, why in (
            (True, "from below, which no episode does"),
            (False, "too near to the table"),
        ):
            left = [
                row["sequence"]
                for row in kept
                if not row["clear_of_table"] and row["from_below"] == below
            ]
            if left:
                say(
                    f"No episode is drawn from {len(left)}, whose hand comes {why}: "
                    f"{', '.join(left)}."
                )
        training = sum(row["split"] == "training" for row in kept)
        say(f"{training} sequences are for training, {len(kept) - training} held out.")
        say(f"Constraint sets ({sets}) are in {out}, their objects in {objects}.")
    say(f"{out / REPORT} holds the outcome of each sequence.")


def show(
    file: Annotated[pathlib.Path, tyro.conf.Positional],
    png: pathlib.Path | None = None,
    rest: int = 0,
    seed: int = 0,
) -> int:
    """Print the content of a constraint set, and draw some of it.

    Args:
      file: A file of 'congrasp constraints generate' or 'import'.
      png: Picture to write: headings, affordance, trajectories and reference poses.
      rest: Resting pose of the picture, from 1; 0 uses the one with the most poses.
      seed: Seed of the drawn selection.

    Examples:
      congrasp constraints show sets/mug_7.constraints.safetensors
      congrasp constraints show sets/mug_7.constraints.safetensors --png mug.png --rest 2
    """
    from congrasp.common.task.sampling.set_description import describe
    from congrasp.common.task.sampling.set_file import load

    constraints = load(file)
    in_range(0, len(constraints.arrays["rest"]), rest=rest)
    show_facts(describe(constraints))
    if png is not None:
        from congrasp.services.viz.constraint_sheet import constraint_sheet

        best = int(constraints.arrays["pose/allowed"].sum((0, 2)).argmax())
        save_drawing(png, constraint_sheet(constraints, rest - 1 if rest else best, seed))
    return 0


COMMANDS = {"generate": Generate, "import": Import, "show": show}
