"""Specification of a hand as data: lengths in metres, angles in radians, masses in kilograms.

All points and axes are given in the wrist frame with every joint at zero, so that forward
kinematics is a product of exponentials (`common.hands.kinematics`) and the MJCF
(`common.hands.mjcf`) follows from the same numbers.
"""

import dataclasses
import functools
import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Literal

import numpy as np

Vector = tuple[float, float, float]
CONTACT_TIME_S = 0.006
"""Time constant of contacts that are as stiff as flesh or rubber, s."""
_ARM_MASS_KG = 0.65
"""Inertia that an arm adds to that of the hand, kg."""
_GYRATION_RADIUS_M = 0.06
"""Radius of gyration of a hand about its wrist, m."""
_TIP_WEIGHT = 4.0
"""Weight of a fingertip relative to a link origin in the distance reward."""


def vector(array: np.ndarray) -> Vector:
    """Returns an array (3,) as a tuple."""
    x, y, z = array.tolist()
    return x, y, z


@dataclasses.dataclass(frozen=True)
class Coupling:
    """A joint without a motor that follows another: q = offset + ratio * q of the leader."""

    joint: str
    leader: str
    """Name of a joint with a motor or a tendon."""
    ratio: float
    offset: float = 0.0
    """rad."""


@dataclasses.dataclass(frozen=True)
class Motor:
    """A position servo that pulls joints: its position is sum(c q), and each joint gets c times its
    torque.

    Gains are in N.m/rad, N.m.s/rad and N.m of the motor.
    """

    name: str
    joints: dict[str, float]
    """Coefficients c by the names of the joints."""
    kp: float
    kv: float
    torque_limit: float


@dataclasses.dataclass(frozen=True)
class Joint:
    """A hinge. `axis` and `anchor` in the wrist frame at zero; gains in N.m/rad, N.m.s/rad and N.m.

    The gains are those of its motor. They are zero for a joint that follows another or is pulled by
    a tendon.
    """

    name: str
    axis: Vector
    anchor: Vector
    lower: float
    upper: float
    kp: float
    kv: float
    torque_limit: float
    damping: float = 0.05
    armature: float = 5e-4


@dataclasses.dataclass(frozen=True)
class Capsule:
    """A collision capsule between two points of the wrist frame at zero."""

    start: Vector
    end: Vector
    radius: float


@dataclasses.dataclass(frozen=True)
class Solid:
    """A collision shape of the hand's file, in the wrist frame at zero; `size` follows MuJoCo."""

    kind: Literal["box", "cylinder", "capsule", "ellipsoid"]
    """Meaning of `size`: half extents; radius and half length along z; the same; radii."""
    size: Vector
    position: Vector
    quaternion: tuple[float, float, float, float]
    """(w, x, y, z) from its frame to the wrist frame."""


@dataclasses.dataclass(frozen=True)
class Link:
    """A rigid body. The first link of a hand is its palm, whose frame is the wrist frame; it has no
    joints.
    """

    name: str
    parent: str
    joints: tuple[Joint, ...]
    capsules: tuple[Capsule, ...]
    mass: float
    contact_weight: float
    """Relative share of this link in the contact reward."""
    tip: Vector | None = None
    """Fingertip, on the last link of a finger."""
    solids: tuple[Solid, ...] = ()
    """Collision shapes used instead of the capsules, if there are any."""


@dataclasses.dataclass(frozen=True)
class WristGains:
    """Gains of the virtual wrist: slides in N/m, N.s/m, N; hinges in N.m/rad, N.m.s/rad, N.m."""

    slide_kp: float
    slide_kv: float
    slide_limit: float
    slide_armature: float
    hinge_kp: float
    hinge_kv: float
    hinge_limit: float
    hinge_armature: float


@dataclasses.dataclass(frozen=True, eq=False)
class Hand:
    """A dexterous hand with `F` finger joints, `M` motors, `L` links and `P` keypoints (link
    origins, then fingertips).

    Hands are compared by identity, so that they can be static arguments of compiled functions.
    """

    name: str
    links: tuple[Link, ...]
    thumb: str
    """Name of the thumb's last link; the other links with a tip are the non-thumb fingers."""
    open_pose: dict[str, float]
    """Finger angles at the start of a grasp without a reference pose; other joints are at zero."""
    closed_pose: dict[str, float]
    """Finger angles of a fist, for pictures and for closing around an object."""
    wrist: WristGains
    wide_pose: dict[str, float] | None = None
    """Finger angles of the widest pose that still faces an object (`common.hands.closure`);
    computed if absent.
    """
    object_scale: float = 1.0
    """Factor on object sizes in the paper's comparison of hands."""
    couplings: tuple[Coupling, ...] = ()
    """Joints that follow others and have no motor."""
    tendons: tuple[Motor, ...] = ()
    """Motors that pull several joints each; every other joint without a coupling has a motor."""
    anatomical: bool = False
    """True for a hand with human joints, whose postures can be compared with those of people
    (`common.task.posture`)."""
    text: str = ""
    """The hand's file, for hands that are not part of the package."""

    @property
    def reference(self) -> str:
        """Reference for `common.hands.get_hand` on any machine: the hand's name, or the text of its
        file.
        """
        return self.text or self.name

    @functools.cached_property
    def joints(self) -> tuple[Joint, ...]:
        """Finger joints in the order of `q`."""
        return tuple(itertools.chain.from_iterable(link.joints for link in self.links))

    @functools.cached_property
    def joint_links(self) -> np.ndarray:
        """(F,) index of the link that each joint moves."""
        counts = [len(link.joints) for link in self.links]
        return np.repeat(np.arange(len(self.links)), counts)

    @functools.cached_property
    def motors(self) -> tuple[Motor, ...]:
        """The M motors in the order of the first joints that they pull; see
        `common.hands.motors`.
        """
        tendon_by_first_joint: dict[str, Motor] = {}
        driven_joints = {coupling.joint for coupling in self.couplings}
        for tendon in self.tendons:
            pulled = [joint.name for joint in self.joints if joint.name in tendon.joints]
            tendon_by_first_joint[pulled[0]] = tendon
            driven_joints |= tendon.joints.keys()
        motors = []
        for joint in self.joints:
            if joint.name in tendon_by_first_joint:
                motors.append(tendon_by_first_joint[joint.name])
            elif joint.name not in driven_joints:
                motor = Motor(
                    joint.name,
                    joints={joint.name: 1.0},
                    kp=joint.kp,
                    kv=joint.kv,
                    torque_limit=joint.torque_limit,
                )
                motors.append(motor)
        return tuple(motors)

    @functools.cached_property
    def lower(self) -> np.ndarray:
        """(F,) lower joint limits."""
        return np.array([joint.lower for joint in self.joints], np.float32)

    @functools.cached_property
    def upper(self) -> np.ndarray:
        """(F,) upper joint limits."""
        return np.array([joint.upper for joint in self.joints], np.float32)

    @functools.cached_property
    def q_open(self) -> np.ndarray:
        """(F,) the partially open pose."""
        return self.posed(self.open_pose)

    @functools.cached_property
    def q_closed(self) -> np.ndarray:
        """(F,) the fist."""
        return self.posed(self.closed_pose)

    @functools.cached_property
    def tip_links(self) -> tuple[int, ...]:
        """Indices of the links with a fingertip, thumb first."""
        tips = [i for i, link in enumerate(self.links) if link.tip is not None]
        return tuple(sorted(tips, key=lambda i: self.links[i].name != self.thumb))

    @functools.cached_property
    def moved_tips(self) -> np.ndarray:
        """(F, G) bool: the tips that each joint moves, thumb first."""
        moved = np.zeros((len(self.joints), len(self.tip_links)), bool)
        for tip, i in enumerate(self.tip_links):
            chain = chain_of(self, self.links[i].name)
            moved[:, tip] = [self.links[link].name in chain for link in self.joint_links]
        return moved

    @functools.cached_property
    def finger_roots(self) -> tuple[str, ...]:
        """First link of each finger, thumb first: the first one that carries no other tip."""
        chains = [chain_of(self, self.links[i].name) for i in self.tip_links]
        tips_of_link = Counter(itertools.chain.from_iterable(chains))
        roots = []
        for chain in chains:
            roots.append(next(name for name in chain if tips_of_link[name] == 1))
        return tuple(roots)

    @functools.cached_property
    def fingers(self) -> tuple[str, ...]:
        """Names of the G fingers, thumb first: `index` for `index_proximal` if that is unique."""
        short_names = []
        for root in self.finger_roots:
            without_last_word = root.rpartition("_")[0]
            short_names.append(without_last_word or root)
        are_unique = len(set(short_names)) == len(short_names)
        return tuple(short_names) if are_unique else self.finger_roots

    @functools.cached_property
    def link_fingers(self) -> np.ndarray:
        """(L,) index of each link's finger; -1 for the palm and links that carry no tip or
        several.
        """
        finger_of_link = np.full(len(self.links), -1)
        for i, link in enumerate(self.links):
            for name in chain_of(self, link.name):
                if name in self.finger_roots:
                    finger_of_link[i] = self.finger_roots.index(name)
        return finger_of_link

    @functools.cached_property
    def contact_weights(self) -> np.ndarray:
        """(L,) shares of the links in the contact reward; they sum to one."""
        weights = np.array([link.contact_weight for link in self.links], np.float32)
        return weights / weights.sum()

    @functools.cached_property
    def keypoint_links(self) -> np.ndarray:
        """(P,) index of the link that carries each keypoint."""
        return np.array([*range(len(self.links)), *self.tip_links])

    @functools.cached_property
    def keypoints(self) -> np.ndarray:
        """(P, 3) link origins and fingertips (thumb first) in the wrist frame at zero."""
        tips = [self.links[i].tip for i in self.tip_links]
        return np.array([*map(link_origin, self.links), *tips], np.float32)

    @functools.cached_property
    def keypoint_radii(self) -> np.ndarray:
        """(P,) skin radius around each keypoint: that of its link's first capsule."""
        first_capsules = [self.links[i].capsules[0] for i in self.keypoint_links]
        return np.array([capsule.radius for capsule in first_capsules], np.float32)

    @functools.cached_property
    def keypoint_weights(self) -> np.ndarray:
        """(P,) weights of the keypoints in the distance reward: fingertips count four times; their
        mean is one.
        """
        of_links = np.ones(len(self.links))
        of_tips = _TIP_WEIGHT * np.ones(len(self.tip_links))
        weights = np.concatenate([of_links, of_tips])
        return (weights / weights.mean()).astype(np.float32)

    @functools.cached_property
    def capsules(self) -> np.ndarray:
        """(C, 2, 3) end points of the capsules of all links, in the wrist frame at zero."""
        ends = [(capsule.start, capsule.end) for capsule in self._link_capsules]
        return np.array(ends, np.float32)

    @functools.cached_property
    def capsule_radii(self) -> np.ndarray:
        """(C,) radii in m."""
        return np.array([capsule.radius for capsule in self._link_capsules], np.float32)

    @functools.cached_property
    def capsule_links(self) -> np.ndarray:
        """(C,) index of the link of each capsule."""
        counts = [len(link.capsules) for link in self.links]
        return np.repeat(np.arange(len(self.links)), counts)

    @functools.cached_property
    def _link_capsules(self) -> tuple[Capsule, ...]:
        """The C capsules in the order of the links."""
        return tuple(itertools.chain.from_iterable(link.capsules for link in self.links))

    @functools.cached_property
    def wrist_inertia(self) -> np.ndarray:
        """(2,) inertia moved by the virtual wrist's servos: kg along a slide, kg.m^2 about a
        hinge.
        """
        mass = sum(link.mass for link in self.links)
        about_wrist = mass * _GYRATION_RADIUS_M**2
        return np.array([mass + self.wrist.slide_armature, about_wrist + self.wrist.hinge_armature])

    @functools.cached_property
    def wrist_servos(self) -> np.ndarray:
        """(2, 6) stiffness kp / m (1/s^2) and damping kv / m (1/s) of the wrist joints' servos."""
        gains = self.wrist
        mass, inertia = self.wrist_inertia
        stiffness = [gains.slide_kp / mass, gains.hinge_kp / inertia]
        damping = [gains.slide_kv / mass, gains.hinge_kv / inertia]
        return np.repeat(np.array([stiffness, damping], np.float32), 3, axis=1)

    def posed(self, angles: dict[str, float]) -> np.ndarray:
        """(F,) angles in the order of the joints; coupled joints are set by their leaders."""
        all_angles = dict(angles)
        for coupling in self.couplings:
            leader_angle = angles.get(coupling.leader, 0.0)
            all_angles[coupling.joint] = coupling.offset + coupling.ratio * leader_angle
        return np.array([all_angles.get(joint.name, 0.0) for joint in self.joints], np.float32)


def link_origin(link: Link) -> Vector:
    """Origin of a link's frame in the wrist frame at zero: the anchor of its first joint, or the
    wrist.
    """
    return link.joints[0].anchor if link.joints else (0.0, 0.0, 0.0)


def capsule_ends(link: Link) -> np.ndarray:
    """(C, 2, 3) end points of the link's capsules, in its frame, m."""
    ends = np.array([(capsule.start, capsule.end) for capsule in link.capsules])
    return ends.reshape(-1, 2, 3) - link_origin(link)


def chain(
    names: Sequence[str],
    joints: Sequence[tuple[Joint, ...]],
    points: Sequence[Vector],
    radii: Sequence[float],
    masses: Sequence[float],
    weights: Sequence[float],
    parent: str = "palm",
) -> tuple[Link, ...]:
    """Builds a finger: a chain of links, each a capsule between two of the points, with the tip on
    the last.

    Args:
      names: n names, the first next to the palm.
      joints: n tuples, the joints between each link and the previous one.
      points: n + 1 points in the wrist frame at zero; the last is the fingertip.
      radii: n capsule radii.
      masses: n masses.
      weights: n contact weights.
      parent: parent of the first link.
    """
    links = []
    parents = (parent, *names)
    for i, name in enumerate(names):
        is_last = i == len(names) - 1
        end = points[i + 1]
        link = Link(
            name,
            parent=parents[i],
            joints=joints[i],
            capsules=(Capsule(points[i], end, radii[i]),),
            mass=masses[i],
            contact_weight=weights[i],
            tip=end if is_last else None,
        )
        links.append(link)
    return tuple(links)


def chain_of(hand: Hand, name: str) -> tuple[str, ...]:
    """Names of the links from the palm (excluded) to this one."""
    parents = {link.name: link.parent for link in hand.links}
    chain: list[str] = []
    while parents[name]:
        chain.insert(0, name)
        name = parents[name]
    return tuple(chain)


def wrist_gains(mass: float) -> WristGains:
    """Gains of the virtual wrist for a hand of this mass (kg), on an arm that adds an inertia of
    0.65 kg.

    The wrist follows its targets with a time constant of 0.05 s (0.06 s about the hinges) for any
    mass.
    """
    moved_mass = mass + _ARM_MASS_KG
    inertia_scale = (mass + 0.2) / 0.55
    return WristGains(
        slide_kp=1800.0 * moved_mass,
        slide_kv=90.0 * moved_mass,
        slide_limit=150.0 * moved_mass,
        slide_armature=_ARM_MASS_KG,
        hinge_kp=50.0 * inertia_scale,
        hinge_kv=3.0 * inertia_scale,
        hinge_limit=20.0 * inertia_scale,
        hinge_armature=0.01 * inertia_scale,
    )
