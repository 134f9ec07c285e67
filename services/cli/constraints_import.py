"""`congrasp constraints import`: captured grasps of public data sets as constraint sets."""

import dataclasses
import importlib
import json
import os
import pathlib
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from common.errors import CongraspError

_console = Console(highlight=False)
_HOLDS = {
    "grab": "s1/*.npz and the other subjects",
    "oakink": "anno/seq_all.json",
    "dexycb": "<date>-subject-01/<session>/meta.yml",
    "myohand": "MyoHand_<object>_<action>.npz",
}
REPORT = "import.json"
"""File beside the sets that says what became of each sequence."""


@dataclasses.dataclass(frozen=True)
class ConstraintsImport:
    """Makes constraint sets of captured grasps, by the rules of the paper, and says what it dropped and why.

    From each sequence come a reference pose (the `human` hand's finger angles in the grasping frame) and a wrist
    trajectory to it of 15 waypoints, and, where the object's parts are labelled, which of them may be touched. Only
    right hands are used. Objects are made of the data set's meshes.
    """

    format: Annotated[Literal["grab", "oakink", "dexycb", "myohand"], tyro.conf.Positional]
    """Whose files these are."""
    path: Annotated[pathlib.Path, tyro.conf.Positional]
    """The data set's folder, or one of its files."""
    meshes: tuple[pathlib.Path, ...] = ()
    """Folders with the objects' meshes, where they are not in their place in the data set."""
    mano: pathlib.Path | None = None
    """Your MANO_RIGHT.pkl, or CONGRASP_MANO; dexycb needs it, and grab and oakink are more exact with it."""
    hand: str = "human"
    """Hand of the sets. Human finger angles fit no other hand: it follows the captured wrist by its own grasp axes,
    with the captured headings and affordance, and closes its fingers around the object at the end."""
    headings: Literal["sampled", "demonstrated"] = "sampled"
    """sampled: 256 an object by the paper's rules; demonstrated: those of the captured grasps."""
    affordance: Literal["auto", "parts", "contacts", "none"] = "auto"
    """What O+ is: parts that fingers touch; whatever they touch; or everything. auto: parts where they are labelled."""
    beyond: float = 0.1
    """Radians by which a captured joint may exceed the human hand's limits; it is then moved to the limit. For another
    hand it does not count."""
    out: pathlib.Path = pathlib.Path("constraints")
    """Folder for the sets, and for import.json, which says what became of each sequence."""
    objects: pathlib.Path = pathlib.Path("objects")
    """Folder for the objects."""
    seed: int = 0
    """Of sampled headings and of the split into training and held-out."""

    def run(self) -> int:
        """Runs the command; returns its exit code: 2 if nothing could be kept."""
        from common.files import write_atomically
        from common.hands import get_hand
        from common.objects.store import Catalogue
        from services.assets.captures.build import Options, import_sets
        from services.grasp.constraint_sets import save

        if not self.path.exists():
            raise CongraspError(f"There is no file or folder {self.path}.", "Name the data set's folder.")
        if not self.beyond >= 0:
            raise CongraspError(f"--beyond is {self.beyond}.", "It is in radians, and not negative.")
        hand = get_hand(self.hand)
        options = Options(self.headings, self.affordance, self.beyond, seed=self.seed)
        columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
        with Progress(*columns, console=_console, transient=True) as progress:
            task = progress.add_task("Reading")
            objects, sets, report = import_sets(
                self._sequences(),
                hand,
                options,
                self.format,
                lambda name: progress.update(task, description=f"Reading {escape(name)}"),
            )
            if not report.kept and not report.dropped:
                raise CongraspError(
                    f"{self.path} holds no sequence of {self.format}.",
                    f"Name the folder that holds {_HOLDS[self.format]}.",
                )
            catalogue = Catalogue(self.objects)
            for obj, made in zip(objects, sets, strict=True):
                catalogue.add(obj)
                save(made, self.out)
        about = {"format": self.format, "path": str(self.path), "hand": hand.name, **dataclasses.asdict(options)}
        rows = {**about, "kept": report.kept, "dropped": report.dropped}
        write_atomically(self.out / REPORT, json.dumps(rows, indent=2).encode())
        _say(report, hand.name, len(sets), self.out, self.objects)
        return 0 if report.kept else 2

    def _sequences(self) -> Any:
        from common.hands.mano import VARIABLE, read_mano
        from services.assets.captures.objects import Meshes

        own = self.mano or (pathlib.Path(text) if (text := os.environ.get(VARIABLE)) else None)
        module = importlib.import_module(f"services.assets.captures.{self.format}")
        return module.read(self.path, Meshes(self.meshes), read_mano(own) if own else None)


def _say(report: Any, hand: str, sets: int, out: pathlib.Path, objects: pathlib.Path) -> None:
    kept, dropped = report.kept, report.dropped
    _console.print(f"{len(kept)} of {len(kept) + len(dropped)} sequences kept.")
    if dropped:
        table = Table("dropped", "why", "for example")
        for rule, count, example in report.rules():
            table.add_row(str(count), rule, escape(example))
        _console.print(table)
    if kept and hand != "human":
        _console.print(
            f"A human's finger angles do not fit the hand '{hand}' and were dropped. Heading, affordance and wrist "
            "trajectory were kept; its fingers close around the object where the trajectory ends.",
            soft_wrap=True,
        )
    elif kept:
        worst = max(kept, key=lambda row: row["residual_rad"])
        mean = sum(row["residual_rad"] for row in kept) / len(kept)
        _console.print(
            f"Finger angles leave {mean:.3f} rad a bone on average, {worst['residual_rad']:.3f} rad at most "
            f"({escape(worst['sequence'])})."
        )
    if kept:
        above = sum(row["clear_of_table"] for row in kept)
        _console.print(f"The table leaves room for {above} of {len(kept)} in some resting pose of their objects.")
        _console.print(
            f"Constraint sets ({sets}) are in {escape(str(out))}, their objects in {escape(str(objects))}.",
            soft_wrap=True,
        )
    _console.print(f"{escape(str(out / REPORT))} says what became of each sequence.", soft_wrap=True)
