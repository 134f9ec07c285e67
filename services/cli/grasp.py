"""`congrasp grasp`: motions for the user's own objects."""

import dataclasses
import pathlib
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape
from typing_extensions import Doc

from congrasp.actors.physics import PhysicsName
from congrasp.common.errors import CongraspError, printable
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.constraints.specs import Option
from congrasp.services.arm import ArmOptions
from congrasp.services.assets.objects.options import ImportOptions
from congrasp.services.cli.console import PhaseBar, bars, in_range, report_error, say
from congrasp.services.cli.dependent_options import check_together

if TYPE_CHECKING:
    from congrasp.services.assets.objects.named import ObjectAt
    from congrasp.services.grasp.grasper import Grasper
    from congrasp.services.grasp.jobs import Settings
    from congrasp.services.grasp.result import Result

NOT_HELD = 1
"""Exit code if an object is not held."""
BAD_INPUT = 2
"""Exit code if an object cannot be used."""
_MAX_ATTEMPTS = 1024
_FILMED_APPROACH_S = 0.7
_FILMED_LIFT_M = 0.12
"""Approach and lift of a film, which shows the grasp on the table."""


def _field(option: Option) -> tuple[str, Any, Any]:
    """Name, annotation and default of an option as the field of a dataclass."""
    kind: Any = str
    if option.switch:
        kind = bool
    elif option.many:
        kind = tuple[str, ...]
    empty = kind()  # False, "" or ()
    return option.name, Annotated[kind, Doc(option.help)], empty


def _fields() -> list[tuple[str, Any, Any]]:
    """Options of all constraints as the fields of a dataclass."""
    fields = []
    for constraint in CONSTRAINTS:
        fields += [_field(option) for option in constraint.options]
    return fields


Constraints: Any = dataclasses.make_dataclass("Constraints", _fields(), frozen=True)
"""The options of all constraints."""


@dataclasses.dataclass(frozen=True)
class Grasp:
    """Make grasp motions for your own objects.

    Every object gets a folder in --out: grasp.npz (self-describing arrays), grasp.mcap (for
    Foxglove and Rerun), grasp.png, portrait.png, object.png (the mesh before and after its import,
    next to a hand at true scale) and result.json.

    Several attempts are simulated in parallel, and the best one is kept. An attempt that holds the
    object for two seconds without the table (or after the lift) is better than one that does not.
    Among equals, small errors, a still object and low forces decide. Repeat an interrupted command
    to resume it.

    Examples:
      congrasp grasp examples/mug.obj --video
      congrasp grasp mug:7 --rest upright --approach 0.7 --lift 0.15
      congrasp grasp mug:7 --hand allegro --arm panda --base "-0.7 0 0 0"
    """

    objects: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Meshes (STL, OBJ, PLY, GLB), object files, folders of these, FAMILY:SEED for an object of the
    generator (mug:7), or names of objects in --folder."""
    out: pathlib.Path = pathlib.Path("grasps")
    """Folder for the results."""
    constraint: Annotated[Constraints, tyro.conf.OmitArgPrefixes] = Constraints()  # noqa: RUF009
    """Constraints of the grasp."""
    video: bool = False
    """Also write grasp.mp4, from the reach to the end of the hold, in real time."""
    size: str = "960x720"
    """Width and height of the video, pixels."""
    fps: float = 25.0
    """Frames per second of the video."""
    overlays: bool = False
    """Draw constraints and contacts into the video; grasp.png always shows them."""
    camera: str = ""
    """Viewpoint of pictures and video as azimuth and elevation in degrees, such as --camera "120
    25"; by default the viewpoint that shows fingers, contacts and object best."""
    pictures: bool = True
    """Write pictures."""
    policy: pathlib.Path | None = None
    """A policy file, or the name of a pretrained policy such as allegro-student; by default the
    pretrained policy of --hand."""
    hand: str = "human"
    """Hand of the pretrained policy; human:left is the left hand, as the mirror image of the
    right."""
    attempts: int = 16
    """Number of attempts simulated in parallel, at most 1024."""
    seed: int = 0
    """Seed of the attempts."""
    physics: PhysicsName = "native"
    """Engine of the attempts: native (MuJoCo C) or physx."""
    approach: float | None = None
    """Duration, in seconds, of the reach from the side of the table, which precedes the grasp. The
    reach takes longer if the wrist would exceed 1 m/s. 0 leaves it out. By default 0, and 0.7 with
    --video.
    """
    lift: float | None = None
    """Height, in metres, by which the hand lifts the object off the table. With 0 the table is
    removed instead. By default 0, and 0.12 with --video.
    """
    rest: str = ""
    """Resting pose of the object on the table: upright, or its number, counted from 1 ('congrasp
    objects rests' draws the poses).
    """
    folder: str = "objects"
    """Folder of imported or generated objects, which `objects` may name instead of files."""
    again: bool = False
    """Repeat objects that are finished already."""
    mesh: Annotated[ImportOptions, tyro.conf.OmitArgPrefixes] = ImportOptions(unit="guess")  # noqa: RUF009
    """Conversion of meshes to objects."""
    arm: Annotated[ArmOptions, tyro.conf.OmitArgPrefixes] = ArmOptions()  # noqa: RUF009
    """The arm that carries the hand."""

    def __call__(self) -> int:
        """Grasps one object after another."""
        from congrasp.actors.attempts import Phases
        from congrasp.actors.physics import resolve_physics
        from congrasp.services.grasp.interface import open_grasper
        from congrasp.services.grasp.jobs import find_objects
        from congrasp.services.grasp.summary import save_summary

        self._check()
        phases = Phases(self._approach, self._lift)
        grasper = open_grasper(
            self.policy,
            self.hand,
            self.attempts,
            self.seed,
            phases,
            self.arm,
            resolve_physics(self.physics),
        )
        entries, results = find_objects(self.objects, self.folder)
        settings = self._settings()
        for result in results:
            _show(result)
        results += _grasp_each(entries, grasper, settings)
        grasper.close()
        if entries:
            save_summary(self.out, grasper.hand.name, results)
        return _conclude(results, len(entries), self.out)

    def _check(self) -> None:
        """Raises a CongraspError if an option is out of range, or needs another one."""
        if not self.objects:
            raise CongraspError(
                "There is nothing to grasp.", "Pass mesh files or folders: congrasp grasp mug.obj"
            )
        check_together(self, ("size", "fps", "overlays"), "video")
        in_range(1, _MAX_ATTEMPTS, attempts=self.attempts)
        in_range(0.0, 10.0, "seconds", approach=self._approach)
        in_range(0.0, 0.5, "metres", lift=self._lift)
        in_range(1.0, 120.0, "frames a second", fps=self.fps)

    @property
    def _approach(self) -> float:
        """Duration of the approach, s."""
        if self.approach is not None:
            return self.approach
        return _FILMED_APPROACH_S if self.video else 0.0

    @property
    def _lift(self) -> float:
        """Height of the lift, m."""
        if self.lift is not None:
            return self.lift
        return _FILMED_LIFT_M if self.video else 0.0

    def _settings(self) -> "Settings":
        """Settings shared by all objects."""
        from congrasp.services.grasp.jobs import Settings
        from congrasp.services.viz.film import film_of
        from congrasp.services.viz.views import view_of

        film = None
        if self.video:
            film = film_of(self.size, self.fps, self.overlays)
        return Settings(
            out=self.out,
            options=self.mesh,
            constraints=dataclasses.asdict(self.constraint),
            film=film,
            view=view_of(self.camera),
            pictures=self.pictures,
            again=self.again,
            rest=self.rest,
        )


def _grasp_each(
    entries: "list[ObjectAt]", grasper: "Grasper", settings: "Settings"
) -> "list[Result]":
    """Grasps objects with progress bars, and prints each outcome."""
    from congrasp.services.grasp.jobs import grasp_object

    results = []
    with bars() as progress:
        objects = progress.add_task("Objects", total=len(entries), visible=len(entries) > 1)
        phases = PhaseBar(progress, "Starting")
        for entry in entries:

            def report(activity: str, done: int, total: int, name: str = entry.name) -> None:
                """Shows the activity with the name of the object."""
                phases.update(f"{name}: {activity}", done, total)

            result = grasp_object(entry, grasper, settings, report)
            results.append(result)
            _show(result)
            progress.advance(objects)
    return results


def _show(result: "Result") -> None:
    """Prints the outcome for one object, and its notes."""
    if result.error:
        report_error(result.error)
        return
    skipped = " (done before)" if result.skipped else ""
    line = f"[bold]{escape(result.name)}[/]{skipped}: {escape(printable(result.line()))}"
    Console(highlight=False).print(line, soft_wrap=True)
    say(*(f"  {note}" for note in result.facts["notes"]))


def _conclude(results: "list[Result]", count: int, out: pathlib.Path) -> int:
    """Prints a summary and the location of the results; returns the exit code.

    Args:
      results: results of all names.
      count: number of objects that the names stand for.
      out: folder of the results.
    """
    from congrasp.services.grasp.summary import SHEET

    held = sum(result.held for result in results)
    failed = sum(bool(result.error) for result in results)
    if len(results) > 1:
        say(
            f"{held} of {len(results)} objects are held; {failed} could not be used. {out / SHEET} "
            f"shows them."
        )
    if count > failed:
        say(f"Everything is in {out}.")
    if failed:
        return BAD_INPUT
    return NOT_HELD if held < len(results) else 0


COMMAND = Grasp
