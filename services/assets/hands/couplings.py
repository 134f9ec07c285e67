"""Couplings between the joints of a model.

They are equalities, closed loops of links, and tendons with narrow limits. MuJoCo reads URDF's
mimic joints as joint equalities. Everything is relative to the pose of the file, which is zero
here.
"""

import numpy as np

from congrasp.common.runtime.physics_library import mujoco
from congrasp.services.assets.hands.closed_loops import loop_couplings
from congrasp.services.assets.hands.follow import Follow
from congrasp.services.assets.hands.tendons import fixed_tendon, relative_limits

_MAX_SLACK = 0.3
"""Play of a limited tendon between two joints that still counts as a coupling, rad."""
_MIN_RANGE_SHARE = 0.25
"""Share of its range that a coupling leaves to a joint."""
_CURVE_POINTS = 50
"""Points at which a polynomial coupling is linearised."""


def couplings(
    model: mujoco.MjModel, hand: set[int], driven: set[int], notes: list[str]
) -> list[Follow]:
    """Returns joints that follow others, each once, with leaders that follow none.

    Args:
      model: the model.
      hand: the hand's joints.
      driven: joints that a motor moves.
      notes: omissions and simplifications are appended.
    """
    by_follower = _by_follower(model, hand, driven, notes)
    moved = driven | by_follower.keys()
    for coupling in loop_couplings(model, hand, moved, notes):
        by_follower[coupling.a] = coupling
    settled = []
    for coupling in by_follower.values():
        follower = model.joint(coupling.a).name
        root = _rooted(coupling, by_follower)
        if root is None:
            notes.append(f"joints are coupled in a circle: the coupling of '{follower}' is dropped")
        elif _leaves_range(model, root):
            settled.append(root)
        else:
            leader = model.joint(root.b).name
            notes.append(
                f"the coupling of '{follower}' to '{leader}' is dropped: their limits leave it no "
                f"range ('couplings')"
            )
    return settled


def _by_follower(
    model: mujoco.MjModel, hand: set[int], driven: set[int], notes: list[str]
) -> dict[int, Follow]:
    """Couplings within the hand by follower; a joint with a motor leads one without."""
    by_follower: dict[int, Follow] = {}
    for coupling in (*_equalities(model, notes), *_limited_tendons(model, driven)):
        if coupling.a not in hand or coupling.b not in hand:
            continue
        if not coupling.ratio:
            notes.append(
                f"'{model.joint(coupling.a).name}' follows '{model.joint(coupling.b).name}' with "
                f"the ratio 0: that is dropped"
            )
            continue
        leads = coupling.a in driven and coupling.b not in driven
        if leads or coupling.a in by_follower:
            coupling = coupling.reversed()
        if coupling.a not in by_follower and coupling.a != coupling.b:
            by_follower[coupling.a] = coupling
    return by_follower


def _rooted(coupling: Follow, by_follower: dict[int, Follow]) -> Follow | None:
    """The coupling to the last leader of a chain; None for a circle."""
    passed = {coupling.a}
    while coupling.b in by_follower and coupling.b not in passed:
        passed.add(coupling.b)
        coupling = coupling.through(by_follower[coupling.b])
    if coupling.b in passed:
        return None
    return coupling


def _leaves_range(model: mujoco.MjModel, coupling: Follow) -> bool:
    """True if a follower's limits leave its leader a part of its range.

    A follower without limits takes all of it.
    """
    if not model.jnt_limited[coupling.a]:
        return True
    lower, upper = relative_limits(model, coupling.b)
    limits = relative_limits(model, coupling.a)
    low, high = sorted((limit - coupling.offset) / coupling.ratio for limit in limits)
    remaining = min(upper, high) - max(lower, low)
    return bool(remaining > _MIN_RANGE_SHARE * (upper - lower))


def _equalities(model: mujoco.MjModel, notes: list[str]) -> list[Follow]:
    """Couplings by equalities between joints, or between the joints of a fixed tendon."""
    couplings = []
    for e in range(model.neq):
        if not model.eq_active0[e]:
            continue
        kind = model.eq_type[e]
        first = int(model.eq_obj1id[e])
        has_second = int(model.eq_obj2id[e]) >= 0
        coupling = None
        if kind == mujoco.mjtEq.mjEQ_JOINT:
            name = model.joint(first).name
            if has_second:
                coupling = _joint_equality(model, e, notes)
        elif kind == mujoco.mjtEq.mjEQ_TENDON:
            name = model.tendon(first).name
            if not has_second:
                coupling = _tendon_equality(model, e)
        else:
            continue
        if coupling is not None:
            couplings.append(coupling)
        else:
            notes.append(
                f"an equality of '{name}' that does not couple two joints is dropped ('couplings')"
            )
    return couplings


def _joint_equality(model: mujoco.MjModel, equality: int, notes: list[str]) -> Follow:
    """The coupling of two joints; a polynomial is linearised over the leader's range."""
    follower = int(model.eq_obj1id[equality])
    leader = int(model.eq_obj2id[equality])
    polynomial = model.eq_data[equality, :5]
    if np.abs(polynomial[2:]).max() == 0:
        return Follow(follower, leader, float(polynomial[1]), float(polynomial[0]))
    lower, upper = relative_limits(model, leader)
    angles = np.linspace(float(lower), float(upper), _CURVE_POINTS)
    curve = np.polynomial.polynomial.polyval(angles, polynomial)
    ratio, offset = np.polyfit(angles, curve, 1)
    notes.append(f"'{model.joint(follower).name}' follows a curve, which is linearised")
    return Follow(follower, leader, float(ratio), float(offset))


def _tendon_equality(model: mujoco.MjModel, equality: int) -> Follow | None:
    """The coupling of the two joints of a fixed tendon of constant length; None of others."""
    coefficients = fixed_tendon(model, int(model.eq_obj1id[equality]))
    if len(coefficients) != 2:
        return None
    leader, follower = coefficients
    ratio = -coefficients[leader] / coefficients[follower]
    offset = float(model.eq_data[equality, 0]) / coefficients[follower]
    return Follow(follower, leader, ratio, offset)


def _limited_tendons(model: mujoco.MjModel, driven: set[int]) -> list[Follow]:
    """Couplings by tendons whose limits leave two joints almost no relative motion.

    One of the joints has no motor.
    """
    couplings = []
    for tendon in range(model.ntendon):
        coefficients = fixed_tendon(model, tendon)
        leaders = [j for j in coefficients if j in driven]
        if not model.tendon_limited[tendon] or len(coefficients) != 2 or len(leaders) != 1:
            continue
        (leader,) = leaders
        (follower,) = coefficients.keys() - {leader}
        lower, upper = model.tendon_range[tendon]
        if (upper - lower) / abs(coefficients[follower]) > _MAX_SLACK:
            continue
        length_at_zero = sum(
            coefficient * model.qpos0[model.jnt_qposadr[j]]
            for j, coefficient in coefficients.items()
        )
        middle = 0.5 * (lower + upper) - length_at_zero
        ratio = -coefficients[leader] / coefficients[follower]
        offset = float(middle / coefficients[follower])
        couplings.append(Follow(follower, leader, ratio, offset))
    return couplings
