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
from congrasp.services.cli.capture_report import REPORT, print_report
from congrasp.services.cli.console import bars, in_range, save_drawing, show_facts, tracked

if TYPE_CHECKING:
    from congrasp.common.hands.spec import Hand
    from congrasp.common.objects.spec import GraspObject
    from congrasp.services.assets.captures.options import Options
    from congrasp.services.assets.captures.report import Report
    from congrasp.services.cli.console import Track


@dataclasses.dataclass(frozen=True)
class Generate:
    """Generate constraint sets, one self-describing file for each object.

    A set has, for the whole surface and again for the graspable region, 256 headings by the paper's
    rules, 20 reference poses, and wrist trajectories. A trajectory begins 15 to 25 cm away from a
    reference pose, ends at it, and is replayed through the wrist's controller. 80 % of the
    constraints are for training, and the others are held out.

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
    """Families of the procedural objects, which are used in turn, or groups of families: basic (the
    default), household, all, scans.
    """
    first_seed: int = 0
    """Seed of the first procedural object; each further object has the next seed."""
    hand: str = "human"
    """Name or file of the hand."""
    references: Literal["closed", "policy"] = "closed"
    """Origin of the reference poses. closed: the hand is closed around the object by geometry;
    policy: final states of a policy's grasps under headings, as in the paper."""
    policy: pathlib.Path | None = None
    """Policy for --references policy; by default the hand's reference policy, which was trained
    without reference poses and trajectories.
    """
    folder: str = "objects"
    """Folder of objects."""
    out: pathlib.Path = pathlib.Path("constraints")
    """Folder for the files."""
    seed: int = 0
    """Seed of the constraints."""

    def __call__(self) -> int:
        """Generates the sets, and prints where they are."""
        from congrasp.common.task.config import TaskConfig
        from congrasp.common.task.sampling.set_file import save
        from congrasp.common.task.sampling.sets import make_sets

        if not self.objects and self.count < 1:
            raise CongraspError(
                "There are no objects for which to generate constraints.",
                "Pass objects, or --count.",
            )
        hand = get_hand(self.hand)
        with tracked() as track:
            track("Preparing objects", None)
            objects = self._objects()
            bank = None
            if self.references == "policy":
                bank = _references(hand, self.policy, objects, self.seed, track)
            track("Generating constraints", None)
            task = TaskConfig(hand=hand.name)
            for constraints in make_sets(hand, task, objects, self.seed, bank):
                save(constraints, self.out)
        subject = f"The sets of {len(objects)} objects are"
        if len(objects) == 1:
            subject = "The constraint set of 1 object is"
        print(f"{subject} in {self.out}.")
        return 0

    def _objects(self) -> "list[GraspObject]":
        """Returns the requested objects; raises a CongraspError if two have the same name."""
        from congrasp.common.objects.procedural import generate_many
        from congrasp.services.assets.objects.named import located, objects_of

        objects: list[GraspObject] = []
        for text in self.objects:
            objects += objects_of(located(text, self.folder))
        objects += generate_many(self.count, self.first_seed, self.families)
        names = [obj.name for obj in objects]
        for name, distinct_name in zip(names, distinct_names(names), strict=True):
            if name != distinct_name:
                raise CongraspError(
                    f"Several of the objects are called '{name}'.",
                    "Pass each object once. If they are different objects, import them with "
                    "'congrasp objects import A B --out DIR', which gives them distinct names.",
                )
        return objects


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

    file = policy or reference_file(hand.reference) or policy_file(None, hand.reference)
    bundle = bundles.load(file)
    if bundle.spec.hand_name != hand.name:
        raise CongraspError(
            f"The policy has the hand '{bundle.spec.hand_name}', not '{hand.name}'.",
            f"Pass --hand {bundle.spec.hand_name}.",
        )
    references = Experiment(bundle, objects, seed=seed, track=track).references_of(bundle)
    on_whole_surface = references.grasps[:, 0]
    print(
        f"Grasps per object: {on_whole_surface.min()} to {on_whole_surface.max()}. For objects "
        "without a grasp, the hand is closed around the object by geometry."
    )
    return references.bank


@dataclasses.dataclass(frozen=True)
class Import:
    """Make constraint sets of captured grasps by the paper's rules, and report the dropped
    sequences with the reasons.

    Each captured sequence gives a reference pose (finger angles of the `human` hand in the frame of
    the grasp), a wrist trajectory of 15 waypoints to this pose, and, if the object's parts are
    labelled, the parts that may be touched. Only right hands are used. Objects are imported from
    the data set's meshes.

    Examples:
      congrasp constraints import grab GRAB/
      congrasp constraints import myohand data/ --meshes object_sim/
    """

    format: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar=f"{{{','.join(IMPORTERS)}}}")
    ]
    """Name of the data set."""
    path: Annotated[pathlib.Path, tyro.conf.Positional]
    """Folder of the data set, or one of its files."""
    meshes: tuple[pathlib.Path, ...] = ()
    """Folders with the objects' meshes, if they are not in the data set."""
    mano: pathlib.Path | None = None
    """File MANO_RIGHT.pkl; by default that of the variable CONGRASP_MANO. dexycb requires it, and
    grab and oakink are more exact with it.
    """
    hand: str = "human"
    """Hand of the sets. Another hand than human cannot use the captured finger angles. It follows
    the captured wrist with its grasp axes, keeps the captured headings and affordance, and closes
    its fingers around the object at the end."""
    headings: Literal["sampled", "demonstrated"] = "sampled"
    """sampled: 256 headings per object by the paper's rules; demonstrated: the headings of the
    captured grasps."""
    affordance: Literal["auto", "parts", "contacts", "none"] = "auto"
    """Graspable region. parts: the labelled parts that fingers touch; contacts: the surface that
    fingers touch; none: the whole surface; auto: parts if the object's parts are labelled."""
    beyond: float = 0.1
    """Radians by which a captured joint angle may exceed the human hand's limits. Such an angle is
    clamped; sequences with larger excesses are dropped. Not used for other hands."""
    out: pathlib.Path = pathlib.Path("constraints")
    """Folder for the sets, and for import.json, which contains the result of each sequence."""
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

        self._check()
        hand = get_hand(self.hand)
        options = Options(self.headings, self.affordance, self.beyond, seed=self.seed)
        importer = importlib.import_module(IMPORTERS[self.format])
        with bars() as progress:
            task = progress.add_task("Reading", total=None)

            def show_activity(activity: str) -> None:
                """Shows the current sequence or object."""
                progress.update(task, description=activity, advance=1)

            sequences = importer.read(self.path, Meshes(self.meshes), own_mano_model(self.mano))
            objects, sets, report = import_sets(
                sequences, hand, options, self.format, show_activity
            )
        if not report.kept and not report.dropped:
            raise CongraspError(
                f"{self.path} contains no sequence of {self.format}.",
                f"Pass the folder with {importer.HOLDS}.",
            )
        catalogue = Catalogue(self.objects)
        for obj, constraints in zip(objects, sets, strict=True):
            catalogue.add(obj)
            save(constraints, self.out)
        self._write_report(report, hand.name, options)
        print_report(report, hand.name, self.out, self.objects)
        return 0 if report.kept else 2

    def _check(self) -> None:
        """Raises a CongraspError for an unknown format, a missing path, or an invalid option."""
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

    def _write_report(self, report: "Report", hand: str, options: "Options") -> None:
        """Writes the settings, and the outcome of each sequence, to the folder of the sets."""
        content = {
            "format": self.format,
            "path": str(self.path),
            "hand": hand,
            **dataclasses.asdict(options),
            "kept": report.kept,
            "dropped": report.dropped,
        }
        write_atomically(self.out / REPORT, json.dumps(content, indent=2).encode())


def show(
    file: Annotated[pathlib.Path, tyro.conf.Positional],
    png: pathlib.Path | None = None,
    rest: int = 0,
    seed: int = 0,
) -> int:
    """Print the content of a constraint set, and draw some of it.

    Args:
      file: A file of 'congrasp constraints generate' or 'import'.
      png: PNG file to write: headings, affordance, trajectories and reference poses.
      rest: Number of the drawn resting pose, from 1; 0 uses the one with the most reference poses.
      seed: Seed of the random selection that is drawn.

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

        index = rest - 1
        if not rest:
            poses_per_rest = constraints.arrays["pose/allowed"].sum((0, 2))
            index = int(poses_per_rest.argmax())
        save_drawing(png, constraint_sheet(constraints, index, seed))
    return 0


COMMANDS = {"generate": Generate, "import": Import, "show": show}
