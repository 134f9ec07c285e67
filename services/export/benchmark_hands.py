"""The hands that DexGraspBench has, and which joint of a hand of this project is which of theirs.

The benchmark takes them from MuJoCo Menagerie (Allegro V3: SimLab, BSD-2; Shadow: Shadow Robot Company, Apache-2.0).
Here are their names and kinematics as facts, in the frame of the palm's body with every joint at zero. A hand is told
by these, not by names: it is the benchmark's if its joints are where the benchmark has them.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from common.errors import CongraspError
from services.export.motion_file import GraspMotion

Row = tuple[float, float, float, float, float, float]
"""Anchor (m) and axis (unit) of a joint, in the palm's frame at zero."""
PLACES_MM = 0.1
"""How far a joint may be from where the benchmark has it."""
_FACING = 1e-3  # rad, how far an axis may be turned


class BenchmarkHand(NamedTuple):
    """A hand of F joints in the benchmark's order."""

    fingers: dict[str, tuple[Row, ...]]
    """The joints of each finger from the palm on; the key with a number is a joint's name."""
    from_tip: bool
    """Whether they are numbered from the tip, from 1 on, instead of from the palm, from 0 on."""
    position: tuple[float, float, float]
    """m, of the palm in the frame of the root, which is what the benchmark places."""
    quaternion: tuple[float, float, float, float]
    """(w, x, y, z) palm to root."""
    kp: float
    """N.m/rad of every motor."""
    damping: float
    """N.m.s/rad of every joint."""
    torque_limit: float
    """N.m of every motor."""

    @property
    def joints(self) -> tuple[str, ...]:
        """F names."""
        return tuple(
            f"{finger}{len(rows) - i if self.from_tip else i}"
            for finger, rows in self.fingers.items()
            for i in range(len(rows))
        )

    @property
    def rows(self) -> np.ndarray:
        """(F, 2, 3) anchors and axes."""
        return np.array([*itertools.chain(*self.fingers.values())]).reshape(-1, 2, 3)


def _straight(x: float, z: float, side: int) -> tuple[Row, ...]:
    """A finger of the Shadow hand along z, that spreads about y and bends about x."""
    return (
        (x, 0, z, 0, side, 0),
        (x, 0, z, 1, 0, 0),
        (x, 0, z + 0.045, 1, 0, 0),
        (x, 0, z + 0.070, 1, 0, 0),
    )


_S, _C = 0.0871558, 0.9961947  # of the 5 degrees by which Allegro's outer fingers lean
_H = np.sqrt(0.5)
BENCHMARK_HANDS = {
    "allegro": BenchmarkHand(
        fingers={
            "ffj": (
                (0, 0.0435, -0.001542, 0, _S, _C),
                (0, 0.0449294, 0.0147956, 0, _C, -_S),
                (0, 0.0496358, 0.0685901, 0, _C, -_S),
                (0, 0.0529825, 0.1068440, 0, _C, -_S),
            ),
            "mfj": (
                (0, 0, 0.0007, 0, 0, 1),
                (0, 0, 0.0171, 0, 1, 0),
                (0, 0, 0.0711, 0, 1, 0),
                (0, 0, 0.1095, 0, 1, 0),
            ),
            "rfj": (
                (0, -0.0435, -0.001542, 0, -_S, _C),
                (0, -0.0449294, 0.0147956, 0, _C, _S),
                (0, -0.0496358, 0.0685901, 0, _C, _S),
                (0, -0.0529825, 0.1068440, 0, _C, _S),
            ),
            "thj": (
                (-0.0182, 0.019333, -0.045987, 0, -_S, -_C),
                (-0.0132, 0.0567279, -0.0763618, 0, _C, -_S),
                (-0.0132, 0.0743606, -0.0779045, 1, 0, 0),
                (-0.0132, 0.1255650, -0.0823844, 1, 0, 0),
            ),
        },
        from_tip=False,
        position=(0.0, 0.0, 0.0),
        quaternion=(0.0, _H, 0.0, _H),
        kp=5.0,
        damping=0.1,
        torque_limit=100.0,
    ),
    "shadow": BenchmarkHand(
        fingers={
            "rh_FFJ": _straight(0.033, 0.095, -1),
            "rh_MFJ": _straight(0.011, 0.099, -1),
            "rh_RFJ": _straight(-0.011, 0.095, 1),
            "rh_LFJ": ((-0.033, 0, 0.02071, 0.5735764, 0, 0.8191520), *_straight(-0.033, 0.0865, 1)),
            "rh_THJ": (
                (0.034, -0.00858, 0.029, -_H, 0, -_H),
                (0.034, -0.00858, 0.029, _H, 0, -_H),
                (0.0608701, -0.00858, 0.0558701, _H, 0, -_H),
                (0.0608701, -0.00858, 0.0558701, 0, -1, 0),
                (0.0834975, -0.00858, 0.0784975, 0, -1, 0),
            ),
        },
        from_tip=True,
        position=(0.0, 0.0, 0.034),
        quaternion=(1.0, 0.0, 0.0, 0.0),
        kp=5.0,
        damping=0.05,
        torque_limit=3.0,
    ),
}
"""By the benchmark's names. Allegro's motors have no limit there; 100 N.m is beyond what anything asks of them."""


class Match(NamedTuple):
    """A hand of this project as the benchmark has it."""

    name: str
    """Of the benchmark's hand."""
    hand: BenchmarkHand
    order: np.ndarray
    """(F,) index of this project's joint for each of the benchmark's."""
    sign: np.ndarray
    """(F,) 1 or -1 where it turns the other way."""
    position: np.ndarray
    """(3,) m, of the wrist frame in the root's."""
    rotation: Rotation
    """From the wrist frame to the root's."""

    def qpos(self, position: np.ndarray, rotation: Rotation, q: np.ndarray) -> np.ndarray:
        """(7 + F,) root's place and quaternion (w, x, y, z) in the world and the joints, as the benchmark stores them.

        Args:
          position: (3,) m, of the wrist in the world.
          rotation: from the wrist frame to the world.
          q: (F,) rad, in this project's order.
        """
        turn = rotation * self.rotation.inv()
        quaternion = turn.as_quat(scalar_first=True)
        return np.concatenate([position - turn.apply(self.position), quaternion, self.sign * q[self.order]])

    def joint_frames(self, qpos: np.ndarray) -> tuple[np.ndarray, Rotation]:
        """Where the benchmark's kinematics has what each joint moves, by the product of exponentials.

        Args:
          qpos: (7 + F,), see `qpos`.

        Returns:
          (F, 3) m, the joints' anchors in the world; and the turn of what follows each from this project's zero pose
          to the world.
        """
        root = Rotation.from_quat(qpos[3:7], scalar_first=True)
        palm = root * Rotation.from_quat(self.hand.quaternion, scalar_first=True)
        base = qpos[:3] + root.apply(self.hand.position)
        places, turns = [], []
        number = 7
        for rows in self.hand.fingers.values():
            turn, way = palm, base  # of a point of the zero pose: turn.apply(point) + way
            for row in np.array(rows).reshape(-1, 2, 3):
                anchor = turn.apply(row[0]) + way
                turn = turn * Rotation.from_rotvec(qpos[number] * row[1])
                way = anchor - turn.apply(row[0])
                places.append(anchor)
                turns.append(turn)
                number += 1
        own = Rotation.from_quat(self.hand.quaternion, scalar_first=True).inv() * self.rotation
        return np.array(places), Rotation.concatenate(turns) * own


def match_hand(motion: GraspMotion) -> Match:
    """The benchmark's hand that a motion's hand is, whatever its joints are called.

    Every way of pairing fingers with the benchmark's is laid over it (Kabsch); the best must fit to `PLACES_MM`.

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
            found = _laid_over(name, hand, order, motion)
            if found[0] < best[0]:
                best = found
    error, match = best
    if match is None or error > PLACES_MM:
        near = f"; the nearest, {match.name}, has a joint {error:.2g} mm off" if match else ""
        raise CongraspError(
            f"DexGraspBench has no hand like '{motion.hand}'{near}.",
            f"It has {' and '.join(BENCHMARK_HANDS)}; of another make of one, import the benchmark's own file.",
        )
    return match


def _chains(motion: GraspMotion) -> list[np.ndarray]:
    """Indices of the joints of each finger, from the palm on; none for a hand that is no palm with chains."""
    parents, links = motion.link_parent, motion.joint_link
    found = []
    for tip in sorted({*range(len(parents))} - {*parents.tolist()}):
        chain: list[int] = []
        link = tip
        while parents[link] >= 0:
            chain = [*np.flatnonzero(links == link).tolist(), *chain]
            link = int(parents[link])
        found.append(np.array(chain, int))
    found = [chain for chain in found if len(chain)]
    joints = np.concatenate(found) if found else np.zeros(0)
    return found if len(np.unique(joints)) == len(joints) == len(links) and len(found) <= 5 else []


def _laid_over(name: str, hand: BenchmarkHand, order: np.ndarray, motion: GraspMotion) -> tuple[float, Match | None]:
    """How far in mm the farthest joint is off with these joints for the benchmark's, and the match."""
    theirs, anchors, axes = hand.rows, motion.joint_anchor[order].astype(float), motion.joint_axis[order].astype(float)
    middle, center = theirs[:, 0].mean(0), anchors.mean(0)
    turn = Rotation.align_vectors(theirs[:, 0] - middle, anchors - center)[0]
    off = 1e3 * np.linalg.norm(turn.apply(anchors - center) - (theirs[:, 0] - middle), axis=-1).max()
    along = np.sum(turn.apply(axes) * theirs[:, 1], -1)
    if np.abs(along).min() < np.cos(_FACING):
        return np.inf, None
    palm = Rotation.from_quat(hand.quaternion, scalar_first=True)
    place = palm.apply(middle - turn.apply(center)) + hand.position
    return float(off), Match(name, hand, order, np.sign(along), place, palm * turn)
