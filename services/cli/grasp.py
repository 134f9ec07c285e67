"""`congrasp grasp`: motions for the user's own objects."""

import dataclasses
import pathlib
import sys
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape
from typing_extensions import Doc

from congrasp.common.errors import CongraspError, need_package, printable
from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.services.arm.options import ArmOptions
from congrasp.services.assets.objects.options import ImportOptions

if TYPE_CHECKING:
    from congrasp.services.grasp.jobs import Result
    from congrasp.services.viz.render import Film

NOT_HELD, BAD_INPUT = 1, 2
_MOST_ATTEMPTS = 1024

Constraints: Any = dataclasses.make_dataclass(
    "Constraints",
    [
        (option.name, Annotated[bool, Doc(option.help)], False)
        if option.switch
        else (option.name, Annotated[tuple[str, ...], Doc(option.help)], ())
        if option.many
        else (option.name, Annotated[str, Doc(option.help)], "")
        for constraint in CONSTRAINTS
        for option in constraint.options
    ],
    frozen=True,
)
"""The options of all constraints."""


def grasp(
    objects: Annotated[tuple[pathlib.Path, ...], tyro.conf.Positional],
    out: pathlib.Path = pathlib.Path("grasps"),
    constraint: Annotated[Constraints, tyro.conf.OmitArgPrefixes] = Constraints(),  # noqa: B008
    video: bool = False,
    size: str = "1280x720",
    fps: float = 25.0,
    overlays: bool = False,
    camera: str = "",
    pictures: bool = True,
    policy: pathlib.Path | None = None,
    hand: str = "human",
    attempts: int = 16,
    seed: int = 0,
    approach: float = 0.0,
    lift: float = 0.0,
    rest: str = "",
    folder: str = "objects",
    again: bool = False,
    mesh: Annotated[ImportOptions, tyro.conf.OmitArgPrefixes] = ImportOptions(unit="guess"),  # noqa: B008
    arm: Annotated[ArmOptions, tyro.conf.OmitArgPrefixes] = ArmOptions(),  # noqa: B008
) -> int:
    """Make grasp motions for custom objects.

    Every object gets a folder in --out: grasp.npz (self-describing arrays), grasp.mcap (Foxglove, Rerun), grasp.png,
    portrait.png, object.png (before and after its import, with a hand at true scale) and result.json.

    Several attempts are simulated in parallel, and the best is kept: first by a hold of two seconds without the table
    (or after the lift), then by small errors, a still object and low forces. Repeat the command to resume an
    interrupted one.

    Args:
      objects: Meshes (STL, OBJ, PLY, GLB), object files, folders of them, FAMILY:SEED of the generator (mug:7), or
        names in --folder.
      out: Folder for the results.
      constraint: Constraints of the grasp.
      video: Also write grasp.mp4, in real time.
      size: Width and height of the video, pixels.
      fps: Frames per second of the video.
      overlays: Draw constraints and contacts into the video; grasp.png always shows them.
      camera: Viewpoint of pictures and video, in degrees around the table and above it: --camera "120 25"; by default
        the one that shows fingers, contacts and object best.
      pictures: Write pictures.
      policy: A policy file, or 'allegro-student'; by default the pretrained one of the hand.
      hand: Hand of the pretrained policy; human:left takes its mirror image.
      attempts: Number of attempts simulated in parallel, at most 1024.
      seed: Seed of the attempts.
      approach: Seconds in which the hand first comes from the side of the table; longer where an arm needs it (1 m/s).
      lift: Metres by which the hand lifts the object off the table, which then stays; 0 removes the table.
      rest: Resting pose on the table: upright, or a number from 1 on (congrasp objects rests shows them).
      folder: Folder of objects, which can be named in place of files.
      again: Repeat finished objects.
      mesh: Conversion of meshes to objects.
      arm: The arm that carries the hand.

    Examples:
      congrasp grasp examples/mug.obj --video
      congrasp grasp mug:7 --rest upright --approach 0.7 --lift 0.15
      congrasp grasp mug:7 --hand allegro --arm panda --base "-0.7 0 0 0"
    """
    from congrasp.actors.attempts import Phases
    from congrasp.common.hands import get_hand
    from congrasp.common.hands.left import right_name
    from congrasp.common.policy import bundle as bundles
    from congrasp.common.policy.pretrained import policy_file
    from congrasp.services.cli.console import at_least, at_most, bars
    from congrasp.services.grasp.grasper import Grasper
    from congrasp.services.grasp.jobs import Settings, find_objects, grasp_object, save_summary
    from congrasp.services.viz.views import view_of

    if not objects:
        raise CongraspError("There is nothing to grasp.", "Pass mesh files or folders: congrasp grasp mug.obj")
    at_least(1, attempts=attempts)
    at_most(_MOST_ATTEMPTS, "side by side", attempts=attempts)
    at_most(10.0, "seconds", approach=approach)
    at_most(0.5, "metres", lift=lift)
    at_least(1.0, fps=fps)
    at_most(120.0, "frames a second", fps=fps)
    if out.exists() and not out.is_dir():
        raise CongraspError(f"--out is the file {out}.", "Pass a folder; it is created if it does not exist.")
    right, left = right_name(hand)
    if left and arm.arm:
        raise CongraspError("An arm carries right hands alone.", "Leave out --arm or :left.")
    file = policy_file(policy, right)
    bundle = bundles.load(file)
    found, results = find_objects(objects, folder)
    film = _film(size, fps, overlays) if video else None
    identity: tuple[Any, ...] = (bundles.content_hash(file.read_bytes()), attempts, seed, approach, lift)
    if left:
        identity = (*identity, "left")
    planner = None
    if arm.arm:
        from congrasp.services.arm.planner import ArmPlanner

        planner = ArmPlanner(arm, get_hand(bundle.spec.hand), seed)
        identity = (*identity, planner.identity)
    drawn = film, view_of(camera)
    settings = Settings(out, mesh, dataclasses.asdict(constraint), identity, *drawn, pictures, again, rest)
    phases = Phases(approach, lift)
    grasper = Grasper(bundle, attempts=attempts, phases=phases, seed=seed, arm=planner, left=left)

    for result in results:
        _show(result)
    with bars() as bar:
        whole = bar.add_task("Objects", total=len(found), visible=len(found) > 1)
        part = bar.add_task("Starting", total=None)
        for at in found:

            def progress(what: str, done: int, total: int, name: str = at.name) -> None:
                bar.update(part, description=f"{escape(name)}: {what}", completed=done, total=total if done else None)

            results.append(grasp_object(at, grasper, settings, progress))
            _show(results[-1])
            bar.advance(whole)
    grasper.close()
    if found:
        save_summary(out, grasper.hand.name, results)
    return _conclude(results, len(found), out)


def _show(result: "Result") -> None:
    """Prints the outcome for one object, and its notes."""
    if result.error:
        print(f"congrasp: error: {result.error}", file=sys.stderr)
        return
    done = " (done before)" if result.skipped else ""
    Console(highlight=False).print(
        f"[bold]{escape(result.name)}[/]{done}: {escape(printable(result.line()))}", soft_wrap=True
    )
    for note in result.facts["notes"]:
        Console(highlight=False).print(f"  {escape(printable(note))}", soft_wrap=True)


def _conclude(results: "list[Result]", found: int, out: pathlib.Path) -> int:
    """Prints a summary and the location of the results; returns the exit code."""
    from congrasp.services.grasp.jobs import SHEET

    held = sum(result.held for result in results)
    failed = sum(bool(result.error) for result in results)
    if len(results) > 1:
        summary = f"{held} of {len(results)} objects are held; {failed} could not be used."
        Console(highlight=False).print(f"{summary} {escape(str(out / SHEET))} shows them.", soft_wrap=True)
    if found > failed:
        Console(highlight=False).print(f"Everything is in {escape(str(out))}.", soft_wrap=True)
    return BAD_INPUT if failed else NOT_HELD if held < len(results) else 0


COMMAND = grasp


def _film(size: str, fps: float, overlays: bool) -> "Film":
    """Style of the video."""
    from congrasp.services.viz.render import Film

    need_package("--video", "imageio_ffmpeg")
    return Film(_pixels(size), fps, overlays)


def _pixels(text: str) -> tuple[int, int]:
    """Width and height of WIDTHxHEIGHT, even and from 64 to 4096 pixels."""
    numbers = text.lower().split("x")
    if len(numbers) == 2 and all(word.isdecimal() and len(word) < 5 for word in numbers):
        width, height = map(int, numbers)
        if all(64 <= side <= 4096 and side % 2 == 0 for side in (width, height)):
            return width, height
    raise CongraspError(f"--size is '{text}'.", "Write two even numbers from 64 to 4096: --size 1920x1080")
