"""`congrasp objects affordance`: which part of an object may be grasped."""

import dataclasses
import pathlib
import re
from typing import Annotated

import tyro
from rich.console import Console
from rich.markup import escape

from common.errors import CongraspError
from common.objects.store import Catalogue
from services.assets.objects import affordance

_COLOURS = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "yellow": (255, 255, 0)}


@dataclasses.dataclass(frozen=True)
class ObjectsAffordance:
    """Divides an object's surface anew into what may be grasped (O+) and what must not be touched (O-).

    O+ is what lies on the mesh of a part, what is painted in a colour, or what lies beyond a plane. It must have a
    tenth of the surface at least. Sets of constraints and evaluation then keep to it.
    """

    object: Annotated[str, tyro.conf.Positional]
    """A name in the folder, an object file, a mesh, or FAMILY:SEED of the generator, such as mug:7."""
    part_mesh: pathlib.Path | None = None
    """A mesh of the part that may be grasped, in the frame and unit of the object's own file."""
    painted: pathlib.Path | None = None
    """A PLY file of the object with coloured vertices, in the same frame and unit."""
    colour: str = "green"
    """Of what may be grasped in the painted file: red, green, blue, yellow, or #rrggbb."""
    half_space: tuple[float, ...] = ()
    """Three numbers of a direction and one in metres: what lies farther than that along the direction may be grasped.
    In the object's frame, whose origin is its centre of mass."""
    invert: bool = False
    """What was found must not be touched, and the rest may be grasped."""
    name: str = ""
    """Name of the new object; the old one otherwise, which it then replaces."""
    folder: str = "objects"
    """Folder of objects, to which the new one goes."""

    def run(self) -> int:
        """Runs the command; returns its exit code."""
        import numpy as np

        from services.cli.objects import find_object

        given = [value for value in (self.part_mesh, self.painted, self.half_space or None) if value is not None]
        if len(given) != 1:
            raise CongraspError(
                "It must be clear what may be grasped.", "Set one of --part-mesh, --painted and --half-space."
            )
        if len(self.half_space) not in (0, 4):
            raise CongraspError(
                f"--half-space has {len(self.half_space)} numbers, not four.",
                "Write a direction and a distance in metres, such as 0 0 1 0.02.",
            )
        obj = find_object(self.object, self.folder)
        if self.part_mesh is not None:
            plus = affordance.on_part_mesh(obj, self.part_mesh)
        elif self.painted is not None:
            plus = affordance.painted(obj, self.painted, _colour(self.colour))
        else:
            plus = affordance.in_half_space(obj, self.half_space[:3], self.half_space[3])
        if np.all(plus != self.invert):
            raise CongraspError(
                f"All of the surface of '{obj.name}' could be grasped, so that nothing is divided.",
                "Choose a smaller part.",
            )
        labelled = affordance.two_parts(obj, plus != self.invert, self.name)
        file = Catalogue(self.folder).add(labelled)
        share = 1 - labelled.non_graspable_points.mean()
        Console(highlight=False).print(
            f"{share:.0%} of the surface of {escape(labelled.name)} may be grasped; it is in {escape(str(file))}.",
            soft_wrap=True,
        )
        return 0


def _colour(text: str) -> tuple[int, int, int]:
    if text in _COLOURS:
        return _COLOURS[text]
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        raise CongraspError(f"--colour is '{text}'.", f"Write #rrggbb, or one of: {', '.join(_COLOURS)}.")
    red, green, blue = bytes.fromhex(text[1:])
    return red, green, blue
