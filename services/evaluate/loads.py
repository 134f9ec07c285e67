"""Levels of load: masses and frictions, including those of other projects, applied to the same episodes.

All levels use the heading constraint. The inertia is scaled with the mass. Objects are replaced instead of scaling the
mass of an episode: engines derive the softness of contacts from the mass at compilation, and diverge far from it.
"""

import dataclasses
import zlib
from collections.abc import Sequence

import numpy as np

from congrasp.actors.initial import InitialConditions
from congrasp.common.objects.spec import GraspObject
from congrasp.services.evaluate.episodes import identity

CONSTRAINT = "heading"
"""Row evaluated at every level."""


@dataclasses.dataclass(frozen=True)
class Load:
    """Mass of an object and friction of an episode, each uniform in a range; by default those of the evaluation."""

    label: str
    mass: tuple[float, float] | None = None
    """kg."""
    friction: tuple[float, float] | None = None
    """Sliding friction between hand and object."""
    factor: float = 1.0
    """Factor on the object's mass, if no mass is given."""


PEERS = (
    Load("RobustDexGrasp: 0.25 kg, friction 0.8", mass=(0.25, 0.25), friction=(0.8, 0.8)),
    Load("dexsuite: 0.04-0.5 kg, friction 0.5-1", mass=(0.04, 0.5), friction=(0.5, 1.0)),
)
"""Conditions of RobustDexGrasp (arXiv:2504.05287) and of Isaac Lab's dexsuite."""
MASSES = (0.05, 0.1, 0.25, 0.5, 1.0, 1.5, 2.0)
"""Masses of the table `payload`, kg."""


def payload(scale: float, *, constant_mass: bool) -> tuple[Load, ...]:
    """Loads of the table `payload`: fixed masses, the objects' masses, and masses scaled with lengths if different.

    Args:
      scale: factor on the lengths of the hand's objects.
      constant_mass: setting of the task; True if the evaluated objects keep their mass when scaled.
    """
    masses = tuple(Load(f"{mass:g} kg", mass=(mass, mass)) for mass in MASSES)
    own = 1.0 if constant_mass else scale**-3
    found = (*masses, Load("masses of the objects", factor=own))
    literal = Load(f"masses scaled with the lengths x {scale:g}", factor=own * scale**3)
    return found if scale == 1.0 else (*found, literal)


def loaded(objects: Sequence[GraspObject], load: Load) -> list[GraspObject]:
    """Returns the objects with masses of a load; an object's name determines its position in the range."""
    found = []
    for obj in objects:
        mass = load.factor * obj.mass
        if load.mass:
            mass = load.mass[0] + (load.mass[1] - load.mass[0]) * zlib.crc32(obj.name.encode()) / 2**32
        found.append(dataclasses.replace(obj, mass=mass, inertia=obj.inertia * mass / obj.mass))
    return found


def at_load(conditions: InitialConditions, load: Load) -> InitialConditions:
    """Returns episodes with frictions of a load; the episode determines the position in the range."""
    if not load.friction:
        return conditions
    low, high = load.friction
    share = np.array([zlib.crc32(episode.tobytes()) for episode in identity(conditions)]) / 2**32
    friction = (low + (high - low) * share).astype(np.float32)
    return conditions._replace(reset_state=conditions.reset_state._replace(friction=friction))
