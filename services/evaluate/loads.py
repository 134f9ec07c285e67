"""Levels of load: masses and frictions, such as those of other projects, at which the same episodes are evaluated.

All levels have the heading constraint. The inertia is scaled with the mass.
"""

import dataclasses
import zlib
from collections.abc import Sequence

import numpy as np

from congrasp.actors.initial import InitialConditions
from congrasp.services.evaluate.episodes import identity

CONSTRAINT = "heading"
"""The row that is evaluated at every level."""


@dataclasses.dataclass(frozen=True)
class Load:
    """Mass and friction of an episode's object, each uniform in a range; by default those of the evaluation."""

    label: str
    mass: tuple[float, float] | None = None
    """kg."""
    friction: tuple[float, float] | None = None
    """Sliding friction between hand and object."""
    factor: float = 1.0
    """Factor of the object's mass, where no mass is named."""


PEERS = (
    Load("RobustDexGrasp: 0.25 kg, friction 0.8", mass=(0.25, 0.25), friction=(0.8, 0.8)),
    Load("dexsuite: 0.04-0.5 kg, friction 0.5-1", mass=(0.04, 0.5), friction=(0.5, 1.0)),
)
"""Conditions of RobustDexGrasp (arXiv:2504.05287) and of Isaac Lab's dexsuite."""
MASSES = (0.05, 0.1, 0.25, 0.5, 1.0, 1.5, 2.0)
"""kg, of the table `payload`."""


def payload(scale: float, *, constant_mass: bool) -> tuple[Load, ...]:
    """The masses of the table `payload`, the objects' own, and those scaled with the objects' lengths where these are.

    Args:
      scale: factor on the lengths of the hand's objects.
      constant_mass: the task's: whether the objects that are evaluated keep their mass when they are scaled.
    """
    masses = tuple(Load(f"{mass:g} kg", mass=(mass, mass)) for mass in MASSES)
    own = 1.0 if constant_mass else scale**-3
    found = (*masses, Load("masses of the objects", factor=own))
    literal = Load(f"masses scaled with the lengths x {scale:g}", factor=own * scale**3)
    return found if scale == 1.0 else (*found, literal)


def at_load(conditions: InitialConditions, load: Load, masses: Sequence[float]) -> InitialConditions:
    """Episodes at a load. An episode's place in its ranges follows from the episode alone.

    Args:
      conditions: B episodes.
      load: the load.
      masses: (N,) kg, of the objects.
    """
    start, episodes = conditions.reset_state, identity(conditions)
    scale, friction = np.asarray(start.mass_scale) * load.factor, np.asarray(start.friction)
    if load.mass:
        scale = _within(load.mass, episodes, b"mass") / np.asarray(masses)[np.asarray(start.object_index)]
    if load.friction:
        friction = _within(load.friction, episodes, b"friction")
    changed = {"mass_scale": scale.astype(np.float32), "friction": friction.astype(np.float32)}
    return conditions._replace(reset_state=start._replace(**changed))


def _within(limits: tuple[float, float], episodes: np.ndarray, name: bytes) -> np.ndarray:
    """(B,) places in a range, uniform over the identities of episodes (B,) uint32."""
    share = np.array([zlib.crc32(name + episode.tobytes()) for episode in episodes]) / 2**32
    return limits[0] + (limits[1] - limits[0]) * share
