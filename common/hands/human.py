"""The human right hand: 20 anatomical finger joints, four for each finger.

Joint centres, axes and capsule radii are MyoHand's (Apache-2.0, MyoHub; OpenSim-derived). Wrist frame: origin at the
lunate, fingers towards -y, thumb side +x, back of the hand +z. Fingers flex with positive angles, the thumb's `mp` and
`ip` with negative ones. Limits are MyoHand's, widened where anatomy allows; phalanx masses are of a mean adult hand.
"""

from congrasp.common.hands.spec import Capsule, Hand, Joint, Link, Vector, chain, wrist_gains

FINGER_GAINS = {"kp": 4.0, "kv": 0.15, "torque_limit": 1.5}
WRIST = wrist_gains(0.35)
_MCP_FLEXION = (-0.35, 1.571)
_MCP_ABDUCTION = (-0.30, 0.30)
_PIP = (0.0, 1.75)
_DIP = (-0.09, 1.571)


def _joint(name: str, anchor: Vector, axis: Vector, limits: tuple[float, float]) -> Joint:
    """Returns a joint from its anatomical limits in degrees."""
    norm = sum(x * x for x in axis) ** 0.5
    unit = (axis[0] / norm, axis[1] / norm, axis[2] / norm)
    return Joint(name, unit, anchor, *limits, **FINGER_GAINS)


def _finger(
    name: str,
    anchors: tuple[Vector, Vector, Vector],
    axes: tuple[Vector, Vector, Vector, Vector],
    tip: Vector,
    radii: tuple[float, float, float],
    masses: tuple[float, float, float],
) -> tuple[Link, ...]:
    """Returns the links of three phalanges; `axes` are MCP flexion, MCP abduction, PIP and DIP."""
    mcp, pip, dip = anchors
    return chain(
        [f"{name}_proximal", f"{name}_middle", f"{name}_distal"],
        [
            (
                _joint(f"{name}_mcp_flexion", mcp, axes[0], _MCP_FLEXION),
                _joint(f"{name}_mcp_abduction", mcp, axes[1], _MCP_ABDUCTION),
            ),
            (_joint(f"{name}_pip", pip, axes[2], _PIP),),
            (_joint(f"{name}_dip", dip, axes[3], _DIP),),
        ],
        (*anchors, tip),
        radii,
        masses,
        (1.0, 1.0, 3.0),
    )


_PALM = Link(
    "palm",
    "",
    (),
    (
        Capsule((0.0080, -0.0150, -0.0020), (0.0222, -0.0809, 0.0110), 0.0100),
        Capsule((0.0020, -0.0150, 0.0000), (0.0047, -0.0806, 0.0115), 0.0100),
        Capsule((-0.0050, -0.0150, -0.0010), (-0.0099, -0.0793, 0.0057), 0.0095),
        Capsule((-0.0100, -0.0150, -0.0040), (-0.0195, -0.0712, -0.0034), 0.0095),
    ),
    0.250,
    1.0,
)

_THUMB_CMC: Vector = (0.0265, -0.0250, -0.0105)
_THUMB_MP: Vector = (0.0430, -0.0542, -0.0232)
_THUMB_IP: Vector = (0.0570, -0.0801, -0.0333)
_THUMB_TIP: Vector = (0.0670, -0.0981, -0.0403)

_THUMB = chain(
    ["thumb_metacarpal", "thumb_proximal", "thumb_distal"],
    [
        (
            _joint("thumb_cmc_abduction", _THUMB_CMC, (-0.042, -0.665, 0.745), (-0.55, 0.80)),
            _joint("thumb_cmc_flexion", _THUMB_CMC, (0.496, 0.732, 0.468), (-0.80, 0.90)),
        ),
        (_joint("thumb_mp_flexion", _THUMB_MP, (-0.084, -0.203, 0.975), (-1.00, 0.70)),),
        (_joint("thumb_ip_flexion", _THUMB_IP, (-0.050, -0.480, 0.876), (-1.40, 0.44)),),
    ],
    (_THUMB_CMC, _THUMB_MP, _THUMB_IP, _THUMB_TIP),
    (0.0095, 0.0085, 0.0065),
    (0.0139, 0.0082, 0.0075),
    (2.0, 2.0, 6.0),
)

_FINGERS = (
    *_finger(
        "index",
        ((0.0222, -0.0809, 0.0110), (0.0297, -0.1222, 0.0183), (0.0330, -0.1471, 0.0195)),
        ((0.995, 0.100, 0.0), (-0.055, 0.086, 0.995), (0.975, 0.100, -0.198), (0.995, 0.100, 0.0)),
        (0.0351, -0.1630, 0.0201),
        (0.0090, 0.0080, 0.0070),
        (0.0089, 0.0043, 0.0031),
    ),
    *_finger(
        "middle",
        ((0.0047, -0.0806, 0.0115), (0.0064, -0.1248, 0.0177), (0.0077, -0.1538, 0.0197)),
        ((0.980, 0.0, 0.199), (-0.199, 0.0, 0.980), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
        (0.0094, -0.1708, 0.0174),
        (0.0090, 0.0080, 0.0070),
        (0.0104, 0.0041, 0.0030),
    ),
    *_finger(
        "ring",
        ((-0.0099, -0.0793, 0.0057), (-0.0134, -0.1195, 0.0070), (-0.0157, -0.1443, 0.0076)),
        ((0.900, 0.0, 0.435), (-0.435, 0.0, 0.900), (0.921, 0.0, 0.389), (0.825, 0.0, 0.565)),
        (-0.0165, -0.1623, 0.0053),
        (0.0085, 0.0075, 0.0068),
        (0.0076, 0.0050, 0.0029),
    ),
    *_finger(
        "little",
        ((-0.0195, -0.0712, -0.0034), (-0.0248, -0.1067, -0.0063), (-0.0277, -0.1274, -0.0085)),
        ((0.825, 0.0, 0.565), (-0.565, 0.0, 0.825), (0.825, 0.0, 0.565), (0.643, -0.227, 0.731)),
        (-0.0285, -0.1434, -0.0111),
        (0.0080, 0.0070, 0.0060),
        (0.0043, 0.0028, 0.0016),
    ),
)

_FLEXED = {f"{finger}_{joint}" for finger in ("index", "middle", "ring", "little") for joint in ("pip", "dip")}

HUMAN = Hand(
    name="human",
    links=(_PALM, *_THUMB, *_FINGERS),
    thumb="thumb_distal",
    open_pose={
        "thumb_cmc_abduction": -0.50,
        "thumb_cmc_flexion": 0.75,
        "thumb_ip_flexion": -0.20,
        **{f"{finger}_mcp_flexion": 0.25 for finger in ("index", "middle", "ring", "little")},
        **{f"{finger}_pip": 0.25 for finger in ("index", "middle", "ring", "little")},
        **{f"{finger}_dip": 0.15 for finger in ("index", "middle", "ring", "little")},
    },
    closed_pose={
        "thumb_cmc_abduction": -0.45,
        "thumb_cmc_flexion": 0.85,
        "thumb_mp_flexion": -0.75,
        "thumb_ip_flexion": -0.90,
        **{f"{finger}_mcp_flexion": 1.35 for finger in ("index", "middle", "ring", "little")},
        **dict.fromkeys(sorted(_FLEXED), 1.20),
    },
    wide_pose={
        "thumb_cmc_abduction": -0.55,
        "thumb_cmc_flexion": 0.9,
        "thumb_mp_flexion": 0.7,
        "thumb_ip_flexion": -0.103,
        "index_mcp_flexion": 0.129,
        "index_mcp_abduction": 0.241,
        "index_pip": 0.139,
        "index_dip": 0.068,
        "middle_mcp_flexion": 0.141,
        "middle_mcp_abduction": 0.261,
        "middle_pip": 0.199,
        "middle_dip": 0.075,
        "ring_mcp_flexion": 0.269,
        "ring_mcp_abduction": 0.3,
        "ring_dip": -0.021,
        "little_mcp_flexion": 0.05,
        "little_mcp_abduction": 0.3,
        "little_dip": 0.055,
    },
    wrist=WRIST,
)
