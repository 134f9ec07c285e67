"""Hands of DexGraspBench, and the correspondence between their joints and those of this project's
hands.

The benchmark takes them from MuJoCo Menagerie (Allegro V3: SimLab, BSD-2; Shadow: Shadow Robot
Company, Apache-2.0). This module has their names and kinematics, in the frame of the palm's body
with every joint at zero. A hand is recognised by its kinematics, not by names: it is the
benchmark's if its joints are at the same positions.
"""

import dataclasses
import itertools
import json
import pathlib
from typing import Literal, NamedTuple

import dacite
import numpy as np
from scipy.spatial.transform import Rotation

from congrasp.common.episode.episode import Episode
from congrasp.common.errors import CongraspError
from congrasp.common.hands.spec import Hand, Joint, Solid, Vector, vector

Row = tuple[float, float, float, float, float, float]
"""Anchor (m) and axis (unit) of a joint, in the palm's frame at zero."""
PLACES_MM = 0.1
"""Tolerance of a joint's position relative to the benchmark."""
_FACING = 1e-3  # tolerance of an axis's direction, rad


@dataclasses.dataclass(frozen=True)
class Shape:
    """A collision shape of a benchmark's hand, in the palm's frame at zero."""

    joint: str
    """The joint that moves it; empty for the palm."""
    kind: Literal["box", "capsule"]
    size: Vector
    """Half extents, or radius and half length along z."""
    position: tuple[float, ...]
    """(3,) m."""
    quaternion: tuple[float, ...]
    """(4,) w x y z, its frame to the palm's."""


@dataclasses.dataclass(frozen=True)
class BenchmarkHand:
    """A hand of F joints in the benchmark's order."""

    fingers: dict[str, tuple[Row, ...]]
    """Joints of each finger from the palm on, by the finger; its name and a number are the name of
    a joint.
    """
    from_tip: bool
    """True if they are numbered from the tip, from 1 on, instead of from the palm, from 0 on."""
    position: tuple[float, float, float]
    """Position of the palm in the frame of the root, whose pose the benchmark stores, m."""
    quaternion: tuple[float, float, float, float]
    """(w, x, y, z) palm to root."""
    kp: float
    """Stiffness of every motor, N.m/rad."""
    damping: float
    """Damping of every joint, N.m.s/rad."""
    torque_limit: float
    """Limit of every motor, N.m."""
    shapes: tuple[Shape, ...] = ()
    """Collision shapes; empty if those are meshes."""

    @property
    def joints(self) -> tuple[str, ...]:
        """F names."""
        names = []
        for finger, rows in self.fingers.items():
            for i in range(len(rows)):
                number = len(rows) - i if self.from_tip else i
                names.append(f"{finger}{number}")
        return tuple(names)

    @property
    def rows(self) -> np.ndarray:
        """Anchors and axes (F, 2, 3)."""
        return np.array([*itertools.chain(*self.fingers.values())]).reshape(-1, 2, 3)


BENCHMARK_HANDS = {
    name: dacite.from_dict(BenchmarkHand, fields, dacite.Config(cast=[tuple]))
    for name, fields in json.loads(pathlib.Path(__file__).with_suffix(".json").read_text()).items()
}
"""The benchmark's hands, by its names."""


class Match(NamedTuple):
    """Assignment of a hand of this project to the benchmark's."""

    name: str
    """Name of the benchmark's hand."""
    hand: BenchmarkHand
    order: np.ndarray
    """(F,) index of this project's joint for each of the benchmark's."""
    sign: np.ndarray
    """(F,) 1, or -1 for joints that turn the other way."""
    position: np.ndarray
    """(3,) position of the wrist frame in the root's, m."""
    rotation: Rotation
    """Rotation from the wrist frame to the root's."""

    def qpos(self, position: np.ndarray, rotation: Rotation, q: np.ndarray) -> np.ndarray:
        """Position and quaternion (w, x, y, z) of the root in the world and joints (7 + F,), as the
        benchmark stores them.

        Args:
          position: (3,) m, of the wrist in the world.
          rotation: from the wrist frame to the world.
          q: (F,) rad, in this project's order.
        """
        turn = rotation * self.rotation.inv()
        quaternion = turn.as_quat(scalar_first=True)
        return np.concatenate(
            [position - turn.apply(self.position), quaternion, self.sign * q[self.order]]
        )

    def solids(self, link_of: np.ndarray) -> dict[int, tuple[Solid, ...]]:
        """The benchmark's collision shapes in the wrist frame at zero, by links; empty if they are
        meshes.

        Args:
          link_of: (F,) index of the link that each of this project's joints moves.
        """
        palm = Rotation.from_quat(self.hand.quaternion, scalar_first=True)
        turn = self.rotation.inv() * palm  # from the palm's frame to the wrist's
        place = self.rotation.inv().apply(self.hand.position - self.position)
        solids_of: dict[int, tuple[Solid, ...]] = {}
        for shape in self.hand.shapes:
            link = (
                int(link_of[self.order[self.hand.joints.index(shape.joint)]]) if shape.joint else 0
            )
            w, x, y, z = (turn * Rotation.from_quat(shape.quaternion, scalar_first=True)).as_quat(
                scalar_first=True
            )
            solid = Solid(
                shape.kind, shape.size, vector(turn.apply(shape.position) + place), (w, x, y, z)
            )
            solids_of[link] = (*solids_of.get(link, ()), solid)
        return solids_of


def match_hand(motion: Episode) -> Match:
    """Returns the benchmark's hand for a motion's hand, independent of the names of its joints.

    Every assignment of fingers is aligned with the benchmark's (Kabsch); the best must match to
    `PLACES_MM`.

    Raises:
      CongraspError: the benchmark has no such hand.
    """
    chains = _chains(motion)
    best: tuple[float, Match | None] = (np.inf, None)
    for name, hand in BENCHMARK_HANDS.items():
        lengths = [len(rows) for rows in hand.fingers.values()]
        for pairing in itertools.permutations(chains):
            if [len(chain) for chain in pairing] != lengths:
                continue
            order = np.concatenate(pairing)
            laid_over = _laid_over(name, hand, order, motion)
            if laid_over[0] < best[0]:
                best = laid_over
    error, match = best
    if match is None or error > PLACES_MM:
        near = f"; the nearest, {match.name}, has a joint {error:.2g} mm off" if match else ""
        raise CongraspError(
            f"DexGraspBench has no hand like '{motion.hand}'{near}.",
            f"It has {' and '.join(BENCHMARK_HANDS)}; of another make of one, import the "
            f"benchmark's own file.",
        )
    return match


def benchmarked(hand: Hand, match: Match) -> Hand:
    """Returns the hand with the benchmark's motors, damping, and collision shapes unless those are
    meshes.
    """
    motor = match.hand

    def driven(joint: Joint) -> Joint:
        joint = dataclasses.replace(joint, damping=motor.damping)
        if not joint.kp:
            return joint
        return dataclasses.replace(joint, kp=motor.kp, kv=0.0, torque_limit=motor.torque_limit)

    solids = match.solids(hand.joint_links)
    links = tuple(
        dataclasses.replace(
            link, joints=tuple(map(driven, link.joints)), solids=solids.get(i, link.solids)
        )
        for i, link in enumerate(hand.links)
    )
    tendons = tuple(
        dataclasses.replace(tendon, kp=motor.kp, kv=0.0, torque_limit=motor.torque_limit)
        for tendon in hand.tendons
    )
    return dataclasses.replace(hand, links=links, tendons=tendons)


def _chains(motion: Episode) -> list[np.ndarray]:
    """Joint indices of each finger, from the palm on; empty if the hand is not a palm with
    chains.
    """
    parents = motion.link_parent
    links = motion.joint_link
    chains = []
    for tip in sorted({*range(len(parents))} - {*parents.tolist()}):
        chain: list[int] = []
        link = tip
        while parents[link] >= 0:
            chain = [*np.flatnonzero(links == link).tolist(), *chain]
            link = int(parents[link])
        chains.append(np.array(chain, int))
    chains = [chain for chain in chains if len(chain)]
    joints = np.concatenate(chains) if chains else np.zeros(0)
    return (
        chains if len(np.unique(joints)) == len(joints) == len(links) and len(chains) <= 5 else []
    )


def _laid_over(
    name: str, hand: BenchmarkHand, order: np.ndarray, motion: Episode
) -> tuple[float, Match | None]:
    """Error in mm of the farthest joint for this assignment of joints, and the match."""
    theirs = hand.rows
    anchors = motion.joint_anchor[order].astype(float)
    axes = motion.joint_axis[order].astype(float)
    middle = theirs[:, 0].mean(0)
    center = anchors.mean(0)
    turn = Rotation.align_vectors(theirs[:, 0] - middle, anchors - center)[0]
    off = (
        1e3 * np.linalg.norm(turn.apply(anchors - center) - (theirs[:, 0] - middle), axis=-1).max()
    )
    along = np.sum(turn.apply(axes) * theirs[:, 1], -1)
    if np.abs(along).min() < np.cos(_FACING):
        return np.inf, None
    palm = Rotation.from_quat(hand.quaternion, scalar_first=True)
    place = palm.apply(middle - turn.apply(center)) + hand.position
    return float(off), Match(name, hand, order, np.sign(along), place, palm * turn)
