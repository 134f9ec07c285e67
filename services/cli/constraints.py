"""Constraint sets of objects: headings, reference poses and wrist trajectories as training draws them, or captured."""

import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from common.errors import CongraspError
from common.objects.spec import GraspObject
from services.cli.constraints_import import ConstraintsImport

_console = Console(highlight=False)


@dataclasses.dataclass(frozen=True)
class ConstraintsGenerate:
    """Makes the constraint sets of objects and writes one file each, which says what its arrays mean.

    For the whole surface and for the graspable region O+: 256 headings by the paper's rules, 20 reference poses, and
    wrist trajectories that end at them, from 15 to 25 cm away, replayed through the wrist's controller. 80 % of them
    are for training, and the others are held out.
    """

    objects: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Names in the folder of objects, object files or folders of them, meshes, or FAMILY:SEED such as mug:7."""
    count: int = 0
    """Besides, this many procedural objects."""
    families: tuple[str, ...] = ()
    """Their families, in turn; all if none is named."""
    first_seed: int = 0
    """Seed of the first of them; the others follow."""
    hand: str = "human"
    """Name of the hand, or its file."""
    references: Literal["closed", "policy"] = "closed"
    """closed: poses that close the hand around the object; policy: final states of a policy's grasps under headings, as
    in the paper. Places that the policy does not fill are not allowed."""
    policy: pathlib.Path | None = None
    """Policy file for its references; by default the hand's, which comes with the package."""
    folder: str = "objects"
    """Folder of objects."""
    out: pathlib.Path = pathlib.Path("constraints")
    """Folder for the files."""
    seed: int = 0
    """Seed of the constraints."""

    def run(self) -> int:
        """Runs the command; returns its exit code."""
        from common.config import TaskConfig
        from common.hands import get_hand
        from common.objects.procedural import generate_many
        from services.grasp.constraint_sets import make_sets, save

        if not self.objects and self.count < 1:
            raise CongraspError("There is no object to make constraints for.", "Name objects, or set --count.")
        hand = get_hand(self.hand)
        with _console.status("Preparing objects") as status:
            objects = [obj for text in self.objects for obj in _find(text, self.folder)]
            objects += generate_many(self.count, self.first_seed, self.families)
            status.update("Making constraints")
            task, bank = TaskConfig(hand=hand.name), None
            if self.references == "policy":
                bank = self._grasped(hand.name, objects, lambda text: status.update(f"Grasping: {text}"))
            for constraints in make_sets(hand, task, objects, self.seed, bank):
                save(constraints, self.out)
        what = "The constraint set of 1 object is" if len(objects) == 1 else f"The sets of {len(objects)} objects are"
        _console.print(f"{what} in {escape(str(self.out))}.", soft_wrap=True)
        return 0

    def _grasped(self, hand: str, objects: list[GraspObject], progress: Callable[[str], None]) -> Any:
        """The task set with references from a policy's grasps; says how many there are."""
        import os

        from common.policy import bundle as bundles
        from common.policy.pretrained import policy_file
        from services.evaluate.evaluator import Evaluator

        bundle = bundles.load(policy_file(self.policy, self.hand))
        if bundle.spec.hand_name != hand:
            raise CongraspError(
                f"The policy is for the hand '{bundle.spec.hand_name}', not '{hand}'.",
                f"Set --hand {bundle.spec.hand_name}.",
            )
        evaluator = Evaluator(bundle, objects, threads=os.cpu_count() or 1, seed=self.seed)
        said = ""

        def tell(filled: int, places: int) -> None:
            nonlocal said
            said = f"{filled} of {places} places for reference poses are filled"
            progress(said)

        bank = evaluator.references(tell)
        _console.print(f"{said}.")
        return bank


@dataclasses.dataclass(frozen=True)
class ConstraintsShow:
    """Says what a constraint set holds, and draws some of it."""

    file: Annotated[pathlib.Path, tyro.conf.Positional]
    """A file of 'congrasp constraints generate'."""
    png: pathlib.Path | None = None
    """Picture to write: headings, affordance, trajectories and reference poses."""
    rest: int = 0
    """Resting pose of the picture, from 1; 0 takes the one that leaves room for most poses."""
    seed: int = 0
    """Draws which constraints the picture shows."""

    def run(self) -> int:
        """Runs the command; returns its exit code."""
        from services.grasp.constraint_sets import describe, load

        constraints = load(self.file)
        rests = len(constraints.arrays["rest"])
        if not 0 <= self.rest <= rests:
            raise CongraspError(f"--rest is {self.rest}.", f"The object has the resting poses 1 to {rests}.")
        rest = self.rest or 1 + int(constraints.arrays["pose/allowed"].sum((0, 2)).argmax())
        table = Table(show_header=False, box=None)
        for key, value in describe(constraints).items():
            table.add_row(key, escape(value))
        _console.print(table)
        if self.png is not None:
            from services.viz.constraint_sheet import constraint_sheet
            from services.viz.sheets import save_png

            save_png(self.png, constraint_sheet(constraints, rest - 1, self.seed))
            _console.print(f"The picture is {escape(str(self.png))}.", soft_wrap=True)
        return 0


def _find(text: str, folder: str) -> list[GraspObject]:
    from services.assets.objects.named import objects_of
    from services.cli.objects import find_object

    path = pathlib.Path(text)
    return objects_of(path) if path.exists() else [find_object(text, folder)]


SUBCOMMANDS: dict[str, Callable[..., Any]] = {
    "generate": ConstraintsGenerate,
    "import": ConstraintsImport,
    "show": ConstraintsShow,
}


def parse(arguments: Sequence[str]) -> Callable[[], int]:
    """The command that the arguments name, ready to run."""
    chosen = tyro.extras.subcommand_cli_from_dict(
        SUBCOMMANDS, prog="congrasp constraints", description=__doc__, args=list(arguments)
    )
    return chosen.run
