"""The actuators of a hand's file: motors with gains and limits, couplings between joints, tendons.

MuJoCo reads URDF's mimic joints as joint equalities. Everything is relative to the pose in which
the file shows the hand, which is zero here.
"""

import dataclasses

import numpy as np

from congrasp.common.hands.spec import Coupling, Joint, Motor
from congrasp.common.runtime.mujoco import mujoco
from congrasp.services.assets.hands.compile import listed

FINGERTIP_FORCE = 15.0
"""Force with which a joint without a torque limit can press its fingertip, N."""
LARGEST_FORCE = 40.0
"""Fingertip force above which a torque limit is implausible, N."""
_REACH = 0.3  # error at which a joint reaches its full torque if the file has no gain, rad
_SLACK = 0.3  # play of a limited tendon between two joints that still counts as a coupling, rad
_ROOM = 0.25  # least share of its range that a coupling leaves to a joint
_PULL = 0.05  # least share of a tendon's largest lever that counts
_SLOW = 0.1  # longest time constant of damping, s


@dataclasses.dataclass(frozen=True)
class Servo:
    """A motor of the file, with gains of its joint or tendon; 0 where the file has none."""

    joints: dict[int, float]
    kp: float
    limit: float
    reach: tuple[float, float] | None
    """Range of its targets, for a position servo that has one."""


@dataclasses.dataclass(frozen=True)
class Follow:
    """Joint a = offset + ratio * joint b, by their indices in the model."""

    a: int
    b: int
    ratio: float
    offset: float


def servos(model: mujoco.MjModel, notes: list[str]) -> list[Servo]:
    """Returns the motors of joints and of tendons; replacements and simplifications are added to
    the notes.
    """
    found, muscles, through_space, slopes = [], 0, 0, _slopes(model)
    for a in range(model.nu):
        kind, gear = mujoco.mjtTrn(model.actuator_trntype[a]), float(model.actuator_gear[a, 0])
        if model.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_MUSCLE:
            muscles += 1
            continue
        target = int(model.actuator_trnid[a, 0])
        of_joint = kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        if of_joint:
            joints = {target: 1.0}
        elif kind == mujoco.mjtTrn.mjTRN_TENDON:
            joints = _tendon(model, target)
            if not joints:
                through_space += 1
                joints = _through_space(slopes[target])
        else:
            continue
        kp = max(0.0, -float(model.actuator_biasprm[a, 1])) * gear**2
        limit = (
            float(np.abs(model.actuator_forcerange[a]).max())
            if model.actuator_forcelimited[a]
            else 0.0
        )
        if not limit and not kp and model.actuator_ctrllimited[a]:
            limit = float(
                np.abs(model.actuator_ctrlrange[a]).max() * abs(model.actuator_gainprm[a, 0])
            )
        position = kp > 0 and model.actuator_ctrllimited[a] and gear == 1 and of_joint
        position = position and np.isclose(model.actuator_gainprm[a, 0], kp)
        reach = (
            tuple(model.actuator_ctrlrange[a] - model.qpos0[model.jnt_qposadr[target]])
            if position
            else None
        )
        found.append(Servo(joints, kp, limit * abs(gear), reach))  # type: ignore[arg-type]
    if muscles:
        notes.append(f"{muscles} muscles move it in the file: here every joint has a motor")
    if through_space:
        notes.append(f"{through_space} motors pull spatial tendons, which are linearised")
    return found


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
    found: dict[int, Follow] = {}
    for a, b, ratio, offset in (*_equalities(model, notes), *_limited_tendons(model, driven)):
        if a not in hand or b not in hand:
            continue
        if not ratio:
            notes.append(
                f"'{model.joint(a).name}' follows '{model.joint(b).name}' with the ratio 0: that "
                f"is dropped"
            )
            continue
        if (a in driven and b not in driven) or a in found:
            a, b, ratio, offset = b, a, 1.0 / ratio, -offset / ratio
        if a not in found and a != b:
            found[a] = Follow(a, b, ratio, offset)
    settled = []
    for first in found.values():
        link, passed = first, {first.a}
        while link.b in found and link.b not in passed:
            above = found[link.b]
            passed.add(link.b)
            link = Follow(
                first.a, above.b, link.ratio * above.ratio, link.offset + link.ratio * above.offset
            )
        if link.b in passed:
            notes.append(
                f"joints are coupled in a circle: the coupling of '{model.joint(first.a).name}' is "
                f"dropped"
            )
        elif _fits(model, link):
            settled.append(link)
        else:
            joints = f"'{model.joint(link.a).name}' to '{model.joint(link.b).name}'"
            notes.append(
                f"the coupling of {joints} is dropped: their limits leave it no range ('couplings')"
            )
    return settled


def _fits(model: mujoco.MjModel, link: Follow) -> bool:
    """True if a follower's limits leave its leader a part of its range; a follower without limits
    takes all of it.
    """
    if not model.jnt_limited[link.a]:
        return True
    lower, upper = _limits(model, link.b)
    ends = sorted((limit - link.offset) / link.ratio for limit in _limits(model, link.a))
    return bool(min(upper, ends[1]) - max(lower, ends[0]) > _ROOM * (upper - lower))


def _limits(model: mujoco.MjModel, j: int) -> np.ndarray:
    """Limits (2,) of a joint relative to the file's pose."""
    return np.asarray(model.jnt_range[j] - model.qpos0[model.jnt_qposadr[j]])


def _equalities(model: mujoco.MjModel, notes: list[str]) -> list[tuple[int, int, float, float]]:
    """(follower, leader, ratio, offset) of equalities between joints or between the joints of a
    fixed tendon.
    """
    found = []
    for e in range(model.neq):
        kind, data = model.eq_type[e], model.eq_data[e, :5]
        one, two = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        if not model.eq_active0[e]:
            continue
        if kind == mujoco.mjtEq.mjEQ_JOINT and two >= 0:
            ratio, offset = float(data[1]), float(data[0])
            if np.abs(data[2:]).max() > 0:
                where = np.linspace(
                    float(_limits(model, two)[0]), float(_limits(model, two)[1]), 50
                )
                ratio, offset = map(
                    float, np.polyfit(where, np.polynomial.polynomial.polyval(where, data), 1)
                )
                notes.append(f"'{model.joint(one).name}' follows a curve, which is linearised")
            found.append((one, two, ratio, offset))
        elif (
            kind == mujoco.mjtEq.mjEQ_TENDON and two < 0 and len(pulled := _tendon(model, one)) == 2
        ):
            (b, own), (a, other) = pulled.items()
            found.append((a, b, -own / other, float(data[0]) / other))
        elif kind == mujoco.mjtEq.mjEQ_CONNECT:
            notes.append(
                "closed loops of links are opened (import a URDF whose joints mimic one another)"
            )
        elif kind == mujoco.mjtEq.mjEQ_JOINT or kind == mujoco.mjtEq.mjEQ_TENDON:
            what = (
                model.joint(one).name if kind == mujoco.mjtEq.mjEQ_JOINT else model.tendon(one).name
            )
            notes.append(
                f"an equality of '{what}' that does not couple two joints is dropped ('couplings')"
            )
    return found


def _limited_tendons(
    model: mujoco.MjModel, driven: set[int]
) -> list[tuple[int, int, float, float]]:
    """Couplings by tendons whose limits leave two joints, one of them without a motor, almost no
    relative motion.
    """
    found = []
    for t in range(model.ntendon):
        pulled = _tendon(model, t)
        if not model.tendon_limited[t] or len(pulled) != 2 or len(driven & {*pulled}) != 1:
            continue
        b = next(j for j in pulled if j in driven)
        a = next(j for j in pulled if j != b)
        lower, upper = model.tendon_range[t]
        if (upper - lower) / abs(pulled[a]) > _SLACK:
            continue
        middle = 0.5 * (lower + upper) - sum(
            c * model.qpos0[model.jnt_qposadr[j]] for j, c in pulled.items()
        )
        found.append((a, b, -pulled[b] / pulled[a], float(middle / pulled[a])))
    return found


def _tendon(model: mujoco.MjModel, t: int) -> dict[int, float]:
    """Coefficients of a fixed tendon by joint; empty for a spatial one."""
    where = range(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])
    if any(model.wrap_type[w] != mujoco.mjtWrap.mjWRAP_JOINT for w in where):
        return {}
    return {int(model.wrap_objid[w]): float(model.wrap_prm[w]) for w in where}


def _slopes(model: mujoco.MjModel) -> np.ndarray:
    """Changes (ntendon, njnt) of tendon lengths per joint angle, m/rad, with the other joints at
    their centres.
    """
    data = mujoco.MjData(model)
    turning = np.flatnonzero(
        (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & (model.jnt_limited > 0)
    )
    where = model.jnt_qposadr[turning]
    data.qpos[where] = model.jnt_range[turning].mean(1)
    middle, slopes = data.qpos.copy(), np.zeros((model.ntendon, model.njnt))
    for j, place in zip(turning, where, strict=True) if model.ntendon else ():
        for end, sign in zip(model.jnt_range[j], (-1, 1), strict=True):
            data.qpos[:] = middle
            data.qpos[place] = end
            mujoco.mj_fwdPosition(model, data)
            slopes[:, j] += sign * data.ten_length / np.ptp(model.jnt_range[j])
    return slopes


def _through_space(slopes: np.ndarray) -> dict[int, float]:
    """Coefficients of a spatial tendon by joint, from its slopes (njnt,), without negligible
    ones.
    """
    least = _PULL * np.abs(slopes).max(initial=0.0)
    return {int(j): float(slopes[j]) for j in np.flatnonzero(np.abs(slopes) > least)}


def _shared_out(pulls: list[dict[int, float]]) -> list[dict[int, float]]:
    """Assigns every joint to one tendon: the motor that pulls only this joint, or pulls it most."""
    owner = {
        j: max(
            (k for k, pull in enumerate(pulls) if j in pull),
            key=lambda k: (len(pulls[k]) == 1, abs(pulls[k][j])),
        )
        for j in set[int]().union(*pulls)
    }
    return [
        {j: c for j, c in pull.items() if len(pull) == 1 or owner[j] == k}
        for k, pull in enumerate(pulls)
    ]


class Drive:
    """Gains of a hand's joints and motors from a file, and proposals for missing ones."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        joints: dict[int, str],
        levers: dict[int, float],
    ):
        """Reads motors and couplings.

        Args:
          model: the model.
          data: its data in the file's pose.
          joints: names of the hand's joints.
          levers: distance of each from the tip of its finger, m.
        """
        self.notes: list[str] = []
        self._model, self._names, self._levers = model, joints, levers
        self._inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, self._inertia)
        found = [servo for servo in servos(model, self.notes) if {*servo.joints} & {*joints}]
        driven = {j for servo in found for j in servo.joints if j in joints}
        self.links = couplings(model, {*joints}, driven, self.notes)
        self._leaders = {link.a: link for link in self.links}
        self._limitless: list[str] = []
        self._strong: list[str] = []
        self._damped: list[str] = []
        passive = [name for j, name in joints.items() if j not in driven and j not in self._leaders]
        if driven:
            self.notes += listed(
                "no motor in the file, one each is added ('couplings' in the hand file)", passive
            )
        pulls = [self._reduced(servo) for servo in found]
        self._pulls = list(zip(found, _shared_out(pulls), strict=True))
        if idle := sum(
            bool(before) and not after
            for before, (_, after) in zip(pulls, self._pulls, strict=True)
        ):
            self.notes.append(
                f"{idle} motors that only pull joints of others are dropped ('tendons' in the hand "
                f"file)"
            )

    def couplings(self) -> tuple[Coupling, ...]:
        """Returns the couplings as data."""
        return tuple(
            Coupling(self._names[x.a], self._names[x.b], round(x.ratio, 6), round(x.offset, 6))
            for x in self.links
        )

    def limits(self, j: int) -> np.ndarray | None:
        """Limits (2,) of a joint relative to the file's pose, or those that its leader's give it;
        None without any.
        """
        if self._model.jnt_limited[j]:
            return _limits(self._model, j)
        link = self._leaders.get(j)
        if link is None or not self._model.jnt_limited[link.b]:
            return None
        return np.sort(link.offset + link.ratio * _limits(self._model, link.b))

    def joint(self, j: int, lower: float, upper: float, joint: Joint) -> Joint:
        """Returns a joint with the gains of its motor, zeros if it has none, within the motor's
        range.
        """
        dof = self._model.jnt_dofadr[j]
        armature = float(self._model.dof_armature[dof]) or 5e-4
        damping = float(self._model.dof_damping[dof])
        kp = kv = limit = 0.0
        if j not in self._leaders and not any(
            j in pulled for _, pulled in self._pulls if len(pulled) > 1
        ):
            mine = [(x, pulled[j]) for x, pulled in self._pulls if {*pulled} == {j}]
            servo, scale = next(
                (x for x in mine if j in x[0].joints), mine[0] if mine else (None, 1.0)
            )
            kp, limit = self._gains(j, servo, scale, self._names[j])
            if servo and servo.reach and j in servo.joints:
                reach = max(lower, servo.reach[0]), min(upper, servo.reach[1])
                if reach[0] < reach[1]:
                    lower, upper = reach
                else:
                    self.notes.append(
                        f"the control range of '{self._names[j]}' is outside its limits, and is "
                        f"left out"
                    )
            followers = {j: 1.0} | {x.a: x.ratio for x in self.links if x.b == j}
            kv = self._damping(followers, kp)
            if damping > _SLOW * kp:
                self._damped.append(self._names[j])
                damping = _SLOW * kp
        return dataclasses.replace(
            joint,
            lower=round(float(lower), 6),
            upper=round(float(upper), 6),
            kp=round(kp, 4),
            kv=round(kv, 4),
            torque_limit=round(limit, 4),
            damping=round(damping, 6),
            armature=armature,
        )

    def tendons(self) -> tuple[Motor, ...]:
        """Returns motors of tendons, with coefficients of at most one."""
        found = []
        for servo, pulled in self._pulls:
            if len(pulled) < 2:
                continue
            largest = max(map(abs, pulled.values()))
            first = max(pulled, key=lambda j: self._levers[j])
            name = "_".join(["tendon", *(self._names[j] for j in pulled)])
            kp, limit = self._gains(first, servo, largest, name)
            coefficients = {self._names[j]: round(c / largest, 6) for j, c in pulled.items()}
            kv = self._damping({j: c / largest for j, c in pulled.items()}, kp)
            found.append(Motor(name, coefficients, round(kp, 4), round(kv, 4), round(limit, 4)))
        return tuple(found)

    def remarks(self) -> list[str]:
        """Returns the proposals, once all joints and tendons have been requested."""
        proposed = (
            f"no torque limit, {FINGERTIP_FORCE:g} N at the fingertip is proposed ('torque_limit')"
        )
        lowered = (
            f"torque limits above {LARGEST_FORCE:g} N at the fingertip are lowered to that "
            f"('torque_limit')"
        )
        damped = (
            f"damping that holds joints for more than {_SLOW:g} s is lowered ('damping' in the "
            f"hand file)"
        )
        found = (
            listed(proposed, self._limitless)
            + listed(lowered, self._strong)
            + listed(damped, self._damped)
        )
        return [*self.notes, *found]

    def _reduced(self, servo: Servo) -> dict[int, float]:
        """Joints pulled by a servo, with following joints replaced by their leaders."""
        pulled: dict[int, float] = {}
        for j, c in servo.joints.items():
            link = self._leaders.get(j)
            leader, share = (link.b, c * link.ratio) if link else (j, c)
            if leader in self._names:
                pulled[leader] = pulled.get(leader, 0.0) + share
        return {j: c for j, c in pulled.items() if c}

    def _gains(self, j: int, servo: Servo | None, scale: float, name: str) -> tuple[float, float]:
        """Returns kp and torque limit of a motor; without a gain in the file, kp gives the full
        torque at `_REACH`.
        """
        kp = servo.kp * scale**2 if servo else 0.0
        limit = servo.limit * abs(scale) if servo else 0.0
        if self._model.jnt_actfrclimited[j]:
            own = float(np.abs(self._model.jnt_actfrcrange[j]).max())
            limit = min(filter(None, (limit, own)), default=0.0)
        lever = max(self._levers[j], 0.01)
        if not limit:
            self._limitless.append(name)
            limit = FINGERTIP_FORCE * lever
        elif limit > LARGEST_FORCE * lever:
            self._strong.append(name)
            limit = LARGEST_FORCE * lever
        return kp or limit / _REACH, limit

    def _damping(self, moved: dict[int, float], kp: float) -> float:
        """Returns kv = 1.4 sqrt(kp I), with the inertia I of everything that a motor moves, by the
        joints' ratios.
        """
        dofs = [self._model.jnt_dofadr[j] for j in moved]
        ratios = np.array([*moved.values()])
        inertia = self._inertia[np.ix_(dofs, dofs)].copy()
        armature = self._model.dof_armature[dofs]
        inertia[np.diag_indices(len(dofs))] += np.where(armature > 0, 0.0, 5e-4)
        return float(1.4 * np.sqrt(kp * max(ratios @ inertia @ ratios, 1e-6)))
