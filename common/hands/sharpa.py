"""The right Sharpa Wave hand: 22 joints, five in the thumb and in the little finger, four in each of the others.

Geometry, limits, masses, torque limits, gains and armatures are those of the maker's published models (Apache-2.0,
Sharpa Group), without their joint friction; collision capsules follow the published fits. Wrist frame: fingers towards
+z, closing side +x, thumb and index finger on the side of +y. Positive `fe` angles flex.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from congrasp.common.hands.spec import Capsule, Hand, Joint, Link, Vector, chain, vector, wrist_gains


class _Drive(NamedTuple):
    """Gains (N.m/rad, N.m.s/rad), greatest torque (N.m) and armature (kg.m^2) of a type of joint."""

    kp: float
    kv: float
    torque_limit: float
    armature: float


_THUMB_CMC_FE = _Drive(6.95, 0.28, 3.3, 0.0032)
_THUMB_CMC_AA = _Drive(13.2, 0.40, 3.3, 0.0032)
_MCP_FE = _Drive(4.76, 0.21, 1.864, 0.00265)
_MCP_AA = _Drive(6.62, 0.245, 1.864, 0.00265)
_PIP = _Drive(0.9, 0.042, 0.638, 0.0006)
_DIP = _Drive(0.9, 0.035, 0.189, 0.00042)
_PINKY_CMC = _Drive(1.38, 0.03, 0.5285, 0.00012)

_X, _Y, _Z = np.eye(3)
_AROUND = (-0.3491, 0.3491)
_TIP_RADIUS = 0.0081


def _joint(name: str, axis: np.ndarray, anchor: np.ndarray, limits: tuple[float, float], drive: _Drive) -> Joint:
    """Returns a hinge about an axis through an anchor, with the gains of its motor."""
    return Joint(name, vector(axis), vector(anchor), *limits, **drive._asdict(), damping=0.0)


def _finger(name: str, mcp: Vector, radii: tuple[float, float], parent: str = "palm") -> tuple[Link, ...]:
    """Joints, links and tip of one of the four fingers."""
    knuckle = np.array(mcp)
    pip, dip = knuckle + 0.047 * _Z, knuckle + 0.0785 * _Z
    tip = dip + (0.0260 - _TIP_RADIUS) * _Z
    joints = [
        (
            _joint(f"{name}_mcp_fe", _Y, knuckle, (-0.1745, 1.5708), _MCP_FE),
            _joint(f"{name}_mcp_aa", _X, knuckle, _AROUND, _MCP_AA),
        ),
        (_joint(f"{name}_pip", _Y, pip, (0.0, 1.7453), _PIP),),
        (_joint(f"{name}_dip", _Y, dip, (0.0, 1.3963), _DIP),),
    ]
    return chain(
        [f"{name}_proximal", f"{name}_middle", f"{name}_distal"],
        joints,
        [vector(point) for point in (knuckle, pip, dip, tip)],
        (*radii, _TIP_RADIUS),
        (0.04962, 0.01824, 0.00465),
        (1.0, 1.0, 3.0),
        parent,
    )


def _thumb() -> tuple[Link, ...]:
    """Joints, links and tip of the thumb."""
    along, aside = np.array([0.0, 1.0, 1.0]) / np.sqrt(2), np.array([0.0, 1.0, -1.0]) / np.sqrt(2)
    flexion, abduction = np.sqrt(0.75) * _X + 0.5 * aside, 0.5 * _X - np.sqrt(0.75) * aside
    cmc = np.array([0.0100, 0.0260, 0.0214])
    mcp = cmc + np.array([0.005392, 0.0, 0.0]) + 0.065 * along + 0.006 * aside
    ip = mcp + 0.039 * along
    tip = ip + (0.0276 - 0.0094) * along
    joints = [
        (
            _joint("thumb_cmc_fe", -_Z, cmc, (-0.1745, 1.9199), _THUMB_CMC_FE),
            _joint("thumb_cmc_aa", _X, cmc - 0.005 * _X, _AROUND, _THUMB_CMC_AA),
        ),
        (
            _joint("thumb_mcp_fe", flexion, mcp, (-0.5236, 1.3963), _MCP_FE),
            _joint("thumb_mcp_aa", abduction, mcp, _AROUND, _MCP_AA),
        ),
        (_joint("thumb_ip", flexion, ip, (0.0, 1.7453), _PIP),),
    ]
    metacarpal, *rest = chain(
        ["thumb_metacarpal", "thumb_proximal", "thumb_distal"],
        joints,
        [vector(point) for point in (cmc, mcp, ip, tip)],
        (0.0207, 0.0117, 0.0094),
        (0.13837, 0.03328, 0.00798),
        (2.0, 2.0, 6.0),
    )
    # The metacarpal's housing ends in front of the joint.
    housing = Capsule((0.0161, 0.0497, 0.0300), (0.0161, 0.0736, 0.0539), 0.0207)
    return (dataclasses.replace(metacarpal, capsules=(housing,)), *rest)


_MCP: dict[str, Vector] = {
    "index": (0.0010, 0.0303, 0.0959),
    "middle": (0.0000, 0.0100, 0.0989),
    "ring": (0.0015, -0.0103, 0.0929),
    "pinky": (0.0030, -0.0311, 0.0869),
}


def _knuckle(name: str) -> Capsule:
    """Housing of a finger's first joint, which rotates as the finger flexes."""
    x, y, z = _MCP[name]
    return Capsule((x, y - 0.002, z), (x, y + 0.002, z), 0.0126)


_PALM = Link(
    "palm",
    "",
    (),
    (
        *(Capsule((0.0003, y, 0.0220), (0.0003, y, 0.0644), 0.0220) for y in (-0.0195, 0.0011, 0.0217)),
        *map(_knuckle, ("index", "middle", "ring")),
    ),
    0.6506,
    1.0,
)
_PINKY_METACARPAL = Link(
    "pinky_metacarpal",
    "palm",
    (_joint("pinky_cmc", _Z, np.array([0.01136, -0.0263, 0.0869]), (0.0, 0.2618), _PINKY_CMC),),
    (Capsule((0.0000, -0.0320, 0.0450), (0.0000, -0.0320, 0.0640), 0.0140), _knuckle("pinky")),
    0.12541,
    1.0,
)
_FLEXED = ("index", "middle", "ring", "pinky")

SHARPA = Hand(
    name="sharpa",
    links=(
        _PALM,
        *_thumb(),
        *_finger("index", _MCP["index"], (0.0105, 0.0104)),
        *_finger("middle", _MCP["middle"], (0.0093, 0.0094)),
        *_finger("ring", _MCP["ring"], (0.0097, 0.0104)),
        _PINKY_METACARPAL,
        *_finger("pinky", _MCP["pinky"], (0.0107, 0.0099), "pinky_metacarpal"),
    ),
    thumb="thumb_distal",
    open_pose={
        "thumb_cmc_fe": 1.30,
        "thumb_mcp_fe": -0.20,
        "thumb_ip": 0.10,
        **{f"{finger}_{name}": x for finger in _FLEXED for name, x in (("mcp_fe", 0.20), ("pip", 0.20), ("dip", 0.15))},
    },
    closed_pose={
        "thumb_cmc_fe": 1.40,
        "thumb_mcp_fe": 0.70,
        "thumb_ip": 1.00,
        **{f"{finger}_{name}": x for finger in _FLEXED for name, x in (("mcp_fe", 1.35), ("pip", 1.30), ("dip", 0.90))},
    },
    wide_pose={
        "thumb_cmc_fe": 1.202,
        "thumb_cmc_aa": -0.296,
        "thumb_mcp_fe": -0.294,
        "thumb_mcp_aa": -0.042,
        "thumb_ip": 0.064,
        "index_mcp_fe": 0.054,
        "index_mcp_aa": 0.084,
        "index_pip": 0.104,
        "index_dip": 0.108,
        "middle_mcp_fe": 0.04,
        "middle_mcp_aa": 0.083,
        "middle_pip": 0.126,
        "middle_dip": 0.126,
        "ring_mcp_fe": 0.04,
        "ring_mcp_aa": 0.083,
        "ring_pip": 0.126,
        "ring_dip": 0.126,
        "pinky_mcp_fe": 0.04,
        "pinky_mcp_aa": 0.083,
        "pinky_pip": 0.126,
        "pinky_dip": 0.126,
    },
    wrist=wrist_gains(1.246),
    object_scale=1.1,
)
